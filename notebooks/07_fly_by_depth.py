# %% [markdown]
# # Fly by depth
# A drone flies through a random forest, with a depth image of 16 x 12 pixels and its own motion as observations,
# without its position. A new forest is drawn in every episode, inside the compiled program.
#
# This notebook trains for about a minute, on a shorter and sparser forest than the default. This is enough to learn to
# avoid trees, but not for a high success rate; the last section has the result of a full training.

# %%
# Installs the package where it is missing, from the checkout with this notebook. Elsewhere, as on Colab, set PACKAGE
# to the path of a wheel, "jaxdrones-VERSION-py3-none-any.whl[cli]", or to "jaxdrones[cli] @ git+https://REPOSITORY".
import importlib.util
import subprocess
import sys

PACKAGE = "..[cli]"
if importlib.util.find_spec("jaxdrones") is None:
    subprocess.run([sys.executable, "-m", "pip", "install", "-q", PACKAGE], check=True)

# %%
import dataclasses
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxdrones as jd
from jaxdrones.learning import bptt, evaluate
from jaxdrones.training import presets
from jaxdrones.training.episode import fly_episode
from jaxdrones.visualization.palette import COLORS

plt.rcParams |= {"axes.prop_cycle": plt.cycler(color=COLORS), "axes.grid": True, "grid.linewidth": 0.3}

# %% [markdown]
# ## Depth images

# %%
FOREST = dict(length=10.0, density=0.2, speed=2.0, duration=7.0)  # m, trees per m^2, m/s, s
env, config = presets.preset("forest", "bptt", **FOREST)
obs, world = jax.jit(env.reset)(jax.random.key(4))
print({name: x.shape for name, x in obs.items()})


def draw_depth(axis, depth):
    """Draw a depth image; return the artist for the color bar."""
    axis.grid(False)
    axis.set(xticks=[], yticks=[])
    return axis.imshow(depth, cmap="viridis_r", vmin=0, vmax=10)


figure, axis = plt.subplots(figsize=(4.5, 2.8), dpi=80, layout="constrained")
figure.colorbar(draw_depth(axis, obs["depth"][0]), label="depth (m)")
axis.set_title("depth at the start, 16 x 12 pixels")

# %% [markdown]
# ## A short training
# The learner is backpropagation through time. With `image_gradient=False` the images are constants in the gradient,
# which is faster.

# %%
short = dict(updates=240, worlds=64, horizon=50)
config = dataclasses.replace(config, **short, image_gradient=False)
began = time.perf_counter()
result = jax.block_until_ready(bptt.train(jax.random.key(0), env, config))
print(f"trained in {time.perf_counter() - began:.0f} s, compilation included")

reward = np.asarray(result.history["reward"])
steps = np.arange(1, len(reward) + 1) * config.worlds * config.horizon
figure, axis = plt.subplots(figsize=(6, 3.2), dpi=80, layout="constrained")
axis.plot(steps / 1e6, reward)
axis.set(xlabel="control steps flown (million)", ylabel="reward per step, in training", title="BPTT, one seed")

# %% [markdown]
# ## Results
# An episode is a success if the drone comes within 1 m of its goal without contact. To test whether the policy uses its
# images, it also flies the same forests with empty images.


# %%
@jax.tree_util.Partial
def blindfolded(obs):
    return result.policy(obs | {"depth": jnp.full_like(obs["depth"], env.task.camera.far)})


reports = {}
for name, policy in ("with eyes", result.policy), ("blindfolded", blindfolded):
    reports[name] = evaluate(env, policy, jax.random.key(1), episodes=100)
    low, high = reports[name].success_interval
    print(f"{name}: success {reports[name].success:.0%} (95 % interval {low:.0%} to {high:.0%}) in 100 new forests")

# %%
# A new forest with a tree on the straight path, from above, and the images of the drone.
flights = {
    "with eyes": fly_episode(env, result.policy, jax.random.key(3)),
    "blindfolded": fly_episode(env, blindfolded, jax.random.key(3)),
}
seen = flights["with eyes"]
moments = np.linspace(0, len(seen.t) - 1, 6).astype(int)[1:5]
figure = plt.figure(figsize=(8, 5), dpi=80, layout="constrained")
grid = figure.add_gridspec(2, 4, height_ratios=(2.2, 1))
above = figure.add_subplot(grid[0, :])
for trees in seen.scene.shapes(np.float32):
    for place, radius, there in zip(trees.pos, trees.radius, trees.active, strict=True):
        if there:
            above.add_patch(plt.Circle(place[:2], radius, color="grey"))
for name, flight in flights.items():
    above.plot(*flight.drones.pos[:, 0, :2].T, label=f"{name}: {', '.join(flight.ended_by) or 'time is up'}")
above.plot(*seen.drones.pos[moments, 0, :2].T, "o", color=COLORS[0], markersize=5)
above.plot(*seen.target[0, 0, :2], "*", color="black", markersize=12, label="goal")
above.set(xlabel="x (m)", ylabel="y (m)", ylim=(-4, 4), aspect="equal", title="a new forest, from above; trees grey")
above.legend(loc="upper left", bbox_to_anchor=(1, 1))
for column, k in enumerate(moments):
    view = figure.add_subplot(grid[1, column])
    image = draw_depth(view, seen.images["depth"][k, 0])
    view.set_title(f"depth at {seen.t[k]:.1f} s", fontsize="medium")
figure.colorbar(image, ax=figure.axes[1:], label="depth (m)")

# %%
jd.show(flights)

# %% [markdown]
# ## A full training
# `jaxdrones train forest --set image_gradient=True --set updates=600` trains on the full forest (20 m, 3 m/s) with the
# gradient through the pixels, for about a quarter of an hour on one core. In 1,000 new forests, each of three such
# policies succeeded in 97.7 % (`jaxdrones eval runs/forest --episodes 1000`).

# %% [markdown]
# # Leader and follower
# The multi-agent example of gym-pybullet-drones (2021), equation 13 of the paper: the leader hovers at z = 0.5 m, and
# the follower matches its height. Each drone has its own policy with its own twelve observations as inputs. The
# centralized critics, used only in training, have 25 inputs: the observations of both drones and the action of the
# other drone.

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
import time

import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxdrones as jd
from jaxdrones.learning import evaluate, ppo
from jaxdrones.training import presets
from jaxdrones.training.episode import fly_episode
from jaxdrones.visualization.palette import COLORS

plt.rcParams |= {"axes.prop_cycle": plt.cycler(color=COLORS), "axes.grid": True, "grid.linewidth": 0.3}

# %%
env, config = presets.preset("leader-follower", "ppo")
print(f"a policy per drone: {config.per_agent}, of {env.observation_size} numbers")
print(f"a centralized critic: {config.centralized_critic}")

began = time.perf_counter()
result = ppo.train(jax.random.key(0), env, config)
print(f"trained in {time.perf_counter() - began:.0f} s, compilation included")

# %% [markdown]
# ## Learning curve
# The reward of a drone is a negative squared error, so it is zero at best.

# %%
reward = np.asarray(result.history["reward"])
steps = np.arange(1, len(reward) + 1) * config.worlds * config.horizon
figure, axis = plt.subplots(figsize=(6, 3.2), dpi=80, layout="constrained")
axis.plot(steps / 1e6, reward, linewidth=1)
axis.set(xlabel="control steps flown (million)", ylabel="reward per step, in training", title="PPO, one seed")

# %% [markdown]
# ## The flight
# The task has a fixed start, so all episodes are the same.

# %%
report = evaluate(env, result.policy, jax.random.key(1), episodes=1)
print(f"success {report.success:.0%}, distance at the end {100 * report.final_error:.1f} cm")
assert report.success == 1

log = fly_episode(env, result.policy, jax.random.key(2))
panels = {"z (m)": log.drones.pos[..., 2], "vz (m/s)": log.drones.vel[..., 2]}
panels["rotor speed (1000 RPM)"] = log.drones.rpm[..., 0] / 1000  # all rotors of a drone turn alike

figure, axes = plt.subplots(1, 3, figsize=(10, 3.2), dpi=80, layout="constrained")
for axis, (label, x) in zip(axes, panels.items(), strict=True):
    for i, name in enumerate(("leader", "follower")):
        axis.plot(log.t, x[:, i], ("-", "--")[i], label=name)
    axis.set(xlabel="t (s)", ylabel=label)
axes[0].axhline(0.5, color="grey", linewidth=1, linestyle=":", label="commanded height")
axes[0].legend()
assert np.all(np.abs(log.drones.pos[-1, :, 2] - 0.5) < 0.05)

# %%
jd.show(log)

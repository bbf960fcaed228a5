# %% [markdown]
# # Train a policy
# The task is to hover with all four rotors, from random motions within one meter of the goal. This notebook compares
# two learners: backpropagation through time (BPTT), which uses the gradient of the rewards through the physics, and
# batched PPO, which needs no gradient of the physics.

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
from jaxdrones.learning import bptt, evaluate, ppo
from jaxdrones.training import presets
from jaxdrones.training.episode import fly_episode
from jaxdrones.visualization.palette import COLORS

plt.rcParams |= {"axes.prop_cycle": plt.cycler(color=COLORS), "axes.grid": True, "grid.linewidth": 0.3}

# %% [markdown]
# `print(jd.explain(env))` describes the complete environment: observation, action, rewards, terminations, physics.

# %%
env = jd.make("hover")
parts = str(jd.explain(env)).split("\n\n")
print("\n\n".join(part for part in parts if part.startswith(("hover", "Action", "Reward"))))

# %% [markdown]
# ## Two trainings
# `presets.preset` returns tuned settings; here PPO has fewer and shorter updates. Training is one compiled program for
# all worlds. The printed times are CPU times, which depend little on other programs; the README has the wall-clock
# times of compilation and training by BPTT on two idle cores.

# %%
env, config = presets.preset("hover", "bptt")
configs = {"BPTT": config, "PPO": ppo.Config(updates=150, horizon=64)}
results = {}
for (name, config), learner in zip(configs.items(), (bptt, ppo), strict=True):
    began = time.process_time()
    results[name] = jax.block_until_ready(learner.train(jax.random.key(0), env, config))
    print(f"{name}: {time.process_time() - began:.0f} s of the processor, compilation included; {config.worlds} worlds")

# %% [markdown]
# ## Learning curves
# The rewards of PPO are those of flights with random exploration, so they are lower than those of the deterministic
# policy.

# %%
figure, axis = plt.subplots(figsize=(6.5, 3.5), dpi=80, layout="constrained")
for name, result in results.items():
    reward = np.asarray(result.history["reward"])
    steps = np.arange(1, len(reward) + 1) * configs[name].worlds * configs[name].horizon
    axis.plot(steps / 1e6, reward, label=name)
axis.set(
    xlabel="control steps flown (million)", ylabel="reward per step, in training", title="learning to hover, one seed"
)
axis.set_xscale("log")
axis.legend()

# %% [markdown]
# ## How good are they?
# An episode is a success if the drone is within 5 cm of the goal and slower than 0.1 m/s for the last two of five
# seconds. The success rate is over 1,000 new starts.

# %%
for name, result in results.items():
    report = evaluate(env, result.policy, jax.random.key(1), episodes=1000)
    low, high = report.success_interval
    print(f"{name}: success {report.success:.1%} (95 % interval {low:.1%} to {high:.1%})", end=", ")
    print(f"median distance at the end {100 * report.final_error_percentiles[50]:.1f} cm")
    assert report.success > 0.9

# %% [markdown]
# ## Replay
# One flight of each policy from the same start, in plots and in three dimensions.

# %%
flights = {name: fly_episode(env, result.policy, jax.random.key(2)) for name, result in results.items()}

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.5), dpi=80, layout="constrained")
for name, flight in flights.items():
    left.plot(flight.t, np.linalg.norm(flight.drones.pos[:, 0] - flight.target[:, 0], axis=-1), label=name)
left.set(xlabel="t (s)", ylabel="distance from the goal (m)", ylim=(0, None), title="both policies")
left.legend()
for i, rpm in enumerate(flights["BPTT"].drones.rpm[:, 0].T):
    right.plot(flights["BPTT"].t, rpm / 1000, linewidth=1, label=f"rotor {i}")
right.set(xlabel="t (s)", ylabel="rotor speed (1000 RPM)", title="rotors, BPTT")
right.legend(ncols=2)

# %%
jd.show(flights)

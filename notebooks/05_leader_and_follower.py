# %% [markdown]
# # Leader and follower
# The multi-agent example of gym-pybullet-drones (2021), equation 13 of the paper: the leader is to hover at z = 0.5 m,
# the follower to be as high as the leader. Each has a policy of its own, of its own twelve numbers. While they learn,
# a critic sees all: both drones' observations and the other's action, 25 numbers. It is not needed to fly.

# %%
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

from jaxdrones.learning import evaluate, ppo
from jaxdrones.training import presets
from jaxdrones.training.episode import fly_episode

# %%
env, config = presets.preset("leader-follower", "ppo")
print(f"a policy per drone: {config.per_agent}, of {env.observation_size} numbers")
print(f"a centralized critic: {config.centralized_critic}")

began = time.perf_counter()
result = ppo.train(jax.random.key(0), env, config)
print(f"trained in {time.perf_counter() - began:.1f} s, compilation included")

# %% [markdown]
# The task starts every episode from the same place, so one episode says it all.

# %%
report = evaluate(env, result.policy, jax.random.key(1), episodes=10)
print(report)
assert report.success == 1

# %% [markdown]
# The learning curve; height, climb and rotor speeds of both drones.

# %%
log = fly_episode(env, result.policy, jax.random.key(2))
rpm = log.drones.rpm[..., 0]  # all rotors of a drone turn alike
panels = {"z (m)": log.drones.pos[..., 2], "vz (m/s)": log.drones.vel[..., 2], "rotor speed (RPM)": rpm}

figure, axes = plt.subplots(1, 4, figsize=(16, 3.5), layout="constrained")
reward = jnp.asarray(result.history["reward"])
axes[0].plot(jnp.arange(1, len(reward) + 1) * config.worlds * config.horizon / 1e6, reward)
axes[0].set(xlabel="control steps (million)", ylabel="reward per step")
for axis, (label, x) in zip(axes[1:], panels.items(), strict=True):
    lines = axis.plot(log.t, x)
    axis.set(xlabel="t (s)", ylabel=label)
axes[-1].legend(lines, ["leader", "follower"])
assert jnp.all(jnp.abs(log.drones.pos[-1, :, 2] - 0.5) < 0.05)

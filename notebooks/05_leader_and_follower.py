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

from jaxdrones.learning import COMPILER_OPTIONS, evaluate, ppo
from jaxdrones.training import presets
from jaxdrones.training.episode import fly_episode

# %%
env, config = presets.preset("leader-follower", "ppo")
print(
    f"policy per role: {config.per_agent}, central critic: {config.centralized_critic}, sees {env.observation_size} numbers"
)

train = jax.jit(lambda key: ppo.train(key, env, config), compiler_options=COMPILER_OPTIONS)
began = time.perf_counter()
result = jax.block_until_ready(train(jax.random.key(0)))
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
flight = fly_episode(env, result.policy, jax.random.key(2))
rpm = flight.drones.rpm[..., 0]  # all rotors of a drone turn alike
panels = {"z (m)": flight.drones.pos[..., 2], "vz (m/s)": flight.drones.vel[..., 2], "rotor speed (RPM)": rpm}

figure, axes = plt.subplots(1, 4, figsize=(16, 3.5), layout="constrained")
reward = jnp.asarray(result.history["reward"])
axes[0].plot(jnp.arange(1, len(reward) + 1) * config.worlds * config.horizon / 1e6, reward)
axes[0].set(xlabel="control steps (million)", ylabel="reward per step")
for axis, (label, x) in zip(axes[1:], panels.items(), strict=True):
    lines = axis.plot(flight.t, x)
    axis.set(xlabel="t (s)", ylabel=label)
axes[-1].legend(lines, ["leader", "follower"])
assert jnp.all(jnp.abs(flight.drones.pos[-1, :, 2] - 0.5) < 0.05)

# %% [markdown]
# # Train a policy
# Hover with all four rotors, from any motion within a metre of the goal, by backpropagation through time: seconds on a
# laptop's CPU.

# %%
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import jaxdrones as jd
from jaxdrones.learning import bptt, evaluate

# %%
env = jd.make("hover")
began = time.perf_counter()
result = bptt.train(jax.random.key(0), env, bptt.Config())
print(f"trained in {time.perf_counter() - began:.1f} s, compilation included")

# %% [markdown]
# Success is to be within 5 cm and 0.1 m/s of the goal for the last two of five seconds.

# %%
report = evaluate(env, result.policy, jax.random.key(1), episodes=1000)
print(report)
assert report.success > 0.95

# %% [markdown]
# Watch one flight, from upside down.

# %%
_, world = env.reset(jax.random.key(2))
world = world.replace(drones=world.drones.replace(quat=jnp.array([[1.0, 0.0, 0.0, 0.0]])))


@jax.jit
def fly(world):
    def advance(carry, key):
        obs, world = carry
        obs, world, *_ = env.step(key, world, result.policy(obs))
        return (obs, world), (world.drones, world.action)

    obs, world, *_ = env.step(jax.random.key(0), world, jnp.zeros((1, 4)))
    return jax.lax.scan(advance, (obs, world), jax.random.split(jax.random.key(3), 300))[1]


drones, actions = fly(world)
figure, axes = plt.subplots(1, 2, figsize=(10, 4))
axes[0].plot(jnp.arange(300) / 100, drones.pos[:, 0] - jnp.array([0.0, 0.0, 2.0]))
axes[0].set(xlabel="t (s)", ylabel="from the goal (m)")
axes[1].plot(jnp.arange(300) / 100, drones.rpm[:, 0])
axes[1].set(xlabel="t (s)", ylabel="rotor speeds (RPM)")
assert jnp.linalg.norm(drones.pos[-1, 0] - jnp.array([0.0, 0.0, 2.0])) < 0.1

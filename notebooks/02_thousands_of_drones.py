# %% [markdown]
# # Thousands of drones at once
# A step is about one world. Many worlds, masses or vehicles are `jax.vmap` of that: nothing new to learn.

# %%
import functools
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import jaxdrones as jd
from jaxdrones.control import Setpoint, for_team, pid

# %%
HZ, WORLDS = 120, 2000
step = jd.make_step(effects=(jd.drag,), dt=1 / 240, substeps=2)
pilot = functools.partial(pid.control, pid.gains("cf2x"), dt=1 / HZ)
start = jd.State.at_rest(jnp.array([[0.0, 0.0, 1.0]]))
nominal = jd.load_params("cf2x")


def control(params, memory, state, k):
    """The controller does not know what it carries: it is given the nominal parameters."""
    target = Setpoint.at(jnp.array([[0.3, 0.0, 1.0]]))
    return jax.vmap(pilot)(jd.repeat(nominal, 1), memory, state, target)


def fly(mass):
    params = jd.repeat(nominal.replace(mass=mass), 1)
    return jd.rollout(step, control, params, start, memory=for_team(pid.init(), 1), length=5 * HZ)[1].pos[:, 0]


# %% [markdown]
# Two thousand Crazyflies with different payloads, for five seconds each.

# %%
masses = jnp.linspace(0.020, 0.040, WORLDS)
flights = jax.jit(jax.vmap(fly))
pos = flights(masses).block_until_ready()
began = time.perf_counter()
pos = flights(masses).block_until_ready()
seconds = time.perf_counter() - began
print(f"{WORLDS * 5 * 240 / seconds / 1e6:.1f} million physics steps per second, controller included")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4))
for i in range(0, WORLDS, WORLDS // 10):
    left.plot(jnp.arange(5 * HZ) / HZ, pos[i, :, 2], label=f"{1000 * masses[i]:.0f} g")
left.set(xlabel="t (s)", ylabel="z (m)")
left.legend()
right.plot(1000 * masses, 100 * (pos[:, -1, 2] - 1.0))
right.set(xlabel="mass (g)", ylabel="height error after 5 s (cm)")
assert jnp.abs(pos[jnp.argmin(jnp.abs(masses - nominal.mass)), -1, 2] - 1.0) < 0.02

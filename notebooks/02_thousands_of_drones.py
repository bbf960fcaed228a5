# %% [markdown]
# # Thousands of drones
# A step advances one world; `jax.vmap` maps it over many worlds, masses or vehicles. This notebook simulates two
# thousand worlds with one drone each, then one world with a thousand drones.

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
import functools
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import jaxdrones as jd
from jaxdrones.control import Setpoint, for_team, geometric, pid
from jaxdrones.visualization.palette import COLORS

plt.rcParams |= {"axes.prop_cycle": plt.cycler(color=COLORS), "axes.grid": True, "grid.linewidth": 0.3}

# %% [markdown]
# ## Two thousand worlds
# The same flight with two thousand masses: 5 s from rest to a target 0.3 m away.

# %%
HZ, WORLDS = 120, 2000
step = jd.make_step(effects=(jd.drag,), dt=1 / 240, substeps=2)
pilot = functools.partial(pid.control, pid.gains("cf2x"), dt=1 / HZ)
start = jd.State.at_rest(jnp.array([[0.0, 0.0, 1.0]]))
nominal = jd.load_params("cf2x")


def control(params, memory, state, k):
    """Control with the nominal parameters: the payload is unknown to the controller."""
    target = Setpoint.at(jnp.array([[0.3, 0.0, 1.0]]))
    return jax.vmap(pilot)(jd.repeat(nominal, 1), memory, state, target)


def fly(mass):
    params = jd.repeat(nominal.replace(mass=mass), 1)
    return jd.rollout(step, control, params, start, memory=for_team(pid.init(), 1), length=5 * HZ)[1].pos[:, 0]


masses = jnp.linspace(0.020, 0.040, WORLDS)  # kg


# %% [markdown]
# `jd.over_worlds(fly)` returns the same results as `jax.jit(jax.vmap(fly))`, and is faster on a CPU. The first call
# compiles.


# %%
def timed(function):
    """Result and duration of a second call, s."""
    jax.block_until_ready(function(masses))
    began = time.perf_counter()
    result = jax.block_until_ready(function(masses))
    return result, time.perf_counter() - began


for name, flights in ("jax.vmap", jax.jit(jax.vmap(fly))), ("jd.over_worlds", jd.over_worlds(fly)):
    pos, seconds = timed(flights)
    rate = WORLDS * 5 * 240 / seconds / 1e6
    print(f"{name:15} {seconds:.2f} s, {rate:.0f} million physics steps per second, controller included")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.5), dpi=80, layout="constrained")
for i in range(0, WORLDS, WORLDS // 5):
    (line,) = left.plot(jnp.arange(1, 5 * HZ + 1) / HZ, pos[i, :, 2])
    left.text(5.1, pos[i, -1, 2], f"{1000 * masses[i]:.0f} g", color=line.get_color(), va="center")
left.set(xlabel="t (s)", ylabel="z (m)", xlim=(0, 5.8), title="height for five of the masses")
right.plot(1000 * masses, 100 * (pos[:, -1, 2] - 1.0))
right.axvline(1000 * nominal.mass, color="grey", linestyle="--", label="mass that the PID assumes")
right.set(xlabel="mass (g)", ylabel="height error after 5 s (cm)", title="all masses")
right.legend()
assert jnp.abs(pos[jnp.argmin(jnp.abs(masses - nominal.mass)), -1, 2] - 1.0) < 0.02

# %% [markdown]
# ## A thousand drones in one world
# Two layers of 500 drones, one 0.6 m above the other, track a wave. Each drone flies in the downwash of the drones
# above it. With a `NeighborGrid` only pairs within 1.5 m of each other are evaluated, instead of all 999,000.

# %%
SECONDS = 2
grid = jnp.stack(jnp.meshgrid(jnp.arange(25.0), jnp.arange(20.0)), axis=-1).reshape(-1, 2)  # x, y, m
across = jnp.concatenate([grid, grid + 0.1])  # the lower sheet, then the upper one
above = jnp.repeat(jnp.array([0.0, 0.6]), len(grid))
DRONES = len(across)
params = jd.repeat(nominal, DRONES)


def places(t):
    """Target positions at time t (s): (1000, 3) m, world."""
    wave = 0.5 * jnp.sin(2 * jnp.pi * (across[:, 0] / 12 + across[:, 1] / 20 - t / 8))
    return jnp.column_stack([across, 2.0 + above + wave])


swarm_pilot = functools.partial(geometric.control, geometric.gains(), dt=1 / HZ)


def swarm_control(params, memory, state, k):
    target, velocity = jax.jvp(places, (k / HZ,), (1.0,))
    return jax.vmap(swarm_pilot)(params, memory, state, Setpoint.at(target, vel=velocity))


def fly_swarm(**options):
    """Final distance of every drone from its target (m), and every tenth state."""
    step = jd.make_step(effects=(jd.drag,), dt=1 / 240, substeps=2, **options)
    start = jd.State.at_rest(places(0.0))
    memory = for_team(geometric.init(), DRONES)
    flight = jax.jit(lambda start: jd.rollout(step, swarm_control, params, start, memory, SECONDS * HZ)[1])
    trajectory = flight(start)
    error = jnp.linalg.norm(trajectory.pos[-1] - places(SECONDS), axis=-1)
    return error, jax.tree.map(lambda x: x[9::10], trajectory)


alone, _ = fly_swarm()
together, trajectory = fly_swarm(pairs=(jd.downwash,), neighbors=jd.NeighborGrid(cutoff=1.5))
lower = above == 0

figure, axis = plt.subplots(figsize=(6, 3.2), dpi=80, layout="constrained")
for name, error in ("without downwash", alone), ("with downwash", together):
    axis.hist(100 * error[lower], bins=40, range=(0, 20), label=name)
axis.set(xlabel="distance from its place (cm)", ylabel="number of drones", title=f"lower sheet after {SECONDS} s")
axis.legend()
assert together[lower].mean() > alone[lower].mean()

# %%
jd.show(trajectory, params, dt=10 / HZ, title="A thousand Crazyflies")

# %% [markdown]
# # First flight
# Four Crazyflies fly the circle of gym-pybullet-drones (2021) with its PID controller. This notebook plots the flight,
# plays it in three dimensions, and repeats it with wind.

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

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxdrones as jd
from jaxdrones.control import Setpoint, for_team, pid
from jaxdrones.tasks import curves
from jaxdrones.visualization.palette import COLORS

plt.rcParams |= {"axes.prop_cycle": plt.cycler(color=COLORS), "axes.grid": True, "grid.linewidth": 0.3}

# %% [markdown]
# `State` changes during a flight, `Params` are constant. The arguments of `make_step` define the physics: here drag,
# ground effect and downwash, with two physics steps of 1/240 s per control step.

# %%
HZ = 120  # control steps per second
params = jd.repeat(jd.load_params("cf2x"), 4)
step = jd.make_step(effects=(jd.drag, jd.ground_effect), pairs=(jd.downwash,), dt=1 / 240, substeps=2)
circle = curves.circle(radius=0.3, period=10.0)
start = jd.State.at_rest(circle.positions(4))

# %% [markdown]
# A controller is a function of one drone. `jax.vmap` maps it over a team, and `rollout` calls it `length` times.

# %%
pilot = functools.partial(pid.control, pid.gains("cf2x"), dt=1 / HZ)


def control(params, memory, state, k):
    """Rotor speeds of the team at control step k."""
    return jax.vmap(pilot)(params, memory, state, Setpoint.at(circle.positions(4, k / HZ)))


@jax.jit
def fly(params, state):
    return jd.rollout(step, control, params, state, memory=for_team(pid.init(), 4), length=12 * HZ)


final, trajectory = fly(params, start)
print("positions:", trajectory.pos.shape, "= control steps, drones, (x, y, z)")

# %% [markdown]
# Every drone follows a target on the circle. The PID uses the position of the target but not its velocity, so it lags.

# %%
t = np.arange(1, 12 * HZ + 1) / HZ
targets = jax.vmap(lambda t: circle.positions(4, t))(t)


def distance_from_target(trajectory):
    return np.linalg.norm(trajectory.pos - targets, axis=-1)


error = distance_from_target(trajectory)
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.5), dpi=80, layout="constrained")
left.plot(*targets[:, 0, :2].T, "--", color="grey", label="target")
for i in range(4):
    left.plot(*trajectory.pos[:, i, :2].T, label=f"drone {i}")
right.plot(t, 100 * error.mean(axis=1))
left.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title="path, from above")
left.legend(loc="center")
right.set(xlabel="t (s)", ylabel="distance from the target (cm)", ylim=(0, None), title="tracking error, mean of four")
assert error[4 * HZ :].mean() < 0.12  # the PID lags some 10 cm behind, as in gym-pybullet-drones

# %% [markdown]
# `jd.show` plays the flight: drag to rotate the view, press `?` for the keys. (Static views of the notebook, such as on
# GitHub, show a picture instead.)

# %%
jd.show(trajectory, params, dt=1 / HZ, targets=targets, title="Four Crazyflies on a circle")

# %% [markdown]
# ## The same flight in wind
# Wind is a field of `Params` and acts through the drag. `jax.vmap` simulates one world for each wind speed.

# %%
speeds = jnp.array([0.0, 2.0, 4.0])  # m/s along x


def fly_in_wind(speed):
    return fly(params.replace(wind=jnp.broadcast_to(jnp.array([speed, 0.0, 0.0]), (4, 3))), start)[1]


in_wind = jax.jit(jax.vmap(fly_in_wind))(speeds)

figure, axis = plt.subplots(figsize=(6, 3.2), dpi=80, layout="constrained")
for speed, positions in zip(speeds, in_wind.pos, strict=True):
    axis.plot(t, 100 * np.linalg.norm(positions - targets, axis=-1).mean(axis=1), label=f"{speed:.0f} m/s")
axis.set(xlabel="t (s)", ylabel="mean distance from the target (cm)", ylim=(0, None), title="four drones in wind")
axis.legend(title="wind along x")
assert jnp.isfinite(in_wind.pos).all()

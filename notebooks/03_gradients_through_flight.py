# %% [markdown]
# # Gradients through flight
# The simulator is differentiable from end to end. This notebook uses the derivative of a flight to tune the gains of a
# PID, identify a mass from a simulated measurement, and optimize a trajectory through four gates.

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
import optax

import jaxdrones as jd
from jaxdrones.control import Setpoint, for_team, pid, rates
from jaxdrones.sensing import Scene, gate
from jaxdrones.tasks import curves
from jaxdrones.tasks.gates import GATES
from jaxdrones.visualization.palette import COLORS

plt.rcParams |= {"axes.prop_cycle": plt.cycler(color=COLORS), "axes.grid": True, "grid.linewidth": 0.3}

HZ = 120  # control steps per second
nominal = jd.load_params("cf2x")
step = jd.make_step(effects=(jd.drag,), dt=1 / 240, substeps=2)


def descend(cost, x, learning_rate, updates):
    """Adam: the variables after the updates, and the cost before each."""
    optimizer = optax.adam(learning_rate)

    def update(carry, _):
        x, memory = carry
        value, gradient = jax.value_and_grad(cost)(x)
        change, memory = optimizer.update(gradient, memory)
        return (optax.apply_updates(x, change), memory), value

    run = jax.jit(lambda x: jax.lax.scan(update, (x, optimizer.init(x)), length=updates))
    (x, _), costs = run(x)
    return x, costs


# %% [markdown]
# ## Tuning a PID
# The PID of gym-pybullet-drones receives the position and velocity of the target, but flies a wider curve. The cost is
# the mean squared distance from the target over one and a half turns of a curve. The variables are the logarithms of a
# factor on each gain of the position loop, so gains stay positive. The attitude loop is not changed.

# %%
t = jnp.arange(1, 6 * HZ + 1) / HZ


def curve(t):
    """Target position at time t (s), m, world: a closed curve of 4 s with varying height."""
    angle = 2 * jnp.pi * t / 4
    return jnp.stack([0.4 * jnp.sin(angle), 0.4 * jnp.cos(angle), 1 + 0.2 * jnp.sin(2 * angle)])


targets = jax.vmap(curve)(t)


@jax.jit
def fly_curve(log_factors):
    """Positions (length, 3) of the flight with factors on the gains."""
    gains = pid.gains("cf2x")
    gains = gains.replace(**{name: getattr(gains, name) * jnp.exp(x) for name, x in log_factors.items()})
    pilot = functools.partial(pid.control, gains, dt=1 / HZ)

    def control(params, memory, state, k):
        target = curves.setpoint_on(curve, k / HZ)
        return jax.vmap(pilot)(params, memory, state, jax.tree.map(lambda x: x[None], target))

    first = curves.setpoint_on(curve, jnp.zeros(()))
    start = jd.State.at_rest(first.pos[None]).replace(vel=first.vel[None])
    memory = for_team(pid.init(), 1)
    return jd.rollout(step, control, jd.repeat(nominal, 1), start, memory, len(t))[1].pos[:, 0]


def miss(log_factors):
    return jnp.mean(jnp.sum((fly_curve(log_factors) - targets) ** 2, axis=-1))


ones = {name: jnp.zeros(3) for name in ("pos_p", "pos_i", "pos_d")}
tuned, costs = descend(miss, ones, 0.03, 60)

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.5), dpi=80, layout="constrained")
left.plot(100 * jnp.sqrt(costs))
left.set(xlabel="updates", ylabel="distance from the target, rms (cm)", ylim=(0, None), title="tuning")
right.plot(targets[:, 0], targets[:, 1], "--", color="grey", label="target")
for name, factors in ("gains of (2021)", ones), ("tuned", tuned):
    flown = fly_curve(factors)
    right.plot(flown[:, 0], flown[:, 1], label=name)
right.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title="path, from above")
right.legend(loc="center")
for name, x in tuned.items():
    print(f"factors on {name} (x, y, z):", np.round(np.exp(x), 2))
print(f"distance from the target, rms: {100 * costs[0] ** 0.5:.1f} cm before, {100 * costs[-1] ** 0.5:.1f} cm after")
assert costs[-1] < 0.5 * costs[0]

# %% [markdown]
# The path is as round as before and closer to the target. The gains are tuned only for this flight, in a simulation
# without noise and delay, where high gains have no disadvantage. For a real drone, add noise and delay to the
# simulation first.

# %% [markdown]
# ## Identifying a mass
# A drone with an unknown payload climbs by one meter, and its height is measured with 1 cm of noise. The controller
# assumes the nominal mass. The mass is estimated by nonlinear least squares (Gauss-Newton), with the derivative of the
# whole flight with respect to the mass, computed by `jax.jacfwd`. The curvature gives the standard error.


# %%
@jax.jit
def climb(mass):
    """Heights (length,) of a drone with a mass unknown to the controller."""
    pilot = functools.partial(pid.control, pid.gains("cf2x"), dt=1 / HZ)

    def control(params, memory, state, k):
        target = Setpoint.at(jnp.array([[0.0, 0.0, 2.0]]))
        return jax.vmap(pilot)(jd.repeat(nominal, 1), memory, state, target)

    start = jd.State.at_rest(jnp.array([[0.0, 0.0, 1.0]]))
    params = jd.repeat(nominal.replace(mass=mass), 1)
    return jd.rollout(step, control, params, start, for_team(pid.init(), 1), 3 * HZ)[1].pos[:, 0, 2]


TRUE_MASS, NOISE = 0.0312, 0.01  # kg, m
measured = climb(TRUE_MASS) + NOISE * jax.random.normal(jax.random.key(0), (3 * HZ,))


@jax.jit
def gauss_newton(mass):
    slope = jax.jacfwd(climb)(mass)
    return mass + slope @ (measured - climb(mass)) / (slope @ slope), NOISE / jnp.sqrt(slope @ slope)


guesses = [nominal.mass]
for _ in range(4):
    mass, standard_error = gauss_newton(guesses[-1])
    guesses.append(mass)
print(f"true {1000 * TRUE_MASS:.2f} g, identified {1000 * mass:.2f} +- {1000 * standard_error:.2f} g (standard error)")

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.5), dpi=80, layout="constrained")
left.plot(1000 * jnp.array(guesses), "o-")
left.axhline(1000 * TRUE_MASS, color="grey", linestyle="--", label="true mass")
left.set(xlabel="iterations", ylabel="mass (g)", title="Gauss-Newton")
left.legend()
t = jnp.arange(1, len(measured) + 1) / HZ
right.plot(t, measured, ".", markersize=2, color="grey", label="measured")
right.plot(t, climb(nominal.mass), label=f"nominal mass, {1000 * nominal.mass:.0f} g")
right.plot(t, climb(mass), label=f"identified mass, {1000 * mass:.1f} g")
right.set(xlabel="t (s)", ylabel="z (m)", title="climb")
right.legend()
assert abs(mass - TRUE_MASS) < 4 * standard_error

# %% [markdown]
# ## A trajectory through gates
# The variables are the control points of a cubic B-spline, the reference of a controller. The cost is a function of the
# *flown* path: it should pass through the center of every gate at a given time and perpendicular to it, and the curve
# should be smooth. The optimization therefore also compensates for the lag of the controller.

# %%
times = jnp.array([1.4, 2.6, 4.2, 5.4])  # s, at which the gates are to be passed
KNOT, POINTS = 0.25, 28  # s between control points, their number
LENGTH = 6 * HZ
start_pos = jnp.array([-1.0, 1.0, 1.0])
gates = jnp.asarray(GATES)
through = jnp.stack([jnp.cos(gates[:, 3]), jnp.sin(gates[:, 3]), 0 * gates[:, 3]], axis=-1)


def spline(points, t):
    """B-spline with control points (POINTS, 3) at time t (s)."""
    k = jnp.clip(jnp.floor(t / KNOT).astype(int), 0, POINTS - 4)
    u = t / KNOT - k
    weights = jnp.stack([(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3]) / 6
    return weights @ jax.lax.dynamic_slice(points, (k, 0), (4, 3))


@jax.jit
def fly_through(points):
    """Trajectory of a drone with a spline as its reference."""
    pilot = functools.partial(rates.control, rates.gains(), dt=1 / HZ)
    told = jax.vmap(functools.partial(curves.setpoint_on, functools.partial(spline, points)))(jnp.arange(LENGTH) / HZ)

    def control(params, memory, state, k):
        return jax.vmap(pilot)(params, memory, state, jax.tree.map(lambda x: x[k][None], told))

    start = jd.State.at_rest(start_pos[None])
    return jd.rollout(step, control, jd.repeat(nominal, 1), start, None, LENGTH)[1]


def misses(trajectory):
    """Distance of the path from the gates' axes (4, 5), m, at five moments about each passage, and along them (4,)."""
    rows = jnp.round((times[:, None] + jnp.linspace(-0.1, 0.1, 5)) * HZ).astype(int) - 1
    away = trajectory.pos[rows, 0] - gates[:, None, :3]
    along = jnp.sum(away * through[:, None], axis=-1)
    beside = away - along[..., None] * through[:, None]
    return beside, along[:, 2]


def race_cost(points):
    trajectory = fly_through(points)
    beside, along = misses(trajectory)
    backwards = jnp.maximum(0.5 - jnp.sum(trajectory.vel[jnp.round(times * HZ).astype(int), 0] * through, axis=-1), 0)
    bend = jnp.diff(points, 3, axis=0)
    return jnp.mean(beside**2) + jnp.mean(along**2) + 0.1 * jnp.mean(backwards**2) + 1e-3 * jnp.mean(bend**2)


# The first guess: straight lines from gate to gate.
knots = jnp.concatenate([jnp.zeros(1), times, jnp.array([6.0])])
corners = jnp.concatenate([start_pos[None], gates[:, :3], gates[3:, :3] + 0.6 * through[3:]])
guess = jax.vmap(lambda t: jax.vmap(lambda x: jnp.interp(t, knots, x), 1)(corners))(KNOT * (jnp.arange(POINTS) - 1.0))
points, costs = descend(race_cost, guess, 0.02, 120)

# %%
before, after = fly_through(guess), fly_through(points)
for name, trajectory in ("straight lines", before), ("optimized", after):
    beside, along = misses(trajectory)
    distance = 100 * jnp.linalg.norm(beside, axis=-1).max(axis=1)
    print(f"{name}: largest distance from the axis of each gate:", np.asarray(distance, float).round(1), "cm")

BOX = dict(facecolor="white", edgecolor="none", pad=1)
figure, axis = plt.subplots(figsize=(8, 4.2), dpi=80, layout="constrained")
for (x, y, _, yaw), name in zip(GATES, "1234", strict=True):
    dx, dy = -0.2 * np.sin(yaw), 0.2 * np.cos(yaw)
    axis.plot([x - dx, x + dx], [y - dy, y + dy], color="black", linewidth=3)
    axis.annotate(f"gate {name}", (x + 1.3 * dx, y + 1.3 * dy), ha="center", va="center", bbox=BOX)
for name, trajectory in ("told straight lines", before), ("told the optimized curve", after):
    axis.plot(trajectory.pos[:, 0, 0], trajectory.pos[:, 0, 1], label=name)
told = jax.vmap(functools.partial(spline, points))(jnp.arange(LENGTH) / HZ)
axis.plot(told[:, 0], told[:, 1], "--", linewidth=1, color="grey", label="the optimized curve itself")
axis.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title="6 s through four gates, from above")
axis.legend(loc="center left", bbox_to_anchor=(1, 0.5))

# %%
scene = Scene.of(*(gate(pos=g[:3], yaw=g[3]) for g in GATES))
gap = jax.jit(jax.vmap(scene.distance))(after.pos[:, 0]).min() - nominal.collision_radius
print(f"smallest distance between the drone and a gate's frame: {100 * gap:.1f} cm")
assert gap > 0
flights = {"optimized": after, "straight lines": before}
jd.show(flights, jd.repeat(nominal, 1), dt=1 / HZ, scene=scene, title="Four gates in 6 s")

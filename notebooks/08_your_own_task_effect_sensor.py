# %% [markdown]
# # Your own task, effect and sensor
# Extensions need only a few lines. This notebook adds an **effect**, a column of rising air; a **sensor**, a barometer
# with noise and a lag; and a **task**, to fly to and fro through the column at a constant height, measured only by the
# barometer. Then it trains a policy for the task.

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
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxdrones as jd
from jaxdrones.control import Setpoint
from jaxdrones.learning import bptt, evaluate
from jaxdrones.tasks import REACH_AND_STAY, ObservationTerm, Quantity, Task, out_of_control
from jaxdrones.training.episode import fly_episode
from jaxdrones.visualization.palette import COLORS

plt.rcParams |= {"axes.prop_cycle": plt.cycler(color=COLORS), "axes.grid": True, "grid.linewidth": 0.3}

# %% [markdown]
# ## An effect
# An effect is a function of one drone that returns a `Wrench`: force (N) and torque (N m) in body axes. Here a column
# of rising air, 0.6 m wide, pushes a drone up with at most 40 % of its weight.

# %%
RADIUS = 0.3  # m


def thermal(params, state):
    """Column of rising air at the origin."""
    distance_squared = state.pos[0] ** 2 + state.pos[1] ** 2
    lift = 0.4 * params.weight * jnp.exp(-distance_squared / (2 * RADIUS**2))
    return jd.Wrench.of_force(jd.rotation.rotate_inverse(state.quat, jd.vector.along_z(lift)))


params = jd.repeat(jd.load_params("cf2x"), 1)
step = jd.make_step(effects=(jd.drag, thermal), dt=1 / 500)
hover = params.hover_rpm[:, None] * jnp.ones(4)
for x in 0.0, 0.3, 1.0:
    rate = step.rate(params, jd.State.at_rest(jnp.array([[x, 0.0, 1.0]])), hover)
    print(f"at x = {x} m, at hover speed: acceleration {rate.vel[0, 2]:.2f} m/s^2 upwards")

# %% [markdown]
# ## A sensor
# A sensor measures one drone. It may have a memory: here the pressure inside the housing, expressed as a height, which
# follows the outside pressure with a lag. `entries` describe the reading for `jd.explain`.

# %%
NOISE, LAG, DT = 0.03, 0.1, 0.01  # m (standard deviation), s, s between measurements


def measure(key, params, state, rate, scene, memory):
    inside = memory + (state.pos[2] - memory) * (1 - jnp.exp(-DT / LAG))
    return inside, inside + NOISE * jax.random.normal(key)


def init(key, params):
    return jnp.asarray(HEIGHT, float)


HEIGHT = 1.5  # m, at which the barometer starts
barometer = jd.Sensor("barometer", measure, init, bound=10.0, entries=(Quantity("height", "m", "world"),))

# %% [markdown]
# ## A task
# A task is a function that returns a `Task`: start, target, rewards, terminations. Its arguments become options of
# `jd.make`. `jd.envs.check_env(env)` tests that an environment follows the interface.


# %%
def patrol(period: float = 6.0, duration: float = 6.0) -> Task:
    """Fly to and fro along x through the column of rising air, at a constant height."""

    def target(phase, t):
        """A point that moves 1 m either way along x."""
        angle = 2 * jnp.pi * (phase + t / period)
        zero = jnp.zeros_like(angle)
        pos = jnp.stack([jnp.sin(angle), zero, zero + HEIGHT], axis=-1)
        return Setpoint.at(pos, vel=2 * jnp.pi / period * jnp.stack([jnp.cos(angle), zero, zero], axis=-1))

    def start(key, params):
        """At rest within 0.3 m of the target, which starts anywhere on its way."""
        phase_key, place_key = jax.random.split(key)
        phase = jax.random.uniform(phase_key, (1,))
        away = jax.random.uniform(place_key, (1, 3), minval=-0.3, maxval=0.3)
        return jd.State.at_rest(target(phase, 0.0).pos + away), phase  # the state, and the variables of the task

    def height_error(task, world):
        """Squared error of the height, m^2."""
        return (world.drones.pos[:, 2] - HEIGHT) ** 2

    def beside(task, world):
        """The target relative to the drone, seen from above, m."""
        return (task.target_now(world).pos - world.drones.pos)[:, :2]

    def followed(metrics, dt):
        """Whether a drone was within 20 cm of the target on average after the first two seconds."""
        return jnp.mean(metrics["error"][round(2 / dt) :], axis=0) < 0.2

    entries = tuple(Quantity(f"{axis} of the target, from the drone", "m", "world") for axis in "xy")
    return Task(
        name="patrol",
        summary="fly to and fro through a column of rising air",
        drones=1,
        duration=duration,
        start=start,
        target=target,
        rewards=REACH_AND_STAY | {"height_error": (-2.0, height_error)},  # name -> (weight, term)
        terminations=out_of_control(4.0),
        success=followed,
        observations={"beside": ObservationTerm(beside, 10.0, entries=entries)},
        observation=("beside", "barometer", "velocity_error", "rotation_matrix", "omega", "last_action"),
        control_hz=1 / DT,
    )


env = jd.make(patrol, effects=(jd.drag, thermal), sensors=(barometer,))
for entry in jd.explain(env).observation[:3]:
    print(entry.term, entry.quantity)

# %% [markdown]
# ## Training
# The gradient passes through the custom effect, sensor and task.

# %%
config = bptt.Config(updates=120, worlds=64)
result = bptt.train(jax.random.key(0), env, config)

reward = np.asarray(result.history["reward"])
steps = np.arange(1, len(reward) + 1) * config.worlds * config.horizon
figure, axis = plt.subplots(figsize=(6, 3.2), dpi=80, layout="constrained")
axis.plot(steps / 1e6, reward)
axis.set(xlabel="control steps flown (million)", ylabel="reward per step, in training", title="BPTT, one seed")

report = evaluate(env, result.policy, jax.random.key(1), episodes=200)
low, high = report.success_interval
print(f"success {report.success:.1%} (95 % interval {low:.1%} to {high:.1%}) in 200 episodes")
print(f"distance from the target, rms: {100 * report.rms_error:.1f} cm")
assert report.success > 0.8

# %%
log = fly_episode(env, result.policy, jax.random.key(2))
figure, axis = plt.subplots(figsize=(7, 3.2), dpi=80, layout="constrained")
axis.axvspan(-RADIUS, RADIUS, color=COLORS[5], alpha=0.3, label="rising air")
axis.plot(log.target[:, 0, 0], log.target[:, 0, 2], "--", color="grey", label="target")
axis.plot(log.drones.pos[:, 0, 0], log.drones.pos[:, 0, 2], label="drone")
axis.set(xlabel="x (m)", ylabel="z (m)", ylim=(1.0, 2.0), title="6 s, from the side")
axis.legend()

# %%
jd.show(log)

# %% [markdown]
# Tasks and effects in a file also work at the shell: `jaxdrones train my_task.py:patrol`.

"""The paper's four control flights (its figures 6 to 9), for any vehicle, effects and controller."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones import rotation
from jaxdrones.backends.explicit import make_step
from jaxdrones.backends.rollout import rollout
from jaxdrones.checks import check_choice, check_positive, check_whole
from jaxdrones.control import CONTROLLERS, Setpoint, pid, velocity
from jaxdrones.dynamics import EFFECTS, INTEGRATORS, PAIRS, ROTORS
from jaxdrones.params import Params, repeat
from jaxdrones.record import Record
from jaxdrones.state import State
from jaxdrones.tasks import curves
from jaxdrones.urdf import load_params

PHYSICS_HZ = 240  # at least; raised to a multiple of the control rate

_START_SPREAD = 0.01  # m; standard deviation of the start when a seed is given

_DIRECTIONS = np.array([[-0.5, 1.0, 0.0], [0.0, 1.0, 0.0], [0.2, 1.0, 0.2], [0.0, 1.0, 0.5]])
_HEADINGS = np.array([0, np.pi / 3, np.pi / 4, np.pi / 2])  # rad


@dataclasses.dataclass(frozen=True)
class Flight:
    """One of the paper's flights and its defaults."""

    summary: str
    start: Callable[[int], State]  # number of drones -> state
    target: Callable[[int, jax.Array, float], Setpoint | jax.Array]  # (drones, time, duration) -> set points or actions
    drones: int
    duration: float  # s
    control_hz: int
    effects: tuple[str, ...] = ()
    settled: float = 2.0  # s; results are taken from here on
    panels: tuple[str, ...] = ()  # of the figure; all when empty
    labels: tuple[str, ...] = ()
    adapt: Callable[[Params], Params] = lambda team: team
    any_number: bool = True


def _circle() -> Flight:
    curve = curves.circle()

    def yaw(n):
        return jnp.arange(n) * (jnp.pi / 2) / n

    return Flight(
        summary="a circle at staggered heights, each drone with a heading of its own (PID)",
        start=lambda n: State.at_rest(curve.positions(n), yaw(n)),
        target=lambda n, t, duration: Setpoint.at(curve.positions(n, t), yaw=yaw(n)),
        drones=4,
        duration=12.0,
        control_hz=120,
    )


def _velocity() -> Flight:
    def start(n):
        i = jnp.arange(n)
        pos = jnp.stack([0.3 * i, jnp.zeros(n), jnp.full(n, 0.1)], axis=-1)
        return State.at_rest(pos, jnp.asarray(_HEADINGS)[i % 4])

    def action(n, t, duration):
        i = jnp.arange(n) % 4
        reverse = t >= duration * (1 / 8 + i / 6)
        direction = jnp.asarray(_DIRECTIONS)[i] * jnp.where(reverse, -1, 1)[:, None]
        return jnp.concatenate([direction, jnp.full((n, 1), 0.99)], axis=-1)

    return Flight(
        summary="steps of the velocity input, reversed one drone after the other",
        start=start,
        target=action,
        drones=4,
        duration=12.0,
        control_hz=120,
        settled=10.0,
    )


def _ground_effect() -> Flight:
    curve = curves.hop()
    return Flight(
        summary="a take-off with and without ground effect (equation 5)",
        start=lambda n: State.at_rest(jnp.tile(jnp.array([[0.0, 0.0, 0.014]]), (n, 1))),
        target=lambda n, t, duration: Setpoint.at(curve.positions(n, t)),
        drones=2,
        duration=0.5,
        control_hz=240,
        effects=("ground_effect_paper",),
        settled=0.0,
        panels=("z", "vz", "rpm0"),
        labels=("with ground effect", "without"),
        adapt=lambda team: team.replace(ground_effect_coeff=team.ground_effect_coeff.at[1].set(0)),
        any_number=False,
    )


def _downwash() -> Flight:
    def curve(n):
        return curves.crossing(n)

    return Flight(
        summary="drones that cross above each other, subject to downwash (equation 6)",
        start=lambda n: State.at_rest(curve(n).positions(n)),
        target=lambda n, t, duration: Setpoint.at(curve(n).positions(n, t)),
        drones=2,
        duration=12.0,
        control_hz=120,
        effects=("downwash_paper",),
        settled=3.0,
        panels=("x", "vx", "z", "vz", "pitch", "omega_y", "rpm0", "rpm1"),
    )


FLIGHTS = {"circle": _circle(), "velocity": _velocity(), "ground-effect": _ground_effect(), "downwash": _downwash()}


def fly(
    name: str,
    vehicle: str = "cf2x",
    drones: int | None = None,
    effects: Sequence[str] | None = None,
    controller: str | None = None,
    control_hz: int | None = None,
    duration: float | None = None,
    rotors: str = "instant",
    integrator: str = "semi_implicit_euler",
    seed: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> Record:
    """Fly one of `FLIGHTS`; what is left out is the flight's own.

    Args:
        name: `circle`, `velocity`, `ground-effect` or `downwash`.
        vehicle: a bundled vehicle or the path of a URDF.
        drones: number of drones.
        effects: names of `EFFECTS` and `PAIRS`.
        controller: a name of `CONTROLLERS`; the vehicle's own when left out.
        control_hz: control rate, Hz; physics runs at the next multiple from 240 Hz on.
        duration: s.
        rotors: `instant` or `lagging`.
        integrator: a name of `INTEGRATORS`.
        seed: of a random start, 1 cm about the flight's own; no disturbance when left out.
        progress: is told now and then which share of the flight is flown.

    Raises:
        ValueError: an unknown name or a number out of range; says what, what was given, what to do.
    """
    check_choice("flight", name, FLIGHTS)
    check_choice("rotors", rotors, ROTORS)
    check_choice("integrator", integrator, INTEGRATORS)
    flight = FLIGHTS[name]
    n = flight.drones if drones is None else drones
    duration = flight.duration if duration is None else duration
    control_hz = flight.control_hz if control_hz is None else control_hz
    effects = flight.effects if effects is None else effects
    if controller is None:
        controller = "pid" if name == "velocity" or vehicle in pid.VEHICLES else "geometric"
    check_whole("drones", n)
    check_whole("control rate (Hz)", control_hz)
    check_positive("duration", duration, "s")
    check_choice("controller", controller, CONTROLLERS)
    for effect in effects:
        check_choice("effect", effect, EFFECTS | PAIRS)
    if n != flight.drones and not flight.any_number:
        raise ValueError(f"drones is {n}; the {name} flight takes {flight.drones}: {', '.join(flight.labels)}")
    if name == "velocity" and controller != "pid":
        raise ValueError(f"controller is {controller!r}; the velocity flight is flown by 'pid'")

    dt = 1 / control_hz
    substeps = math.ceil(PHYSICS_HZ / control_hz)
    steps = round(duration * control_hz)
    if steps == 0:
        raise ValueError(f"duration is {duration} s, less than half a control period; give {dt:.4g} s or more")
    pilot, memory = _pilot(name, controller, vehicle, n, dt)
    step = make_step(
        effects=[EFFECTS[effect] for effect in effects if effect in EFFECTS],
        pairs=[PAIRS[effect] for effect in effects if effect in PAIRS],
        rotors=ROTORS[rotors],
        integrator=INTEGRATORS[integrator],
        dt=dt / substeps,
        substeps=substeps,
    )

    def control(params, memory, state, k):
        if progress is not None:
            _report(k, steps, progress)
        return jax.vmap(pilot)(params, memory, state, flight.target(n, k * dt, duration))

    @jax.jit  # all of it: one compilation instead of one for every small operation
    def fly_all(params: Params) -> dict[str, jax.Array]:
        team = flight.adapt(repeat(params, n))
        _, trajectory = rollout(step, control, team, _start(flight, n, seed), memory, steps)
        t = dt * jnp.arange(1, steps + 1)
        target = jax.vmap(lambda t: flight.target(n, t, duration))(t)
        target_pos, target_vel = _targets(target, team)
        rpy = jax.vmap(jax.vmap(rotation.to_rpy))(trajectory.quat)
        return dict(vars(trajectory), t=t, rpy=rpy, target_pos=target_pos, target_vel=target_vel)

    log = jax.device_get(fly_all(load_params(vehicle)))
    jax.effects_barrier()
    conditions = dict(
        flight=name,
        vehicle=str(vehicle),
        drones=n,
        controller=controller,
        control_hz=control_hz,
        physics_hz=control_hz * substeps,
        integrator=integrator,
        rotors=rotors,
        effects=list(effects),
        duration=steps * dt,
        seed=seed,
    )
    return Record(**log, labels=flight.labels or tuple(f"drone {i}" for i in range(n)), conditions=conditions)


def _pilot(flight: str, controller: str, vehicle: str, n: int, dt: float):
    """The controller of one drone, and fresh memory for n."""
    if flight == "velocity":
        return functools.partial(velocity.control, pid.gains(vehicle), dt=dt), pid.init(n)
    module = CONTROLLERS[controller]
    gains = pid.gains(vehicle) if module is pid else module.gains()
    return functools.partial(module.control, gains, dt=dt), module.init(n)


def _start(flight: Flight, n: int, seed: int | None) -> State:
    state = flight.start(n)
    if seed is None:
        return state
    return state.replace(pos=state.pos + _START_SPREAD * jax.random.normal(jax.random.key(seed), state.pos.shape))


def _report(k: jax.Array, steps: int, progress: Callable[[float], None]) -> None:
    """Tell the host, at every hundredth of the flight, which share of it is flown."""
    every = max(1, steps // 100)

    def tell():
        jax.debug.callback(lambda k: progress(float(k + 1) / steps), k)

    jax.lax.cond((k + 1) % every == 0, tell, lambda: None)


def _targets(target: Setpoint | jax.Array, params: Params) -> tuple[jax.Array, jax.Array]:
    """Commanded positions and velocities over time; NaN for the one that is not commanded."""
    if isinstance(target, Setpoint):
        return target.pos, jnp.full_like(target.pos, jnp.nan)
    vel = jax.vmap(jax.vmap(velocity.commanded), (None, 0))(params, target)
    return jnp.full_like(vel, jnp.nan), vel

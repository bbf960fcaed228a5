"""Gradient-based tuning of a controller's gains in simulated test flights."""

import functools
from types import ModuleType
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from jaxdrones import control, rotation
from jaxdrones.accelerate.compiler import training_options
from jaxdrones.arguments import Count, checked, whole
from jaxdrones.checks import look_up, short_repr
from jaxdrones.control import Setpoint, firmware_pid, for_team, geometric, mellinger, pid, rates, simple_pid
from jaxdrones.dynamics.aero import drag
from jaxdrones.dynamics.rotors import lagging_rotors
from jaxdrones.engine.explicit import make_step
from jaxdrones.engine.rollout import rollout
from jaxdrones.errors import UserError
from jaxdrones.params import Params, check_single, repeat
from jaxdrones.state import State
from jaxdrones.tasks.curves import RANDOM_NUMBERS, SHAPES, setpoint_on
from jaxdrones.urdf import load_params
from jaxdrones.vector import safe_sqrt

_PID = {"pos_p": 2, "pos_i": 3, "pos_d": 1, "rpy_p": 2, "rpy_i": 3, "rpy_d": 1}
_TUNED: dict[ModuleType, dict[str, int]] = {
    pid: _PID,
    simple_pid: _PID,
    geometric: {"pos": 2, "vel": 1, "attitude": 2, "rate": 1},
    rates: {"pos": 2, "vel": 1, "attitude": 1, "rate": 1},
    firmware_pid: {"pos_p": 1, "pos_i": 2, "vel_p": 1, "vel_i": 2, "attitude_p": 1, "attitude_i": 2, "attitude_d": 0}
    | {"rate_p": 1, "rate_i": 2, "rate_d": 0},
    mellinger: {"pos_p": 2, "pos_i": 3, "pos_d": 1, "attitude_p": 2, "attitude_i": 3, "rate_p": 1, "rate_d": 0},
}
"""Tuned gains, each with the power k of 1/s in its unit: a loop s times as fast has gains s^k times as large.

Limits and the nominal vehicle parameters of a controller are not tuned.
"""
_OUTER = ("pos", "vel")  # prefixes of the gains of the outer loop; the other gains are of the inner loop
_OUTER_SPEEDS = (1.0, 0.6, 0.3)  # tested loop speeds relative to the initial gains
_INNER_SPEEDS = (2.0, 1.0, 0.5, 0.25)

_SECONDS = 3.0  # s, duration of the flights for the gradient
_EVALUATION_SECONDS = 8.0  # s, duration of the final evaluation, long enough for slow instabilities
_FRACTIONS = (0.0, 0.25, 0.5, 0.75, 1.0)  # fractions of the step from the initial to the optimized gains, in logarithms
_SMOOTHING = 2e-3  # m; below it the penalty on the distance is quadratic
_CURVES = (("circle", 5.0), ("figure-eight", 4.0), ("lissajous", 7.0))  # period, s
_FLIGHTS = 24  # eight of each of three vehicles
_LAG_FACTOR = 1.5  # rotor lag of the heavy vehicle over that of the vehicle
_MASS_FACTOR = 1.2  # its mass and inertia over those of the vehicle
_LEARNING_RATE = 0.1  # for the logarithm of a gain, at the first iteration; it decays to zero
_MAX_DETERIORATION = 0.5  # tolerated increase of the error of a single flight
_FINAL_WEIGHT = 0.5  # weight of the distance in the last second
_HEADING_WEIGHT = 0.2  # m; of the heading error, in the error of a flight
_RATE_WEIGHT = 2e-3  # m per (rad/s)^2
_MAX_GRAD_NORM = 3.0  # largest norm of the gradient of a flight
_EFFORT_WEIGHT = 1e-5  # m s^2; of the squared rate of the rotor speeds over hover speed


@checked
def tune(
    params: Params,
    controller: str | ModuleType,
    *,
    control_hz: Annotated[int, whole(minimum=100)] = 500,
    iterations: Count = 40,
) -> Any:
    """Tune the gains of a controller for a vehicle, in steps, a turn, a tilted start and three curves.

    The optimization starts from two sets of gains: the controller's own, scaled to the vehicle, and the best of several
    sets with faster or slower loops. It minimizes the mean error of flights of 3 s with drag of three vehicles: the
    vehicle itself, one with instant rotors, and one with 20 % more mass and inertia and 50 % more rotor lag. The
    optimized gains, and those at a quarter, half and three quarters of the step to them, are then evaluated in flights
    of 8 s. The result is the best set without a much worse flight than with the initial gains, possibly these. Another
    vehicle needs no compilation.

    Args:
        params: parameters of one drone.
        controller: a name of `jaxdrones.control.CONTROLLERS`, or its module; except `mrac`, which adapts its gains.
        control_hz: calls of the controller per second, a lower bound for the use of the gains.
        iterations: number of iterations of Adam.

    Returns:
        Gains for the `control` of the controller.

    Raises:
        ValueError: an unknown controller, one without gains to tune, one that is unstable with the vehicle, or
            parameters of a team.
    """
    module = _tunable(controller)
    check_single("params.mass", params, "tune takes the parameters of a single drone")
    gains, error = _compiled()(module, control_hz, iterations, params, start(module, params))
    if not jnp.isfinite(error):
        raise UserError(f"{_name(module)} cannot fly this vehicle with any gains that were tried; use 'geometric'")
    return gains


def start(module: ModuleType, params: Params) -> Any:
    """Initial gains of `tune`: those of the controller, scaled to the vehicle."""
    if module in (firmware_pid, mellinger):
        return module.gains(params)
    if module is pid and not pid.fits(params):
        raise UserError("pid commands the PWM of a Crazyflie, which this vehicle is not; tune another controller")
    gains = module.gains()
    if module is not simple_pid:
        return gains
    known = load_params("hb")
    force, torque = params.weight / known.weight, params.inertia / known.inertia
    scales = {name: force if name.startswith("pos") else torque for name in _TUNED[module]}
    return gains.replace(**{name: getattr(gains, name) * scale for name, scale in scales.items()})


def _tunable(controller: str | ModuleType) -> ModuleType:
    if isinstance(controller, str):
        controller = look_up("controller", controller, control.CONTROLLERS)
    if not isinstance(controller, ModuleType) or controller not in _TUNED:
        known = ", ".join(map(_name, _TUNED))
        raise UserError(f"{_name(controller)} has no gains that could be tuned; give one of {known}")
    return controller


def _name(module: Any) -> str:
    return module.__name__.rpartition(".")[2] if isinstance(module, ModuleType) else short_repr(module)


@functools.cache
def _compiled() -> Any:
    return jax.jit(_descend, static_argnums=(0, 1, 2), compiler_options=training_options(large_arrays=False))


def _descend(module: ModuleType, hz: int, iterations: int, params: Params, start: Any) -> tuple[Any, Float[Array, ""]]:
    """Best gains of two descents, from the initial gains and from the best loop speeds, and their error."""

    def gains_of(logarithms: dict[str, Array]) -> Any:
        return start.replace(**{name: getattr(start, name) * jnp.exp(x) for name, x in logarithms.items()})

    def with_speeds(outer: Float[Array, ""], inner: Float[Array, ""]) -> dict[str, Array]:
        speeds = {name: outer if name.startswith(_OUTER) else inner for name in _TUNED[module]}
        return {
            name: jnp.full_like(getattr(start, name), power * jnp.log(speeds[name]))
            for name, power in _TUNED[module].items()
        }

    def errors(each: dict[str, Array], seconds: float = _SECONDS) -> Float[Array, "sets flights"]:
        return _errors_of_flights(module, params, hz, seconds, jax.vmap(jax.vmap(gains_of))(each))

    def in_each_flight(logarithms: dict[str, Array]) -> dict[str, Array]:
        return jax.tree.map(lambda x: jnp.repeat(x[:, None], _FLIGHTS, axis=1), logarithms)

    def total(each: dict[str, Array]) -> tuple[Float[Array, ""], Float[Array, " sets"]]:
        of_flights = errors(each)
        return jnp.sum(of_flights), _finite(jnp.mean(of_flights, axis=1))

    def advance(carry: tuple, _: None) -> tuple[tuple, None]:
        at, memory, best, lowest = carry
        (_, value), gradients = jax.value_and_grad(total, has_aux=True)(in_each_flight(at))
        best = jax.vmap(lambda better, *two: jax.tree.map(lambda x, y: jnp.where(better, x, y), *two))(
            value < lowest, at, best
        )
        gradient = jax.tree.map(lambda x: jnp.mean(x, axis=1), jax.vmap(jax.vmap(_clipped))(gradients))
        change, memory = optimizer.update(gradient, memory)
        return (optax.apply_updates(at, change), memory, best, jnp.minimum(value, lowest)), None

    optimizer = optax.adam(optax.cosine_decay_schedule(_LEARNING_RATE, iterations))
    speeds = jnp.meshgrid(jnp.asarray(_OUTER_SPEEDS, float), jnp.asarray(_INNER_SPEEDS, float))
    starts = jax.vmap(with_speeds)(*(x.ravel() for x in speeds))
    fastest = jnp.argmin(_finite(jnp.mean(errors(in_each_flight(starts)), axis=1)))
    two = jax.tree.map(lambda x: jnp.stack([jnp.zeros_like(x[0]), x[fastest]]), starts)
    carry = (two, optimizer.init(two), two, jnp.full(2, jnp.inf, params.mass.dtype))
    found = jax.lax.scan(advance, carry, length=iterations)[0][2]
    shares = jnp.asarray(_FRACTIONS, float)
    candidates = jax.tree.map(lambda x: jnp.concatenate([share * x for share in shares]), found)
    costs = _costs(errors(in_each_flight(candidates), _EVALUATION_SECONDS))
    return gains_of(jax.tree.map(lambda x: x[jnp.argmin(costs)], candidates)), jnp.min(costs)


def _finite(error: Float[Array, " sets"]) -> Float[Array, " sets"]:
    """Errors, infinite where they are not finite."""
    return jnp.where(jnp.isfinite(error), error, jnp.inf)


def _costs(errors: Float[Array, "gains flights"]) -> Float[Array, " gains"]:
    """Mean error plus the largest deterioration beyond `_MAX_DETERIORATION`; infinite if a flight diverges.

    The deterioration of a flight is measured against the first gains.
    """
    first = jnp.where(jnp.isfinite(errors[:1]), errors[:1], jnp.inf)
    return _finite(jnp.mean(errors, axis=-1) + jnp.max(jnp.maximum(errors - first - _MAX_DETERIORATION, 0), axis=-1))


def _clipped(gradient: dict[str, Array]) -> dict[str, Array]:
    """Gradient of a flight, clipped to `_MAX_GRAD_NORM`; zero if not finite, as in a tumbling flight."""
    length = optax.tree.norm(gradient)
    share = jnp.minimum(1, _MAX_GRAD_NORM / jnp.maximum(length, _MAX_GRAD_NORM))
    return jax.tree.map(lambda x: jnp.where(jnp.isfinite(length), share * x, 0), gradient)


def _errors_of_flights(
    module: ModuleType, params: Params, hz: int, seconds: float, gains: Any
) -> Float[Array, "sets flights"]:
    """Errors of the test flights of sets of gains, with a first axis of sets and a second of `_FLIGHTS`.

    The flights are simulated as those of one team without interaction: a team under `vmap` takes longer to compile.
    """

    def lagging(times: float) -> Params:
        names = ("rotor_rise_time", "rotor_fall_time")
        return params.replace(**{name: jnp.maximum(times * getattr(params, name), 1 / hz) for name in names})

    slow = lagging(_LAG_FACTOR).replace(mass=_MASS_FACTOR * params.mass, inertia=_MASS_FACTOR * params.inertia)
    vehicles = (lagging(0), lagging(1), slow)
    start, targets = _starts_and_targets(params, hz, seconds)
    sets, each = len(jax.tree.leaves(gains)[0]), len(start.pos)

    def of_all(x: Array, axis: int = 0) -> Array:
        """One entry for each flight of all vehicles and sets, from those of a vehicle."""
        return jnp.concatenate([x] * (sets * len(vehicles)), axis)

    team = jax.tree.map(lambda *x: jnp.concatenate(x * sets), *(repeat(vehicle, each) for vehicle in vehicles))
    targets = jax.tree.map(functools.partial(of_all, axis=1), targets)
    step = make_step([drag], rotors=lagging_rotors, dt=1 / hz)
    call = jax.vmap(functools.partial(module.control, dt=1 / hz))
    gains = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), gains)

    def fly(team: Params, memory: Any, state: State, k: Array) -> tuple[Any, Array]:
        return call(gains, team, memory, state, jax.tree.map(lambda x: x[k], targets))

    memory = for_team(module.init(), len(team.mass))
    states = rollout(step, fly, team, jax.tree.map(of_all, start), memory, len(targets.yaw))[1]
    return _error(params, hz, states, targets).reshape(sets, -1)


def _error(params: Params, hz: int, flown: State, targets: Setpoint) -> Float[Array, " flights"]:
    """Logarithm of the error of each flight: distance, heading, body rates, rotor accelerations, final distance."""
    distance = safe_sqrt(jnp.sum((flown.pos - targets.pos) ** 2, axis=-1) + _SMOOTHING**2)
    x = jax.vmap(jax.vmap(lambda quat: rotation.axes(quat)[0]))(flown.quat)
    heading = 1 - (x[..., 0] * jnp.cos(targets.yaw) + x[..., 1] * jnp.sin(targets.yaw))
    effort = jnp.diff(flown.rpm, axis=0) * (hz / params.hover_rpm)
    error = jnp.mean(distance, axis=0) + _HEADING_WEIGHT * jnp.mean(heading, axis=0)
    error = error + _RATE_WEIGHT * jnp.mean(jnp.sum(flown.omega**2, axis=-1), axis=0)
    error = error + _EFFORT_WEIGHT * jnp.mean(jnp.mean(effort**2, axis=-1), axis=0)
    return jnp.log(error) + _FINAL_WEIGHT * jnp.log(jnp.mean(distance[-hz:], axis=0))


def _starts_and_targets(params: Params, hz: int, seconds: float) -> tuple[State, Setpoint]:
    """Starts (8, ...) and setpoints (steps, 8, ...): three steps, a turn, a tilted start and three curves."""
    random = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, RANDOM_NUMBERS), float)

    def point(shape: str, period: float, t: Array) -> Array:
        return SHAPES[shape](random, t / period)

    def all_at(t: Array) -> Setpoint:
        curves = (setpoint_on(functools.partial(point, *curve), t) for curve in _CURVES)
        return jax.tree.map(lambda *x: jnp.stack(x), *[Setpoint.at(jnp.zeros(3))] * 5, *curves)

    targets = jax.vmap(all_at)(jnp.arange(1, round(seconds * hz) + 1) / hz)
    first = all_at(jnp.zeros(()))
    # The steps, m, are not along the arms, so that the axes are coupled.
    steps = jnp.array([[0.5, 0.2, 0.0], [-1.0, 0.6, 0.5], [0.0, 0.0, 0.5]])
    aside = jnp.concatenate([steps, jnp.zeros((2, 3)), first.pos[5:]])
    turned = jnp.zeros((8, 3)).at[3, 2].set(1.0).at[4, 0].set(0.6).at[4, 1].set(0.4)  # rad
    start = State(
        pos=aside,
        quat=jax.vmap(rotation.from_rpy)(turned),
        vel=first.vel,
        omega=turned.at[3].set(0),
        rpm=jnp.full((8, 4), 1.0) * params.hover_rpm,
    )
    return start, targets

"""Gains for a vehicle, by the gradient of the simulation on a battery of steps and curves."""

from __future__ import annotations

import functools
from collections.abc import Callable
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from jaxdrones import control, rotation
from jaxdrones.checks import check_choice, check_params, check_shape, check_whole, shown
from jaxdrones.control import Setpoint, firmware_pid, for_team, geometric, mellinger, pid, rates, simple_pid
from jaxdrones.dynamics import drag, lagging_rotors
from jaxdrones.engine.explicit import make_step
from jaxdrones.engine.rollout import rollout
from jaxdrones.params import Params, repeat
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
"""Gains that are tuned, each with the power k of 1/s in its unit: a loop s times as fast has gains s^k times as large.

Limits, and what a controller believes of the vehicle, stay.
"""
_OUTER = ("pos", "vel")  # how the names of the gains of the outer loop begin; the others are of the inner one
_OUTER_SPEEDS = (1.0, 0.6, 0.3)  # of the loops, times those of the start, from which the best is taken
_INNER_SPEEDS = (2.0, 1.0, 0.5, 0.25)

_SECONDS = 3.0  # of a flight whose gradient is followed
_LONG = 8.0  # s, of a flight by which gains are judged in the end: what swings up slowly shows
_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)  # of the way from the start to what was found, in logarithms
_SMALL = 2e-3  # m; smaller distances count by their squares
_CURVES = (("circle", 5.0), ("figure-eight", 4.0), ("lissajous", 7.0))  # s, period
_SLUGGISH = 1.5  # times the lag of the rotors, of the other vehicle that flies the battery
_HEAVY = 1.2  # times mass and inertia
_LEARNING_RATE = 0.1  # of the logarithm of a gain, at the first iteration; zero after the last
_WORSE = 0.5  # by which the error of a flight may be larger than at the start, if the mean is smaller
_LEFT = 0.5  # weight of what is left of the distance in the last second
_YAW = 0.2  # m per rad of heading, in the error of a flight
_RATES = 2e-3  # m per (rad/s)^2
_STEEPEST = 3.0  # length of the gradient of a flight
_EFFORT = 1e-5  # m s^2, of the square of the rate of the rotor speeds over that of hover


def tune(params: Params, controller: str | ModuleType, *, control_hz: int = 500, iterations: int = 40) -> Any:
    """Gains with which a controller flies a vehicle well: steps, a turn, a tilted start and three curves.

    It starts twice, from the controller's own gains, scaled to the vehicle, and from those with faster or slower loops
    that fly best, and follows the gradient of the mean error through flights of 3 s with drag: of the vehicle, of one
    with rotors that follow at once, and of one that is a fifth heavier and whose rotors lag by half more. The
    gains found, and those a quarter, half and three quarters of the way to them, then fly 8 s. What comes back flew
    best, no flight much worse than at the start, which it may be. A second vehicle needs no second compilation.

    Args:
        params: parameters of one drone.
        controller: a name of `jaxdrones.control.CONTROLLERS`, or its module; but for `mrac`, which adapts by itself.
        control_hz: calls of the controller per second, at which the gains will be used, or at a higher rate.
        iterations: of Adam.

    Returns:
        Gains of the controller's kind.

    Raises:
        ValueError: an unknown controller, one without gains to tune, one that cannot fly the vehicle, or parameters of
            a team.
    """
    module = _with_gains(controller)
    check_params(params)
    check_shape("params.mass", params.mass, (), "tune takes the parameters of a single drone")
    check_whole("control_hz", control_hz, 100)
    check_whole("iterations", iterations)
    gains, error = _descend(module, control_hz, iterations, params, start(module, params))
    if not jnp.isfinite(error):
        raise ValueError(f"{_name(module)} cannot fly this vehicle with any gains that were tried; use 'geometric'")
    return gains


def start(module: ModuleType, params: Params) -> Any:
    """The gains of a controller, in units of the vehicle, from which `tune` starts."""
    if module in (firmware_pid, mellinger):
        return module.gains(params)
    if module is pid and not pid.fits(params):
        raise ValueError("pid commands the PWM of a Crazyflie, which this vehicle is not; tune another controller")
    gains = module.gains()
    if module is not simple_pid:
        return gains
    known = load_params("hb")
    force, torque = params.weight / known.weight, params.inertia / known.inertia
    scales = {name: force if name.startswith("pos") else torque for name in _TUNED[module]}
    return gains.replace(**{name: getattr(gains, name) * scale for name, scale in scales.items()})


def _with_gains(controller: str | ModuleType) -> ModuleType:
    """The module of a controller that can be tuned."""
    if isinstance(controller, str):
        check_choice("controller", controller, control.CONTROLLERS)
        controller = control.CONTROLLERS[controller]
    if not isinstance(controller, ModuleType) or controller not in _TUNED:
        known = ", ".join(map(_name, _TUNED))
        raise ValueError(f"{_name(controller)} has no gains that could be tuned; give one of {known}")
    return controller


def _name(module: Any) -> str:
    return module.__name__.rpartition(".")[2] if isinstance(module, ModuleType) else shown(module)


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _descend(module: ModuleType, hz: int, iterations: int, params: Params, start: Any) -> tuple[Any, Float[Array, ""]]:
    """The best gains on two ways down, from the start and from its best speeds of the loops, and their long error."""

    def gains_of(logarithms: dict[str, Array]) -> Any:
        return start.replace(**{name: getattr(start, name) * jnp.exp(x) for name, x in logarithms.items()})

    def with_speeds(outer: Float[Array, ""], inner: Float[Array, ""]) -> dict[str, Array]:
        speeds = {name: outer if name.startswith(_OUTER) else inner for name in _TUNED[module]}
        return {
            name: jnp.full_like(getattr(start, name), power * jnp.log(speeds[name]))
            for name, power in _TUNED[module].items()
        }

    def each_flight(at: dict[str, Array]) -> dict[str, Array]:
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (flights, *x.shape)), at)

    def errors(each: dict[str, Array]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        of_flights = flown(jax.vmap(gains_of)(each))
        value = jnp.mean(of_flights)
        return jnp.sum(of_flights), jnp.where(jnp.isfinite(value), value, jnp.inf)

    def advance(carry: tuple, _: None) -> tuple[tuple, None]:
        at, memory, best, lowest = carry
        (_, value), gradients = jax.value_and_grad(errors, has_aux=True)(each_flight(at))
        best = jax.tree.map(lambda x, y: jnp.where(value < lowest, x, y), at, best)
        gradient = jax.tree.map(lambda x: jnp.mean(x, axis=0), jax.vmap(_limited)(gradients))
        change, memory = optimizer.update(gradient, memory)
        return (optax.apply_updates(at, change), memory, best, jnp.minimum(value, lowest)), None

    def descend(at: dict[str, Array]) -> tuple[dict[str, Array], Float[Array, ""]]:
        carry = (at, optimizer.init(at), at, jnp.full((), jnp.inf, params.mass.dtype))
        return jax.lax.scan(advance, carry, length=iterations)[0][2:]

    flights, flown = _battery(module, params, hz, _SECONDS)
    optimizer = optax.adam(optax.cosine_decay_schedule(_LEARNING_RATE, iterations))
    speeds = jnp.meshgrid(jnp.asarray(_OUTER_SPEEDS, float), jnp.asarray(_INNER_SPEEDS, float))
    starts = jax.vmap(with_speeds)(*(x.ravel() for x in speeds))
    tried = jax.vmap(lambda at: errors(each_flight(at))[1])(starts)
    two = jax.tree.map(lambda x: jnp.stack([jnp.zeros_like(x[0]), x[jnp.argmin(tried)]]), starts)
    found, _ = jax.vmap(descend)(two)
    shares = jnp.asarray(_SHARES, float)
    ways = jax.tree.map(lambda x: jnp.concatenate([share * x for share in shares]), found)
    _, flown_long = _battery(module, params, hz, _LONG)
    judged = _judged(jax.vmap(lambda at: flown_long(jax.vmap(gains_of)(each_flight(at))))(ways))
    return gains_of(jax.tree.map(lambda x: x[jnp.argmin(judged)], ways)), jnp.min(judged)


def _judged(errors: Float[Array, "gains flights"]) -> Float[Array, " gains"]:
    """Mean error, and by how much one is larger than with the first gains and `_WORSE`; infinite where one breaks."""
    first = jnp.where(jnp.isfinite(errors[:1]), errors[:1], jnp.inf)
    value = jnp.mean(errors, axis=-1) + jnp.max(jnp.maximum(errors - first - _WORSE, 0), axis=-1)
    return jnp.where(jnp.isfinite(value), value, jnp.inf)


def _limited(gradient: dict[str, Array]) -> dict[str, Array]:
    """The gradient of a flight, not longer than `_STEEPEST`; zero where it is not finite, as of one that tumbles."""
    length = optax.tree.norm(gradient)
    share = jnp.minimum(1, _STEEPEST / jnp.maximum(length, _STEEPEST))
    return jax.tree.map(lambda x: jnp.where(jnp.isfinite(length), share * x, 0), gradient)


def _battery(
    module: ModuleType, params: Params, hz: int, seconds: float
) -> tuple[int, Callable[[Any], Float[Array, " flights"]]]:
    """How many flights there are, and the function from gains, those of each flight, to the errors of the flights."""

    def lagging(times: float) -> Params:
        names = ("rotor_rise_time", "rotor_fall_time")
        return params.replace(**{name: jnp.maximum(times * getattr(params, name), 1 / hz) for name in names})

    slow = lagging(_SLUGGISH).replace(mass=_HEAVY * params.mass, inertia=_HEAVY * params.inertia)
    vehicles = (lagging(0), lagging(1), slow)
    start, targets = _starts_and_targets(params, hz, seconds)
    each = len(start.pos)
    n = len(vehicles) * each
    team = jax.tree.map(lambda *x: jnp.concatenate(x), *(repeat(vehicle, each) for vehicle in vehicles))
    start = jax.tree.map(lambda x: jnp.concatenate([x] * len(vehicles)), start)
    targets = jax.tree.map(lambda x: jnp.concatenate([x] * len(vehicles), axis=1), targets)
    step = make_step([drag], rotors=lagging_rotors, dt=1 / hz)
    call = jax.vmap(functools.partial(module.control, dt=1 / hz))

    def flown(gains: Any) -> Float[Array, " flights"]:
        def fly(team: Params, memory: Any, state: State, k: Array) -> tuple[Any, Array]:
            return call(gains, team, memory, state, jax.tree.map(lambda x: x[k], targets))

        states = rollout(step, fly, team, start, for_team(module.init(), n), len(targets.yaw))[1]
        return _error(params, hz, states, targets)

    return n, flown


def _error(params: Params, hz: int, flown: State, targets: Setpoint) -> Float[Array, " flights"]:
    """The logarithms of the errors, m: distance, heading, body rates, and how fast the rotors change; and the end."""
    distance = safe_sqrt(jnp.sum((flown.pos - targets.pos) ** 2, axis=-1) + _SMALL**2)
    x = jax.vmap(jax.vmap(lambda quat: rotation.axes(quat)[0]))(flown.quat)
    heading = 1 - (x[..., 0] * jnp.cos(targets.yaw) + x[..., 1] * jnp.sin(targets.yaw))
    effort = jnp.diff(flown.rpm, axis=0) * (hz / params.hover_rpm)
    error = jnp.mean(distance, axis=0) + _YAW * jnp.mean(heading, axis=0)
    error = error + _RATES * jnp.mean(jnp.sum(flown.omega**2, axis=-1), axis=0)
    error = error + _EFFORT * jnp.mean(jnp.mean(effort**2, axis=-1), axis=0)
    return jnp.log(error) + _LEFT * jnp.log(jnp.mean(distance[-hz:], axis=0))


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
    steps = jnp.array([[0.5, 0.2, 0.0], [-1.0, 0.6, 0.5], [0.0, 0.0, 0.5]])  # m; not along arms, which couples the axes
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

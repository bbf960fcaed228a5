"""Domain randomization of parameters, wind and delay per episode, and sensor noise."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdrones import rotation, vehicles
from jaxdrones.accelerate import compiler
from jaxdrones.arguments import checked, choice, number, shape
from jaxdrones.checks import NOT_NEGATIVE, POSITIVE, check_number, is_concrete, short_repr
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.quantity import described
from jaxdrones.state import State
from jaxdrones.tasks.task import Randomization

_DRAWS = 1000
DELAY = "delay"
"""Key of `Params.aux`: random delay of an episode, control steps."""

Field = Annotated[str, choice("parameter", [name for name in Params.__dataclass_fields__ if name != "aux"])]
Noise = Callable[[jax.Array, State], State]
"""(key, state) of a team -> measured state."""


def _check_range(field: str, low: float, high: float, **limit: Any) -> None:
    """Raise unless this is a range; `limit` is that of its lower bound."""
    bounds: tuple[tuple[str, float, dict[str, Any]], ...] = ("lower", low, limit), ("upper", high, {})
    for bound, value, limits in bounds:
        check_number(f"{bound} bound of {field}", value, **limits)
    if not low <= high:
        raise UserError(f"the range of {field} is ({low}, {high}); give the lower bound first")


@checked
def scaled(field: Field, low: float, high: float) -> Randomization:
    """Nominal value times U(low, high), one factor for the whole array.

    A vehicle whose coefficient is zero, so that no factor changes it, is an error.
    """
    return _scaled(field, low, high)


@checked
def _scaled(field: Field, low: float, high: float, zero: bool = False) -> Randomization:
    """`scaled`; `zero` allows a coefficient that is zero, as another randomization may set wind and force."""
    limit = {"above": 0} if field in POSITIVE else {"at_least": 0} if field in NOT_NEGATIVE else {}
    _check_range(field, low, high, **limit)

    def randomize(key: jax.Array, params: Params) -> Params:
        value = getattr(params, field)
        zeros = field not in ("wind", "external_force") and is_concrete(value) and not np.any(np.asarray(value))
        if zeros and not zero:
            raise UserError(f"{field} of the vehicle is zero, and {field} times U({low:g}, {high:g}) too; leave it out")
        return params.replace(**{field: value * jax.random.uniform(key, (), value.dtype, low, high)})

    return described(f"{field} times U({low:g}, {high:g})", randomize)


@checked
def shifted(field: Field, low: float, high: float) -> Randomization:
    """Nominal value plus U(low, high), drawn for each entry of the array."""
    _check_range(field, low, high)

    def randomize(key: jax.Array, params: Params) -> Params:
        value = getattr(params, field)
        if field in (*POSITIVE, *NOT_NEGATIVE) and is_concrete(value):
            lowest, positive = float(np.asarray(value).min()), field in POSITIVE
            if lowest + low < 0 or (positive and lowest + low == 0):
                least = f"{'more than' if positive else 'at least'} {0 - lowest:g}"
                raise UserError(f"the lower bound of {field}, which is {lowest:g}, is {low:g}; give {least}")
        return params.replace(**{field: value + jax.random.uniform(key, value.shape, value.dtype, low, high)})

    return described(f"{field} plus U({low:g}, {high:g}), each entry", randomize)


@checked
def constant_wind(speed: Annotated[float, number("m/s", "speed of the wind", at_least=0)]) -> Randomization:
    """Wind U(-speed, speed) (m/s) along x and y and a quarter of that along z, constant in an episode."""

    def randomize(key: jax.Array, params: Params) -> Params:
        wind = jax.random.uniform(key, (3,), params.wind.dtype, -speed, speed)
        return params.replace(wind=wind * jnp.array([1, 1, 0.25], wind.dtype))

    return described(f"wind U(-{speed:g}, {speed:g}) m/s along x and y, a quarter of it along z", randomize)


@dataclasses.dataclass(frozen=True)
class AnyVehicle:
    """Random quadrotor from scaling laws (`jaxdrones.vehicles`), by default of 20 g to 3 kg.

    Starts and actions are scaled by the drawn vehicle, so an action of 0 hovers; with other randomizations they are
    scaled by the nominal vehicle. In `jaxdrones.make` the median vehicle is the nominal one.
    """

    lightest: float = vehicles.LIGHTEST
    """kg."""
    heaviest: float = vehicles.HEAVIEST
    """kg."""
    light: float = 1.0
    """Power of the distribution of masses; above 1 more vehicles are light. See `vehicles.draw`."""

    def __post_init__(self):
        check_number("light", self.light, above=0)
        vehicles.check_masses(self.lightest, self.heaviest)
        object.__setattr__(self, "__doc__", f"any quadrotor of {self.lightest:g} to {self.heaviest:g} kg")

    def __call__(self, key: jax.Array, params: Params) -> Params:
        """Random vehicle, with gravity, air and wind of `params`."""
        return vehicles.draw(key, params, self.lightest, self.heaviest, self.light)

    def median(self, params: Params) -> Params:
        """Team of the median vehicle, with gravity, air and wind of the team `params`."""
        return jax.vmap(lambda one: vehicles.median(one, self.lightest, self.heaviest))(params)


def nominal_params(randomize: Sequence[Randomization], params: Params) -> Params:
    """Nominal parameters of a team: those given, or the median of random vehicles."""
    for one in randomize:
        params = one.median(params) if isinstance(one, AnyVehicle) else params
    return params


def scaling_params(randomize: Sequence[Randomization], drawn: Params, nominal: Params) -> Params:
    """Parameters that scale starts and actions: the nominal ones, or the drawn ones of a random vehicle."""
    return drawn if any(isinstance(one, AnyVehicle) for one in randomize) else nominal


def all_randomizations(
    any_vehicle: bool, task: Sequence[Randomization], given: Sequence[Randomization], vehicle: Any
) -> tuple[Randomization, ...]:
    """All randomizations of an environment, whole vehicles first."""
    chosen = [*task, *given]
    if any_vehicle and not any(isinstance(one, AnyVehicle) for one in chosen):
        chosen.append(AnyVehicle())
    whole = [one for one in chosen if isinstance(one, AnyVehicle)]
    rest = [one for one in chosen if not isinstance(one, AnyVehicle)]
    if len(whole) > 1 or (whole and vehicle is not None):
        named = "a vehicle" if isinstance(vehicle, Params) else f"vehicle={short_repr(vehicle)}"
        other = "another AnyVehicle" if len(whole) > 1 else named
        raise UserError(f"{other} is given, but every episode draws a vehicle already; leave out one of them")
    return (*whole, *rest)


def delay_bounds(delay: float | Sequence[float], duration: float) -> tuple[float, float]:
    """Shortest and longest delay, s."""
    bounds = tuple(delay) if isinstance(delay, tuple | list) else (delay, delay)
    if len(bounds) != 2:
        raise UserError(f"delay is {short_repr(delay)}; give a number, or the shortest and the longest of an episode")
    for bound in bounds:
        check_number("delay", bound, "s, less than an episode", at_least=0, below=duration)
    if bounds[0] > bounds[1]:
        raise UserError(f"delay is {short_repr(delay)}; give the shortest first")
    return bounds


def draw(randomize: Sequence[Randomization], key: jax.Array, params: Params) -> Params:
    """Parameters of a team after all randomizations, each with its own key for every drone."""
    n = len(params.mass)
    for one, one_key in zip(randomize, jax.random.split(key, max(len(randomize), 1)), strict=False):
        params = jax.vmap(one)(jax.random.split(one_key, n), params)
    return params


def drawn_leaves(randomize: Sequence[Randomization], params: Params) -> list[bool]:
    """Mask of the random leaves of the parameters of a team."""
    one = jax.tree.map(lambda x: x[0], params)
    found = [jax.tree.leaves(compiler.depends(each, jax.random.key(0), one)) for each in randomize]
    return [any(flags) for flags in zip(*found, strict=True)] if found else [False] * len(jax.tree.leaves(params))


def with_random_lags(randomize: Sequence[Randomization], params: Params) -> Params:
    """Parameters of a team with the shortest rotor lags of `realistic`, or those of 1,000 draws of the user's own."""
    drawn = dict(zip(_RANGES, REALISTIC_RANDOMIZATION, strict=True))
    realistic = [name for name in _LAGS if drawn[name] in randomize]
    params = params.replace(**{name: _RANGES[name][0] * getattr(params, name) for name in realistic})
    randomize = [one for one in randomize if one not in REALISTIC_RANDOMIZATION and not isinstance(one, AnyVehicle)]
    random = jax.tree.unflatten(jax.tree.structure(params), drawn_leaves(randomize, params))
    if not any(getattr(random, name) for name in _LAGS):
        return params

    def lags(key: jax.Array) -> dict[str, Array]:
        return {name: getattr(draw(randomize, key, params), name) for name in _LAGS}

    return params.replace(**jax.jit(jax.vmap(lags))(jax.random.split(jax.random.key(0), _DRAWS)))


@checked
def sensor_noise(
    pos: Annotated[float, number("m", "{argument} of the noise", at_least=0)] = 0.005,
    vel: Annotated[float, number("m/s", "{argument} of the noise", at_least=0)] = 0.01,
    angle: Annotated[float, number("rad", "{argument} of the noise", at_least=0)] = 0.005,
    omega: Annotated[float, number("rad/s", "{argument} of the noise", at_least=0)] = 0.02,
) -> Noise:
    """White noise on the state with these standard deviations, m, m/s, rad and rad/s.

    The defaults for position and velocity are those of Huang et al.'s swarm simulator. Those for angle and rates are
    typical of attitude filters on the Crazyflie (L2F: 1 mrad and 2 mrad/s; DiffAero: 2.4e-2 rad/s).
    """

    def noise(key: jax.Array, state: State) -> State:
        n = len(state.pos)
        x = jax.random.normal(key, (n, 12), state.pos.dtype)
        turn = jax.vmap(rotation.exp)(angle * x[:, 6:9])
        return state.replace(
            pos=state.pos + pos * x[:, :3],
            vel=state.vel + vel * x[:, 3:6],
            quat=jax.vmap(rotation.multiply)(state.quat, turn),
            omega=state.omega + omega * x[:, 9:],
        )

    return described(f"normal: {pos:g} m, {vel:g} m/s, {angle:g} rad and {omega:g} rad/s (standard deviations)", noise)


def drawn_delay(shortest: float, longest: float) -> Randomization:
    """Delay between action and command U(shortest, longest), control steps, constant in an episode, in `params.aux`."""

    def randomize(key: jax.Array, params: Params) -> Params:
        delay = jax.random.uniform(key, (), params.mass.dtype, shortest, longest)
        return params.replace(aux=params.aux | {DELAY: delay})

    return described(f"delay U({shortest:g}, {longest:g}) control steps between action and command", randomize)


def with_delay(params: Params, delay: float) -> Params:
    """Parameters of a team with a nominal delay, control steps."""
    return params.replace(aux=params.aux | {DELAY: jnp.full_like(params.mass, delay)})


def delay_of(params: Params) -> Array:
    """(n,) random delay of an episode, control steps."""
    return params.aux[DELAY]


def delayed(actions: Array, steps: float | Array) -> Array:
    """Action (n, a) of `steps` control steps ago, out of the last h actions (n, h, a).

    A fraction gives the mean over the control step in which one action follows another. `steps` is a number, or (n,)
    for every drone.
    """
    if isinstance(steps, float) and steps == int(steps):
        return actions[:, -1 - int(steps)]
    age = jnp.arange(actions.shape[1], dtype=actions.dtype)[None, ::-1]
    share = jnp.maximum(1 - jnp.abs(age - jnp.reshape(jnp.asarray(steps, actions.dtype), (-1, 1))), 0)
    ages = range(actions.shape[1])  # a loop is faster than jnp.sum on a CPU
    return sum((share[:, i, None] * actions[:, i] for i in ages), jnp.zeros((), actions.dtype))


_BOUNDS = shape(2, meaning="lower and upper bound")
_RANGES = {
    "mass": (0.9, 1.1),
    "inertia": (0.8, 1.2),
    "kf": (0.9, 1.1),
    "km": (0.2, 1.2),
    "rotor_pos": (0.95, 1.05),
    "drag_coeff": (0.5, 1.5),
    "rotor_rise_time": (0.8, 1.2),
    "rotor_fall_time": (0.2, 1.2),
}
_LAGS = "rotor_rise_time", "rotor_fall_time"


@checked
def realistic_randomization(**ranges: Annotated[tuple[float, float], _BOUNDS]) -> tuple[Randomization, ...]:
    """`REALISTIC_RANDOMIZATION` with other ranges of some parameters: name=(low, high), relative to nominal values.

    A coefficient that is zero stays zero.
    """
    return tuple(_scaled(name, *bounds, zero=True) for name, bounds in (_RANGES | ranges).items())


REALISTIC_RANDOMIZATION: tuple[Randomization, ...] = realistic_randomization()
"""Ranges of +-10 or 20 %, wider where published identifications of the Crazyflie differ more.

Some find a fifth of the torque coefficient of `cf2x`; some find that rotors slow down as fast as they speed up, others
five times as slowly.
"""
REALISTIC_DELAY = 0.0, 0.04  # s, drawn: radio links and autopilots differ, and so do their loads

"""Sensors of a drone: interface, initialization and measurement."""

import dataclasses
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.checks import bind, check_function, check_number, check_sequence, short_repr
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.quantity import Quantity
from jaxdrones.sensing.scene import Scene
from jaxdrones.state import State

_ARGUMENTS = {"measure": ("key", "params", "state", "rate", "scene", "memory"), "init": ("key", "params")}
_LARGEST_DENOMINATOR, _INTEGERS = 1000, 2**31  # of a period in steps; range of the integers of steps
_ROUNDING = 1e-4  # of a measurement; tolerance for rounding of a rate that divides the control rate


def no_memory(key: jax.Array, params: Params) -> None:
    """Empty memory, for sensors without one."""
    return None


@dataclasses.dataclass(frozen=True)
class Sensor:
    """Sensor on every drone of a team, for example an IMU, a range finder or a barometer.

    Both functions are written for one drone and mapped over the team.
    """

    name: str
    """Name of the reading in observation terms, for example `imu`."""
    measure: Callable[..., Any]
    """`measure(key, params, state, rate, scene, memory) -> (memory, reading)`.

    key: random key of this measurement of this drone.
    params: constants of the drone.
    state: its state, with `pos` (3,) and so on; units and frames as in `State`.
    rate: time derivative of its state, also a `State`: `rate.vel` (3,) is the acceleration of the center of mass,
        m/s^2, world, and `rate.omega` (3,) the angular acceleration, rad/s^2, body.
    scene: `Scene` of the world, shared by all drones.
    memory: result of `init` or of the previous measurement.

    The returned memory has the shapes and types of the argument. The reading is an array or any pytree of arrays; the
    sensor documents its units and frames.
    """
    init: Callable[..., Any] = no_memory
    """`init(key, params) -> memory`: memory of one drone at the start of an episode, a pytree of arrays. A parameter
    named `state` receives the initial state of the drone."""
    bound: float = np.inf
    """Largest absolute value of a reading, in its units."""
    rate: float | None = None
    """Measurements per second, at most the control rate; the reading is held in between. The default is one every
    control step."""
    entries: tuple[Quantity, ...] = ()
    """Description of each entry of the flattened reading, for `jaxdrones.explain`; optional."""
    clocked: float | None = None
    """Rate, equal to `rate`, of a sensor whose `measure` requires exactly this one, for example because it integrates.
    An environment then rejects a rate that does not divide its control rate."""

    def __post_init__(self):
        if not isinstance(self.name, str) or not self.name:
            raise UserError(f"name of a sensor is {short_repr(self.name)}; give a text, for example 'imu'")
        for field, arguments in _ARGUMENTS.items():
            function = getattr(self, field)
            function = bind(function, state=None) if field == "init" else function
            check_function(f"{field} of sensor {self.name!r}", function, arguments)
        check_number(f"bound of sensor {self.name!r}", self.bound, above=0, infinite=True)
        if self.rate is not None:
            check_number(f"rate of sensor {self.name!r}", self.rate, "1/s", above=0)
        if self.clocked not in (None, self.rate):
            raise UserError(
                f"sensor {self.name!r} is clocked at {self.clocked} Hz, but its rate is {self.rate}; make a new sensor "
                "with this rate, for example imu(rate=50)"
            )

    def is_due(self, step: jax.Array, dt: float) -> jax.Array:
        """Whether there is a measurement at a control step.

        The k-th measurement is in the first step at or after k / rate.
        """
        if self.rate is None or self.rate * dt >= 1:
            return jnp.ones((), bool)
        return is_due(step, 1 / (self.rate * dt))


def is_due(step: jax.Array, period: float) -> jax.Array:
    """Whether a step is the first one at or after a multiple of a period of at least one step.

    The period, in steps, is taken for the nearest fraction with integers that fit, so that rounding never adds up.
    """
    period = min(period, _INTEGERS - 1)
    most = max(1, min(_LARGEST_DENOMINATOR, int((_INTEGERS / period) ** 0.5)))
    steps, times = Fraction(period).limit_denominator(most).as_integer_ratio()
    return step % steps * times % steps < times


def check_sensors(sensors: Sequence[Sensor], dt: float | None = None) -> tuple[Sensor, ...]:
    """Validate the sensors of a team: types, unique names, and rates that fit control steps of `dt` s."""
    if isinstance(sensors, Sensor):
        raise UserError(f"sensors is the single sensor {sensors.name!r}; give a sequence, for example (sensor,)")
    sensors = check_sequence("sensors", sensors, "sensor")
    for sensor in sensors:
        if not isinstance(sensor, Sensor):
            raise UserError(f"sensors holds {short_repr(sensor)}; give jaxdrones.Sensor(name, measure)")
    names = [sensor.name for sensor in sensors]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise UserError(f"two sensors have the name {twice[0]!r}; give every sensor a name of its own")
    if dt is None:
        return sensors
    for sensor in sensors:
        steps = 1 / (sensor.rate * dt) if sensor.clocked and sensor.rate else 1.0
        if abs(steps - round(steps)) > _ROUNDING * steps:
            raise UserError(
                f"sensor {sensor.name!r} measures at {sensor.rate:g} Hz, which does not divide the {1 / dt:g} Hz of "
                "the control steps; give it a rate that does, or another control_hz"
            )
        if sensor.rate and sensor.rate * dt > 1 + _ROUNDING:
            raise UserError(
                f"sensor {sensor.name!r} measures at {sensor.rate:g} Hz; give at most the control rate, {1 / dt:g} Hz, "
                "or rate=None for a measurement in every control step"
            )
    return sensors


def init_sensors(sensors: Sequence[Sensor], key: jax.Array, params: Params, state: State) -> dict[str, Any]:
    """Memories by name of the sensors of a team of n drones at the start of an episode, each with n rows."""
    n = len(params.mass)
    keys = jax.random.split(key, (len(sensors), n))
    memories = {}
    for i, sensor in enumerate(sensors):

        def init(key, params, state, sensor=sensor):
            return bind(sensor.init, state=state)(key, params)

        memories[sensor.name] = jax.vmap(init)(keys[i], params, state)
    return memories


def measure_sensors(
    sensors: Sequence[Sensor],
    key: jax.Array,
    params: Params,
    state: State,
    rate: State,
    scene: Scene,
    memories: dict[str, Any],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Memories and readings by name after one measurement of every sensor of a team of n drones, each with n rows.

    The rate is the time derivative of the state, as `step.rate` returns it; the memories are those by name from
    `init_sensors` or the previous measurement.
    """
    n = len(params.mass)
    keys = jax.random.split(key, (len(sensors), n))
    after, readings = {}, {}
    for i, sensor in enumerate(sensors):

        def measure(key, params, state, rate, memory, sensor=sensor):
            return _checked(sensor, memory, sensor.measure(key, params, state, rate, scene, memory))

        after[sensor.name], readings[sensor.name] = jax.vmap(measure)(
            keys[i], params, state, rate, memories[sensor.name]
        )
    return after, readings


def hold_between(
    sensors: Sequence[Sensor], step: jax.Array, dt: float, before: tuple[Any, Any], after: tuple[Any, Any]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Hold memories and readings between the measurements of sensors with their own rates.

    `step` counts control steps of `dt` (s) since the start of the episode. `after` has the memories and readings of a
    measurement; without readings `before`, all of them are used.
    """
    if not before[1]:
        return after

    def held(sensor: Sensor, before: Any, after: Any) -> Any:
        due = sensor.is_due(step, dt)
        return jax.tree.map(lambda a, b: jnp.where(due, a, b), after, before)

    memories, readings = (
        {s.name: new[s.name] if s.rate is None else held(s, old[s.name], new[s.name]) for s in sensors}
        for old, new in zip(before, after, strict=True)
    )
    return memories, readings


def _checked(sensor: Sensor, memory: Any, result: Any) -> tuple[Any, Any]:
    called = f"measure of sensor {sensor.name!r}"
    if not isinstance(result, tuple) or len(result) != 2:
        raise UserError(f"{called} returned {short_repr(result)}; return the two values (memory, reading)")
    after, reading = result
    if _types(after) != _types(memory):
        raise UserError(
            f"{called} returned a memory of {_described(after)}, but was given one of {_described(memory)}; "
            "return a memory with the shapes and types of the one that init returns"
        )
    for leaf in jax.tree.leaves(reading):
        if not isinstance(leaf, jax.Array | np.ndarray | np.generic | float | int):
            raise UserError(f"{called} returned a reading with {short_repr(leaf)} in it; return arrays")
    return after, jax.tree.map(jnp.asarray, reading)


def _types(tree: Any) -> tuple:
    leaves, structure = jax.tree.flatten(tree)
    return structure, [(jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves]


def _described(tree: Any) -> str:
    """Shapes and types of a memory, for error messages."""
    return str(jax.tree.map(lambda leaf: f"{jnp.result_type(leaf)}{list(jnp.shape(leaf))}", tree))

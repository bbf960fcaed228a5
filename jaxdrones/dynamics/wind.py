"""Wind fields of position and time."""

import functools
import inspect
from collections.abc import Callable
from typing import Annotated, Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.arguments import checked, function, number
from jaxdrones.checks import check_function, check_number, check_shape, depends_on, short_repr, takes
from jaxdrones.dynamics.model import Model
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.wrench import Wrench

WindField = Callable[..., Float[Array, "3"]]
"""`(pos)` or `(pos, time)`, m and s -> wind velocity, m/s, world."""
Effect = Callable[[Params, State], Wrench]


def clock() -> Model:
    """Model of time: `state.aux["clock"]` () is the time since the start, s."""
    return Model(
        "clock", lambda params: jnp.zeros_like(params.mass), lambda params, state, _: jnp.ones_like(params.mass)
    )


@checked
def in_wind(field: WindField, effect: Annotated[Effect, function("jaxdrones.drag", ("params", "state"))]) -> Effect:
    """Wrap an effect in a wind field, which is added to `params.wind` at the position of the drone.

    Args:
        field: `(pos) -> wind` or `(pos, time) -> wind` for one drone, (3,) m/s, world; the latter needs the model
            `clock()` in the step.
        effect: `(params, state) -> Wrench` that depends on `params.wind`: `drag`, `quadratic_drag`, `inflow_thrust`,
            `flapping_moment`, or your own.

    Raises:
        ValueError: an argument of another type; in flight, a field of time without a clock, a wind of another shape, or
            an effect that does not depend on `params.wind`.
    """
    if takes(field, "params"):
        raise UserError(f"field is {short_repr(field)}, an effect on a drone; give in_wind(field, effect)")
    arguments = ("pos", "time") if _arguments(field) > 1 else ("pos",)
    check_function("field", field, arguments, example="jaxdrones.logarithmic_wind(5.0)")

    @functools.wraps(effect)
    def blown(params: Params, state: State, **scene: Any) -> Wrench:
        if len(arguments) == 2 and "clock" not in state.aux:
            raise UserError(
                "the wind field depends on time and state.aux lacks 'clock'; give models=(jaxdrones.clock(),)"
            )
        wind = field(state.pos, state.aux["clock"]) if len(arguments) == 2 else field(state.pos)
        check_shape("wind", wind, (3,), "m/s, world, as the field returns it")
        if not depends_on(lambda wind: effect(params.replace(wind=wind), state, **scene), params.wind):
            name = getattr(effect, "__name__", repr(effect))
            raise UserError(
                f"in_wind: {name} does not depend on params.wind, so the field has no influence; give an effect that "
                "does, for example jaxdrones.drag"
            )
        return effect(params.replace(wind=params.wind + wind), state, **scene)

    return blown


@checked
def logarithmic_wind(
    speed: Annotated[float, number("m/s", "speed of the wind", at_least=0)],
    height: float = 6.1,
    roughness: Annotated[float, number("m", "roughness of the ground", above=0)] = 0.0457,
    direction: Annotated[float, number("rad", "direction of the wind")] = 0.0,
) -> Callable[[Float[Array, "3"]], Float[Array, "3"]]:
    """Logarithmic mean wind over flat ground (MIL-F-8785C, 3.7.3.1).

    It is u ln(z / z_0) / ln(h / z_0) at the height z, and zero below z_0.

    Args:
        speed: wind speed u at `height`, m/s.
        height: h, m; the default is 20 ft.
        roughness: roughness length z_0, m; the default is 0.15 ft, the specification's value for take-off and landing
            (2 ft otherwise).
        direction: heading of the wind velocity, rad from the x axis towards the y axis.

    Raises:
        ValueError: a height that is not above the roughness, or numbers that are not positive.
    """
    check_number("height of the wind's speed", height, "m", above=roughness)

    def logarithmic(pos: Float[Array, "3"]) -> Float[Array, "3"]:
        at_height = speed * jnp.log(jnp.maximum(pos[2], roughness) / roughness) / jnp.log(height / roughness)
        return at_height * jnp.stack([jnp.cos(direction), jnp.sin(direction), 0.0]).astype(pos.dtype)

    return logarithmic


def _arguments(function: Callable) -> int:
    """Number of positional arguments without defaults; 1 for a function without a signature."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return 1
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(p.kind in positional and p.default is inspect.Parameter.empty for p in parameters)

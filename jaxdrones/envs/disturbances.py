"""Disturbances of wind or external force during an episode: random pushes and Dryden turbulence."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Annotated, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.accelerate import compiler
from jaxdrones.arguments import checked, number
from jaxdrones.engine.physics import Physics
from jaxdrones.envs.randomize import Randomization
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.quantity import described
from jaxdrones.sensing import Scene
from jaxdrones.state import State

_FOOT = 0.3048  # m
_LOWEST, _HIGHEST = 10 * _FOOT, 1000 * _FOOT  # m, range of the specification's low-altitude model
_ROUGHNESS, _REFERENCE = 0.15 * _FOOT, 20 * _FOOT  # m, roughness length and reference height of the mean wind
_SQRT3 = math.sqrt(3.0)

Disturbance = Callable[[jax.Array, Params, float], Params]
"""(key, params, control period) of a team -> its parameters with wind and external force of the next control step."""


@dataclasses.dataclass(frozen=True)
class DisturbanceWithMemory:
    """Disturbance with memory, in `params.aux[name]`."""

    name: str
    """Key of `Params.aux`."""
    init: Callable[[jax.Array, Params], Any]
    """`init(key, params)`: memory of one drone at the start of an episode, a pytree of arrays."""
    advance: Disturbance
    """`advance(key, params, control period)` of a team: its parameters with new wind, force and memory."""
    text: str
    """Description."""

    def __post_init__(self):
        object.__setattr__(self, "__doc__", self.text)

    def __call__(self, key: jax.Array, params: Params, dt: float) -> Params:
        """Parameters of a team with wind and external force of the next control step."""
        if self.name not in params.aux:
            raise UserError(
                f"params.aux lacks {self.name!r}, the memory of a disturbance; start with "
                "params = disturbance.start(key, params)"
            )
        return self.advance(key, params, dt)

    def start(self, key: jax.Array, params: Params) -> Params:
        """Parameters of one drone with the memory at the start of an episode."""
        return params.replace(aux=params.aux | {self.name: self.init(key, params)})

    def nominal(self, params: Params) -> Params:
        """Parameters of a team with a memory of zeros."""
        keys = jax.random.split(jax.random.key(0), len(params.mass))
        shapes = jax.eval_shape(jax.vmap(self.init), keys, params)
        return params.replace(aux=params.aux | {self.name: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)})

    def starting(self) -> Randomization:
        """`start` as a randomization."""
        return described(f"start of: {self.text}", functools.partial(self.start))


def check_loads(physics: Physics, params: Params, scene: Scene, drawn: Params, disturbance: Disturbance | None) -> None:
    """Raise for a wind or force, constant or random, on which no effect, rotor or model of the physics depends.

    `params` are those of a team, `scene` may have shapes in place of arrays, and `drawn` is a mask of the parameters
    that are random in every episode.
    """

    def is_random(field: str) -> bool:
        def value(key: jax.Array) -> Array:
            return getattr(disturbance(key, params, 0.01) if disturbance else params, field)

        return getattr(drawn, field) or compiler.depends(value, jax.random.key(0))

    state = physics.init(params, State.at_rest(jnp.zeros_like(params.wind)))
    physics.check_acts(params, state, scene, is_random)


@checked
def random_pushes(
    force: Annotated[float, number("fraction of the weight", "force of a push", at_least=0)],
    interval: Annotated[float, number("s", above=0, infinite=True)] = 1.0,
    duration: Annotated[float, number("s", above=0, infinite=True)] = 0.1,
) -> DisturbanceWithMemory:
    """External forces of U(-force, force) (fraction of the weight) along each axis, at random times.

    One begins every `interval` seconds and lasts `duration` seconds on average, both with exponential distributions.
    They are added to the external force at the start of the episode, which is in `params.aux["pushes"]`.
    """

    def advance(key: jax.Array, params: Params, dt: float) -> Params:
        n = len(params.mass)
        u = jax.random.uniform(key, (n, 4), params.external_force.dtype)
        constant = params.aux["pushes"]
        fresh = constant + force * params.weight[:, None] * (2 * u[:, 1:] - 1)
        begins, ends = u[:, :1] < dt / interval, u[:, :1] > 1 - dt / duration
        return params.replace(external_force=jnp.where(begins, fresh, jnp.where(ends, constant, params.external_force)))

    text = f"pushes of U(-{force:g}, {force:g}) of the weight along each axis, every {interval:g} s for {duration:g} s"
    return DisturbanceWithMemory("pushes", lambda key, params: params.external_force, advance, f"{text} on average")


@checked
def dryden(
    speed: Annotated[float, number("m/s", "speed of the wind at 20 ft", above=0)],
    altitude: Annotated[float, number("m", "altitude of the turbulence", at_least=_LOWEST, at_most=_HIGHEST)] = 6.096,
    airspeed: Annotated[float | None, number("m/s", above=0)] = None,
) -> DisturbanceWithMemory:
    """Dryden turbulence at low altitude, added to the wind at the start of the episode.

    The gusts of different drones are independent. Along the mean wind (along x without mean wind), across it and
    upwards they have the spectra of MIL-F-8785C,

        u: s_u^2 (2 L_u / pi) / (1 + (L_u W)^2),  v, w: s^2 (L / pi) (1 + 3 (L W)^2) / (1 + (L W)^2)^2,

    over the spatial frequency W >= 0, rad/m, with L_w = h, L_u = L_v = h / (0.177 + 0.000823 h)^1.2 (h in feet),
    s_w = 0.1 W_20 and s_u = s_v = s_w / (0.177 + 0.000823 h)^0.4. The filters are discretized exactly, so
    intensities and spectra are independent of the control rate, and an episode starts with stationary turbulence.
    Rotational gusts are not modeled: they matter for wings that are long compared with L.

    The turbulence acts through effects of `params.wind`: `drag`, `quadratic_drag`, `inflow_thrust`. The state of the
    filters and the mean wind are in `params.aux["dryden"]`.

    Args:
        speed: W_20, the mean wind speed 20 ft above the ground, m/s: 7.7 is light, 15.4 moderate, 23.1 severe. It only
            sets the intensity; the mean wind itself is `params.wind`.
        altitude: h, m, 3.048 to 304.8.
        airspeed: speed of the drone through the gusts, m/s. The default is the specification's mean wind speed at the
            altitude, for a drone in hover.

    Raises:
        ValueError: a speed that is not positive, or an altitude out of range.
    """
    mean = speed * math.log(altitude / _ROUGHNESS) / math.log(_REFERENCE / _ROUGHNESS)
    airspeed = mean if airspeed is None else airspeed
    (length, across), (height, upwards) = (scales(speed, altitude)[axis] for axis in "uw")

    def init(key: jax.Array, params: Params) -> dict[str, Array]:
        along, v1, v2, w1, w2 = jax.random.normal(key, (5,), params.wind.dtype)
        return {"mean": params.wind, "u": along, "v": _correlated(v1, v2, math.inf), "w": _correlated(w1, w2, math.inf)}

    def advance(key: jax.Array, params: Params, dt: float) -> Params:
        def blow(memory: dict[str, Array], noise: Float[Array, "5"]) -> tuple[dict[str, Array], Float[Array, "3"]]:
            memory = _next(dt * airspeed / length, dt * airspeed / height, memory, noise)
            gust = jnp.stack([across * memory["u"], across * _shaped(memory["v"]), upwards * _shaped(memory["w"])])
            return memory, memory["mean"] + _along(memory["mean"], gust)

        noise = jax.random.normal(key, (len(params.mass), 5), params.wind.dtype)
        memory, wind = jax.vmap(blow)(params.aux["dryden"], noise)
        return params.replace(wind=wind, aux=params.aux | {"dryden": memory})

    text = f"Dryden turbulence of {speed:g} m/s at 20 ft, at {altitude:g} m, met at {airspeed:.3g} m/s"
    return DisturbanceWithMemory("dryden", init, advance, text)


def scales(speed: float, altitude: float) -> dict[str, tuple[float, float]]:
    """Length scale (m) and intensity (m/s) of the gusts by axis, u along the mean wind, v across, w upwards."""
    feet = altitude / _FOOT
    ratio = 0.177 + 0.000823 * feet
    horizontal = altitude / ratio**1.2, 0.1 * speed / ratio**0.4
    return {"u": horizontal, "v": horizontal, "w": (altitude, 0.1 * speed)}


def _next(along: float, up: float, memory: dict[str, Array], noise: Float[Array, "5"]) -> dict[str, Array]:
    """States of the filters after a step.

    `along` and `up` are the step over the time constants of u and v, and of w.

    The filter of u is 1 / (1 + s). The filters of v and w are a chain z1 = n / (1 + s), z2 = z1 / (1 + s). The unit of
    1 / s is the time constant. In stationary turbulence u has the variance 1, z1 and z2 have 1/2 and 1/4, and their
    covariance is 1/4.
    """
    n0, n1, n2, n3, n4 = noise
    kept = math.exp(-along)
    chain = {axis: _decayed(memory[axis], step) for axis, step in (("v", along), ("w", up))}
    return {
        "mean": memory["mean"],
        "u": kept * memory["u"] + math.sqrt(-math.expm1(-2 * along)) * n0,
        "v": chain["v"] + _correlated(n1, n2, along),
        "w": chain["w"] + _correlated(n3, n4, up),
    }


def _decayed(z: Float[Array, "2"], step: float) -> Float[Array, "2"]:
    return math.exp(-step) * jnp.stack([z[0], z[1] + step * z[0]])


def _correlated(n1: Float[Array, ""], n2: Float[Array, ""], step: float) -> Float[Array, "2"]:
    """White noise of a step in the states of a chain: two normal numbers times the root of the covariance.

    The covariance is the integral of exp(-2 s) (1, s; s, s^2) from 0 to the step; for an infinite step it is the
    stationary covariance.
    """
    from scipy.special import gammainc  # loading it takes a quarter of a second

    a, b, c = (float(gammainc(k, 2 * step)) * weight for k, weight in ((1, 1 / 2), (2, 1 / 4), (3, 1 / 4)))
    first = math.sqrt(a)
    return jnp.stack([first * n1, b / first * n1 + math.sqrt(c - b * b / a) * n2])


def _shaped(z: Float[Array, "2"]) -> Float[Array, ""]:
    """Output of the filter (1 + sqrt(3) s) / (1 + s)^2, with variance 1."""
    return _SQRT3 * z[0] + (1 - _SQRT3) * z[1]


def _along(mean: Float[Array, "3"], gust: Float[Array, "3"]) -> Float[Array, "3"]:
    """A gust (along, across, upwards) in world axes."""
    x, y, _ = mean
    square = x * x + y * y
    calm = square == 0
    length = jnp.sqrt(jnp.where(calm, 1, square))
    cos, sin = jnp.where(calm, 1, x / length), jnp.where(calm, 0, y / length)
    return jnp.stack([cos * gust[0] - sin * gust[1], sin * gust[0] + cos * gust[1], gust[2]])

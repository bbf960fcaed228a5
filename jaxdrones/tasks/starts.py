"""Initial states of episodes."""

from collections.abc import Callable
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxdrones import rotation
from jaxdrones.arguments import checked, number
from jaxdrones.checks import is_concrete
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.quantity import described
from jaxdrones.state import State

_CLEARANCE = 0.1  # m between the ground and the drones of gym-pybullet-drones at the start
_SPREAD = number("m", "start_spread", at_least=0, at_most=0.5)
_GRID = 4.0  # arms between consecutive drones in x and in y


def hovering(params: Params, pos: Float[Array, "n 3"]) -> State:
    """Level and at rest, with the rotors at hover speed."""
    zero = jnp.zeros_like(pos)
    quat = jnp.broadcast_to(jnp.array([0, 0, 0, 1], pos.dtype), (len(pos), 4))
    return State(pos, quat, zero, zero, jnp.broadcast_to(params.hover_rpm[:, None], (len(pos), 4)))


@checked
def above_ground(spread: Annotated[float, _SPREAD]) -> Callable[[jax.Array, Params], tuple[State, Float[Array, "n 3"]]]:
    """Start of gym-pybullet-drones, optionally with random heights: the state, and its positions.

    Heights have a range of `spread` (m) to either side; drones start above the ground.
    """
    lower = min(spread, _CLEARANCE)

    def start(key: jax.Array, params: Params) -> tuple[State, Float[Array, "n 3"]]:
        pos = _on_diagonal(params)
        if spread:
            pos = pos.at[:, 2].add(jax.random.uniform(key, (len(pos),), pos.dtype, -lower, spread))
        return hovering(params, pos).replace(rpm=jnp.zeros((len(pos), 4), pos.dtype)), pos

    drawn = f", or up to {lower:g} m lower or {spread:g} m higher" if spread else ""
    return described(f"On a diagonal, 0.1 m above the ground{drawn}, with the rotors standing still.", start)


def check_apart(params: Params, apart: float, remedy: str = "a smaller vehicle or a single drone") -> None:
    """Raise if drones of a known vehicle are wider than the smallest distance (m) between their starts."""
    if len(params.mass) > 1 and is_concrete(params.collision_radius):
        width = 2 * float(np.asarray(params.collision_radius).max())
        if width > apart:
            raise UserError(
                f"drones of this vehicle are {width:.3g} m wide and would start in each other, as little as "
                f"{apart:.3g} m apart; give {remedy}"
            )


def standing_height(params: Params) -> Float[Array, " n"]:
    """Height (z) of a drone at rest on the ground, m."""
    return params.collision_height / 2 - params.collision_offset


def thrown(
    key: jax.Array,
    params: Params,
    pos: Float[Array, "n 3"],
    *,
    reach: ArrayLike,
    speed: float,
    omega: float,
    tilt: float | Array,
) -> State:
    """Random state near `pos`, in motion, with the rotors at hover speed.

    Args:
        key: random key.
        params: parameters of the team.
        pos: (n, 3) mean positions, m.
        reach: displacement U(-reach, reach) along each axis, m: a number or one per axis.
        speed: velocity, U(-speed, speed) along each axis, m/s.
        omega: body rates, U(-omega, omega) about each axis, rad/s.
        tilt: rotation about a random axis by U(0, tilt), rad.
    """
    n, dtype = len(pos), pos.dtype
    u = jax.random.uniform(key, (n, 12), dtype, -1, 1)
    cos, angle = u[:, 9], jnp.pi * u[:, 10]  # of the axis: height and longitude of a point on the unit sphere
    sin = jnp.sqrt(1 - cos**2)
    axis = jnp.stack([sin * jnp.cos(angle), sin * jnp.sin(angle), cos], axis=-1)
    quat = jax.vmap(rotation.exp)(tilt * (u[:, 11:] + 1) / 2 * axis)
    rpm = jnp.broadcast_to(params.hover_rpm[:, None], (n, 4))
    reach = jnp.broadcast_to(jnp.asarray(reach, dtype), (3,))
    return State(pos + reach[None] * u[:, :3], quat, speed * u[:, 3:6], omega * u[:, 6:9], rpm)


def _on_diagonal(params: Params) -> Float[Array, "n 3"]:
    """Starting positions of gym-pybullet-drones, 0.1 m above the ground, four arms of the largest drone apart."""
    i = jnp.arange(len(params.mass))
    across = _GRID * jnp.max(params.arm) * i
    return jnp.stack([across, across, standing_height(params) + _CLEARANCE], axis=-1)

"""State of a team."""

from typing import Annotated, Any, Self

import flax.struct
import jax.numpy as jnp
from jaxtyping import Array
from numpy.typing import ArrayLike

from jaxdrones.arguments import checked, shape
from jaxdrones.checks import check_shape, short_repr
from jaxdrones.errors import UserError
from jaxdrones.pytree import PyTreeNode

_ROWS = shape("n", 3, meaning="one row (x, y, z) per drone, at least one drone", finite=True)


class State(PyTreeNode):
    """Rigid body and rotors of one drone, or of a team with a leading drone axis on every array."""

    pos: Array
    """(3,) position of the center of mass, m, world."""
    quat: Array
    """(4,) attitude, unit quaternion (x, y, z, w), body to world; the sign is free."""
    vel: Array
    """(3,) velocity, m/s, world."""
    omega: Array
    """(3,) angular velocity, rad/s, body."""
    rpm: Array
    """(4,) rotor speeds, revolutions per minute."""
    aux: dict[str, Any] = flax.struct.field(default_factory=dict)
    """Continuous states of models by the model's name: pytrees of arrays, from `Step.init`."""

    @classmethod
    @checked
    def at_rest(cls, pos: Annotated[ArrayLike, _ROWS], yaw: ArrayLike | None = None) -> Self:
        """Level team at rest with stopped rotors; positions (n, 3), m, world, and headings (n,), rad, zero by default.

        Raises:
            ValueError: a wrong shape, no drone, or a number that is not finite.
        """
        pos = jnp.asarray(pos, float)
        n = len(pos)
        yaw = jnp.zeros(n) if yaw is None else jnp.asarray(yaw, float)
        check_shape("yaw", yaw, (n,), "one heading per drone", finite=True)
        zero = jnp.zeros_like(yaw)
        quat = jnp.stack([zero, zero, jnp.sin(yaw / 2), jnp.cos(yaw / 2)], axis=-1)
        return cls(pos, quat, jnp.zeros((n, 3)), jnp.zeros((n, 3)), jnp.zeros((n, 4)))


def _check_team(name: str, state: Any) -> None:
    if not isinstance(state, State):
        raise UserError(f"{name} is {short_repr(state)}; give a jaxdrones.State of a team")
    check_shape(
        f"{name}.pos", state.pos, ("n", 3), "one row per drone, at least one drone; for many worlds use jax.vmap"
    )
    check_shape(f"{name}.quat", state.quat, (len(state.pos), 4), f"{name}.pos has {len(state.pos)} drones")


TeamState = Annotated[State, _check_team]
"""State of a team, with poses of every drone."""

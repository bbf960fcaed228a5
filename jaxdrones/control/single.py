"""Checks that reject a team where one drone is expected (it would broadcast), and the memory of a team."""

from typing import Annotated, Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.checks import check_finite, check_shape, is_concrete, short_repr
from jaxdrones.control.setpoint import Setpoint
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.state import State

_SHAPES: dict[type, dict[str, tuple[int, ...]]] = {
    Params: {"mass": ()},
    State: {"pos": (3,), "quat": (4,), "vel": (3,), "omega": (3,)},
    Setpoint: {"pos": (3,), "vel": (3,), "acc": (3,), "yaw": (), "omega": (3,)},
}
_LARGEST = 1e9  # m, m/s, m/s^2, rad, rad/s of a set-point; squares of larger numbers times gains exceed float32


def _of_one_drone(name: str, value: Any) -> None:
    for kind, shapes in _SHAPES.items():
        for field, shape in shapes.items() if isinstance(value, kind) else ():
            meaning = "a controller is of one drone; use jax.vmap for a team"
            check_shape(f"{name}.{field}", getattr(value, field), shape, meaning)


def _setpoint(name: str, value: Any) -> None:
    _of_one_drone(name, value)
    for field in _SHAPES[Setpoint] if isinstance(value, Setpoint) else ():
        number = getattr(value, field)
        if is_concrete(number) and not np.all(np.abs(number) <= _LARGEST):
            raise UserError(
                f"{name}.{field} is {short_repr(number)}; give finite numbers of at most {_LARGEST:.0e} in size"
            )


def _finite(name: str, gains: Any) -> None:
    for path, leaf in jax.tree_util.tree_leaves_with_path(gains):
        field = jax.tree_util.keystr(path)
        is_limit = field.startswith(".max_") and is_concrete(leaf)
        check_finite(f"{name}{field}", np.where(np.isposinf(leaf), 0, leaf) if is_limit else leaf)


_T = TypeVar("_T")
Finite = Annotated[_T, _finite]
"""Gains of finite numbers; limits, `max_...`, may be infinite."""
OneParams = Annotated[Params, _of_one_drone]
OneState = Annotated[State, _of_one_drone]
OneSetpoint = Annotated[Setpoint, _setpoint]


def for_team(memory: Any, n: int) -> Any:
    """Memory of a controller for each of `n` drones, with a leading drone axis on every array."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (n, *jnp.shape(x))), memory)

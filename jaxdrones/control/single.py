"""Validation of controller arguments for one drone."""

from jaxdrones.checks import check_shape
from jaxdrones.control.setpoint import Setpoint
from jaxdrones.params import Params
from jaxdrones.state import State

_SHAPES: dict[str, tuple[int, ...]] = {
    **{"state.pos": (3,), "state.quat": (4,), "state.vel": (3,), "state.omega": (3,), "params.mass": ()},
    **{"setpoint.pos": (3,), "setpoint.vel": (3,), "setpoint.acc": (3,), "setpoint.yaw": (), "setpoint.omega": (3,)},
}


def check_single(params: Params | None, state: State, setpoint: Setpoint | None = None) -> None:
    """Raise `ValueError` unless the arrays are those of one drone, which a team would broadcast; skip `None`."""
    given = {"params": params, "state": state, "setpoint": setpoint}
    for name, shape in _SHAPES.items():
        owner, field = name.split(".")
        if given[owner] is not None:
            check_shape(
                name, getattr(given[owner], field), shape, "a controller is of one drone; use jax.vmap for a team"
            )

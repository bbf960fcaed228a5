"""Validation of controller arguments for one drone."""

from typing import Any

import numpy as np

from jaxdrones.checks import check_quaternion, check_shape
from jaxdrones.control.setpoint import Setpoint
from jaxdrones.params import Params
from jaxdrones.state import State

_HINT = "a controller is about one drone; use jax.vmap for a team"
_STATE: dict[str, tuple[int, ...]] = {"pos": (3,), "quat": (4,), "vel": (3,), "omega": (3,)}
_SETPOINT: dict[str, tuple[int, ...]] = {"pos": (3,), "vel": (3,), "acc": (3,), "yaw": (), "omega": (3,)}


def check_single(params: Params, state: State, setpoint: Setpoint | None = None, memory: Any = None) -> None:
    """Raise `ValueError` unless the arrays are those of one drone; `None` is not checked."""
    check_state(state)
    check_shape("params.mass", params.mass, (), _HINT)
    if setpoint is not None:
        check_setpoint(setpoint)
    for name, value in vars(memory).items() if memory is not None else ():
        check_shape(f"memory.{name}", value, (3,), _HINT)


def check_state(state: State) -> None:
    """Raise `ValueError` unless the arrays of a state are those of one drone."""
    for name, shape in _STATE.items():
        check_shape(f"state.{name}", getattr(state, name), shape, _HINT)
    check_quaternion("state.quat", state.quat)


def check_setpoint(setpoint: Setpoint) -> None:
    """Raise `ValueError` unless the arrays of a setpoint are those of one drone."""
    for name, shape in _SETPOINT.items():
        check_shape(f"setpoint.{name}", getattr(setpoint, name), shape, "one target for one drone")


def check_memory(memory: Any, like: Any) -> None:
    """Raise `ValueError` unless a memory has the shapes of `like`, the memory of one drone."""
    for name, value in vars(memory).items():
        check_shape(f"memory.{name}", value, np.shape(getattr(like, name)), _HINT)

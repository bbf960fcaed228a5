"""What an action type is: functions from a few numbers in [-1, 1] to rotor speeds, and what each number stands for."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from jaxdrones.checks import check_callable, check_whole
from jaxdrones.control import Setpoint, for_team
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.quantity import Quantity
from jaxdrones.state import State

Command = Callable[[Params, Any, State, Array, Setpoint, float], tuple[Any, Float[Array, "4"]]]


def _no_memory() -> None:
    """The memory of an action type that keeps none."""


@dataclasses.dataclass(frozen=True)
class Action:
    """An action type: functions of one drone."""

    size: int
    """How many numbers an action of one drone has."""
    rpm: Command
    """(params, memory, state, action (size,), setpoint of the task, control period) -> (memory, rotor speeds, RPM)."""
    init: Callable[[], Any] = _no_memory
    """() -> memory of one drone at the start of an episode."""
    for_vehicle: Callable[[Params], Action] | None = None
    """Nominal parameters of the team -> the action type for this vehicle; `None` where it is the same for all."""
    entries: Callable[[Params], tuple[Quantity, ...]] | None = None
    """Nominal parameters of one drone -> what each number stands for, for `jaxdrones.explain`; `None` where the action
    type does not say."""
    name: str = ""
    """The name by which an environment knows the action type; `jaxdrones.make` sets it."""

    def team_memory(self, n: int) -> Any:
        """The memory of a team of n drones at the start of an episode."""
        return for_team(self.init(), n)

    def fitted(self, params: Params) -> Action:
        """The action type for this vehicle.

        Raises:
            ValueError: the action type does not suit the vehicle.
        """
        return self if self.for_vehicle is None else dataclasses.replace(self.for_vehicle(params), name=self.name)

    def __post_init__(self):
        check_whole("size of an action type", self.size)
        check_callable("rpm of an action type", self.rpm, "jaxdrones.envs.ACTIONS['rpm']().rpm")
        check_callable("init of an action type", self.init, "lambda: None")


_MAX_PERIOD = 1 / 30  # s; at 27 Hz the PID loses a Crazyflie; the geometric controller is stable down to 15 Hz
_MAX_ROTOR_TIME = 0.02  # s, mean of rise and fall; with 0.022 the PID loses a Crazyflie at 48 Hz


def check_loop(name: str, action: Action, params: Params, lagging: bool, dt: float) -> None:
    """Raise `ValueError` if the controller of an action type would be called too seldom, or its rotors lag too much.

    Args:
        name: name of the action type.
        action: the action type.
        params: nominal parameters of the vehicle.
        lagging: whether the rotors lag.
        dt: control period, s.
    """
    if action.for_vehicle is None:
        return
    if dt > _MAX_PERIOD * (1 + 1e-6):
        raise UserError(
            f"control_hz is {1 / dt:g}; the action type {name!r} is flown by a controller that needs "
            f"{1 / _MAX_PERIOD:g} or more"
        )
    time = float(np.max(params.rotor_rise_time + params.rotor_fall_time)) / 2
    if lagging and time > _MAX_ROTOR_TIME * (1 + 1e-6):
        raise UserError(
            f"the action type {name!r} is flown by a controller that needs rotors with a time constant of up to "
            f"{_MAX_ROTOR_TIME} s; those of this vehicle, which lag, have {time:.2g} s; give rotors='instant', or an "
            "action type that commands rotors, thrust and torques, or rates"
        )

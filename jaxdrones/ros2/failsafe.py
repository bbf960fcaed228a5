"""Failsafe without commands."""

import dataclasses
from typing import Annotated

import numpy as np

from jaxdrones.arguments import Seconds, checked, choice
from jaxdrones.params import Params
from jaxdrones.ros2.command import Command, Mode
from jaxdrones.rotation import yaw_of
from jaxdrones.state import State

ACTIONS = ("hover", "land", "stop")

_SINK_RATE = 0.4  # m/s
_NEAR_GROUND = 0.03  # m above the height at rest


class PeerLost(RuntimeError):
    """Missing or invalid commands with the failsafe `stop`."""


@checked
@dataclasses.dataclass(frozen=True)
class Failsafe:
    """Timeouts of commands, and action after them."""

    action: Annotated[str, choice("failsafe", ACTIONS)] = "hover"
    """`hover`: hold the last commanded position, or else the current one. `land`: descend to the ground there and stop
    the rotors. `stop`: end the flight with an error."""
    timeout: Seconds = 1.0
    """Seconds without a command before the failsafe acts."""
    wait: Seconds = 30.0
    """Seconds without a first command before the failsafe acts."""


class Watch:
    """Timer of commands to one drone, or of steps in lockstep."""

    def __init__(self, failsafe: Failsafe, now: float):
        self._failsafe, self._heard, self._ever, self.lost = failsafe, now, False, False

    def hear(self, now: float) -> bool:
        """Restart the timer; return whether it had expired."""
        was_lost, self.lost, self._heard, self._ever = self.lost, False, now, True
        return was_lost

    def lose(self, now: float) -> bool:
        """Whether the timer has expired since the last call."""
        news = not self.lost and self.remaining(now) <= 0
        self.lost = self.lost or news
        return news

    def remaining(self, now: float) -> float:
        """Remaining time, s."""
        return self._heard + self.limit - now

    @property
    def limit(self) -> float:
        """Duration of the timer, s."""
        return self._failsafe.timeout if self._ever else self._failsafe.wait


def hover(command: Command, state: State, i: int) -> Command:
    """Command to hold the last commanded position, or after other commands the present one of drone `i`."""
    if command.mode == Mode.POSITION:
        return command
    yaw = yaw_of(*np.asarray(state.quat[i]).tolist())
    return Command.zero(Mode.POSITION, pos=np.asarray(state.pos[i]), yaw=yaw)


def sink(command: Command, params: Params, state: State, i: int, dt: float) -> Command:
    """Next command of a landing after `dt` (s), with rotors off once drone `i` is on the ground."""
    ground = float(params.collision_height[i] / 2 - params.collision_offset[i])  # m, height of the center of mass
    if command.mode == Mode.MOTORS or float(state.pos[i, 2]) < ground + _NEAR_GROUND:
        return Command.zero(Mode.MOTORS)
    pos = np.array(command.pos)
    pos[2] = max(pos[2] - _SINK_RATE * dt, ground)
    return command.replace(pos=pos)

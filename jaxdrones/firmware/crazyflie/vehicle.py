"""Simulated Crazyflie: physics and the firmware's PID, 10 ms at a time."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdrones import rotation
from jaxdrones.control import firmware_pid
from jaxdrones.control.firmware_loops import Gains, Memory, rpy
from jaxdrones.control.firmware_motors import FULL
from jaxdrones.control.firmware_pid import PerAxis
from jaxdrones.control.pid import VEHICLES
from jaxdrones.engine.step import Step
from jaxdrones.firmware import drone
from jaxdrones.params import Params, repeat
from jaxdrones.pytree import PyTreeNode
from jaxdrones.state import State
from jaxdrones.urdf import load_params
from jaxdrones.vector import sin_cos

PERIOD = 0.01
"""Time between set-points and between log rows, s."""
_DT = 0.002  # s, period of the loops of attitude and rates
_SUBSTEPS = 2
_TICKS = round(PERIOD / _DT)


class Target(PyTreeNode):
    """Set-point of the commander."""

    setpoint: PerAxis
    """Set-point with a mode for each axis; the yaw of its `rpy` is used if `yaw_given`."""
    in_heading: Any
    """() whether its `vel` is along the heading (x forward, y left), not in the world frame."""
    yaw_rate: Any
    """() rad/s, used unless `yaw_given`: the desired heading turns at this rate."""
    yaw_given: Any
    """() whether the yaw of the set-point is the desired heading."""


class OnBoard(PyTreeNode):
    """State of the vehicle and of its controller."""

    state: State
    """State of a team of one."""
    memory: Memory
    """Memory of the controller."""
    heading: Array
    """() desired heading, rad."""


@dataclasses.dataclass(frozen=True)
class Sample(drone.Sample):
    """Measurements of the vehicle."""

    rpy: np.ndarray
    """(3,) roll, pitch, yaw, degrees, with the firmware's signs: pitch is positive nose up."""
    motors: np.ndarray
    """(4,) thrust commands of the motors, 16 bit."""


class Vehicle:
    """Crazyflie at rest on the ground at the origin, with the gains of its firmware."""

    def __init__(self, vehicle: str = "cf2x"):
        """Compile the simulation; the gains are scaled to other vehicles than a Crazyflie."""
        self.params = load_params(vehicle)
        self.gains = firmware_pid.gains(None if vehicle in VEHICLES else self.params)
        self._team = repeat(self.params, 1)
        step = drone.make_physics(_DT, _SUBSTEPS)
        self._advance = jax.jit(functools.partial(_advance, step))
        start = step.init(self._team, drone.on_ground(self.params))
        self._board = OnBoard(start, firmware_pid.init(), jnp.zeros(()))
        self.sample = self.advance(motors_off())

    def advance(self, target: Target) -> Sample:
        """Take 10 ms of flight towards a set-point."""
        self._board, sample = self._advance(self._team, self.gains, self._board, target)
        self.sample = Sample(*map(np.asarray, jax.device_get(sample)))
        return self.sample

    def set_upright(self) -> None:
        """Set the vehicle on the ground below it, upright and at rest."""
        state = drone.set_upright(self.params, self._board.state)
        self._board = OnBoard(state, firmware_pid.init(), jnp.zeros(()))


def motors_off() -> Target:
    """Set-point without thrust."""
    return target(thrust=0.0, rpy=(0.0, 0.0, 0.0))


def target(
    pos: Any = None,
    vel: Any = (0.0, 0.0, 0.0),
    *,
    height: float | None = None,
    in_heading: bool = False,
    rpy: Any = None,
    by_rate: tuple[bool, bool] = (False, False),
    thrust: float | None = None,
    yaw: float | None = None,
    yaw_rate: float = 0.0,
) -> Target:
    """Set-point from what a command gives, in SI units, world axes; every axis has one source.

    By default the drone follows `vel`, which is along the heading if `in_heading`. `pos` replaces it, and `height` its
    z; roll and pitch of `rpy`, right-handed, angles or rates where `by_rate`, replace x and y; the `thrust` of each
    motor, 16 bit, replaces z. `yaw_rate` is used without `yaw`.
    """
    by_pos = [pos is not None, pos is not None, pos is not None or height is not None]
    place = np.zeros(3) if pos is None else np.asarray(pos, float)
    angles = np.zeros(3) if rpy is None else np.asarray(rpy, float)
    arrays: dict[str, Any] = dict(
        pos=place if height is None else np.append(place[:2], height),
        vel=np.asarray(vel, float),
        by_pos=np.array(by_pos),
        rpy=np.append(angles[:2], 0.0 if yaw is None else yaw),
        omega=angles,
        tilt_given=np.array(rpy is not None),
        rates_given=np.array(by_rate, bool),
        thrust=np.array(0.0 if thrust is None else thrust),
        thrust_given=np.array(thrust is not None),
    )
    return Target(PerAxis(**arrays), np.array(in_heading), np.array(float(yaw_rate)), np.array(yaw is not None))


def _advance(
    step: Step, team: Params, gains: Gains, board: OnBoard, target: Target
) -> tuple[OnBoard, tuple[Array, ...]]:
    """State after `PERIOD`, and the arrays of its `Sample`."""
    params = jax.tree.map(lambda x: x[0], team)

    def tick(board: OnBoard, _: None) -> tuple[OnBoard, Array]:
        state = jax.tree.map(lambda x: x[0], board.state)
        heading = _heading(board, state, target)
        setpoint = _in_world(state, heading, target)
        memory, rpm = firmware_pid.control(gains, params, board.memory, state, setpoint, dt=_DT)
        return OnBoard(step(team, board.state, rpm[None]), memory, heading), rpm

    dtype = board.heading.dtype
    target = jax.tree.map(lambda x: x if x.dtype == bool else jnp.asarray(x, dtype), target)
    board, rpm = jax.lax.scan(tick, board, None, length=_TICKS)
    motors = jnp.minimum(params.kf * rpm[-1] ** 2 / gains.motor.max_thrust, 1) * FULL
    return board, (*drone.measured(step, team, board.state, rpm[-1:]), rpy(board.state.quat[0]), motors)


def _heading(board: OnBoard, state: State, target: Target) -> Array:
    """Desired heading: given, turned by the given rate, or the present one while the motors are off."""
    turned = jnp.where(target.yaw_given, target.setpoint.rpy[2], board.heading + target.yaw_rate * _DT)
    off = target.setpoint.thrust_given & (target.setpoint.thrust <= 0)
    return jnp.where(off, rotation.to_rpy(state.quat)[2], turned)


def _in_world(state: State, heading: Array, target: Target) -> PerAxis:
    """Set-point with its velocity in the world frame and the desired heading."""
    sin, cos = sin_cos(rotation.to_rpy(state.quat)[2])
    forward, left, up = target.setpoint.vel
    along = jnp.stack([cos * forward - sin * left, sin * forward + cos * left, up])
    angles = jnp.append(target.setpoint.rpy[:2], heading)
    return target.setpoint.replace(vel=jnp.where(target.in_heading, along, target.setpoint.vel), rpy=angles)

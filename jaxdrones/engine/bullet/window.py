"""Bullet's window: real time, body axes, and sliders for the motors."""

import time

import numpy as np
from jax.typing import ArrayLike

from jaxdrones.engine.bullet.step import BulletStep
from jaxdrones.engine.step import HostStep
from jaxdrones.params import Params
from jaxdrones.sensing import Camera, Images, Scene
from jaxdrones.state import State

_AXES_HZ = 24  # drawings of the body axes per simulated second
_COLORS = np.eye(3).tolist()  # of the body axes: x red, y green, z blue


class Window(HostStep):
    """Bullet step with a window, in real time, with sliders for the motors."""

    def __init__(self, step: BulletStep, params: Params, control_dt: float):
        self._step, self._dt, self._count = step, control_dt, 0
        self.physics, self.dt, self.substeps, self.integrator = step.physics, step.dt, step.substeps, step.integrator
        self.period, self.scene = step.period, step.scene
        p, client = step.client.p, step.client.id
        rpm_max, hover = float(params.max_rpm[0]), float(params.hover_rpm[0])
        rpm_max = rpm_max if np.isfinite(rpm_max) else 2 * hover
        self._sliders = [
            p.addUserDebugParameter(f"rotor {i} (RPM)", 0, rpm_max, hover, physicsClientId=client) for i in range(4)
        ]
        self._button = p.addUserDebugParameter("use the sliders", 1, 0, 0, physicsClientId=client)  # 1 > 0: a button
        self._axes: dict[tuple[int, int], int] = {}
        p.resetDebugVisualizerCamera(1.5, -30, -30, [0, 0, 0.3], physicsClientId=client)
        self._start = time.monotonic()

    def __call__(self, params: Params, state: State, rpm: ArrayLike, scene: Scene | None = None) -> State:
        """Advance a team, then wait for real time."""
        p, client = self._step.client.p, self._step.client.id
        if p.readUserDebugParameter(self._button, physicsClientId=client) % 2:
            sliders = [p.readUserDebugParameter(slider, physicsClientId=client) for slider in self._sliders]
            rpm = np.tile(np.array(sliders, np.asarray(rpm).dtype), (len(state.pos), 1))
        state = self._step(params, state, rpm, scene)
        self._count += 1
        if self._count % max(1, round(1 / (self._dt * _AXES_HZ))) == 0:
            self._draw_axes(2 * float(params.arm[0]))
        time.sleep(max(0.0, self._start + self._count * self._dt - time.monotonic()))
        return state

    def rate(self, params: Params, state: State, rpm: ArrayLike, scene: Scene | None = None) -> State:
        """The time derivative, as of the Bullet step."""
        return self._step.rate(params, state, rpm, scene)

    def camera(self, params: Params, state: State, camera: Camera, scene: Scene | None = None) -> Images:
        """Images of the camera of every drone, as of the Bullet step."""
        return self._step.camera(params, state, camera, scene)

    def close(self) -> None:
        """End the connection to Bullet, which closes the window."""
        self._step.close()

    def _draw_axes(self, length: float) -> None:
        p, client = self._step.client.p, self._step.client.id
        for drone in self._step.client.drones:
            for axis, color in enumerate(_COLORS):
                end = [length if i == axis else 0 for i in range(3)]
                replaced = self._axes.get((drone, axis), -1)
                self._axes[drone, axis] = p.addUserDebugLine(
                    [0, 0, 0],
                    end,
                    color,
                    lineWidth=2,
                    parentObjectUniqueId=drone,
                    replaceItemUniqueId=replaced,
                    physicsClientId=client,
                )

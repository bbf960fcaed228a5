"""Vehicles with a measurement model of their logs, and folders of identified vehicles."""

import dataclasses
import json
import os
from pathlib import Path
from typing import Self

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.state import State
from jaxdrones.urdf import load_params
from jaxdrones.vector import components

URDF, REPORT = "vehicle.urdf", "report.json"
"""Files in the folder of `jaxdrones fit`."""

_SAG_THRESHOLD = 0.55  # V; up to this sag at take-off a Crazyflie's motors get the logged voltage


class Instruments(PyTreeNode):
    """Measurement model of a log; `Instruments.ideal()` has no errors."""

    delay: Array
    """() delay from the log to the effect of rotor speeds or PWM, s; negative for a late log."""
    tilt: Array
    """(2,) rotation about body x and y from the logged attitude to that of the rotors, rad."""
    position_scale: Array
    """() ratio of the horizontal distance in the logged positions to the integral of the logged velocities."""
    unfelt_sag: Array
    """() fraction of the battery's sag at take-off beyond 0.55 V that is logged without effect on the motors."""
    estimate_tilt: Array
    """() ratio of the tilt in the onboard state estimate to the true tilt."""
    estimate_delay: Array
    """() delay of position and attitude in the onboard state estimate, s."""

    @classmethod
    def ideal(cls) -> Self:
        """Instruments without errors: the log is the flight."""
        return cls(jnp.zeros(()), jnp.zeros(2), jnp.ones(()), jnp.zeros(()), jnp.ones(()), jnp.zeros(()))

    def true_attitude(self, logged: Float[Array, "4"]) -> Float[Array, "4"]:
        """Attitude of the rotors, from the logged one."""
        return rotation.multiply(logged, rotation.exp(jnp.append(self.tilt, 0.0)))

    def logged_attitude(self, true: Float[Array, "4"]) -> Float[Array, "4"]:
        """Logged attitude, from that of the rotors."""
        return rotation.multiply(true, rotation.exp(jnp.append(-self.tilt, 0.0)))

    def logged_position(self, true: Float[Array, "3"], start: Float[Array, "3"]) -> Float[Array, "3"]:
        """Logged position in a flight from `start`, m, world."""
        scale = jnp.stack([self.position_scale, self.position_scale, jnp.ones_like(self.position_scale)])
        return start + scale * (true - start)

    def motor_supply(self, logged: Float[Array, "*n"], sag: Float[Array, "*#n"]) -> Float[Array, "*n"]:
        """Voltage of the motors at full PWM with a logged battery voltage and its sag at take-off, V."""
        return logged + self.unfelt_sag * jnp.maximum(sag - _SAG_THRESHOLD, 0)

    def estimate(self, state: State) -> State:
        """Onboard state estimate of one drone in a true state."""
        late = rotation.multiply(state.quat, rotation.exp(-self.estimate_delay * state.omega))
        x, y, _ = components(rotation.z_axis(late))
        more_tilt = (self.estimate_tilt - 1) * jnp.stack([-y, x, jnp.zeros_like(x)])
        return state.replace(
            pos=state.pos - self.estimate_delay * state.vel, quat=rotation.multiply(rotation.exp(more_tilt), late)
        )


class Vehicle(PyTreeNode):
    """Parameters of one drone and of its instruments."""

    params: Params
    instruments: Instruments

    @classmethod
    def of(cls, params: Params) -> Self:
        """Vehicle with ideal instruments."""
        return cls(params, Instruments.ideal())


def load_vehicle(vehicle: str | os.PathLike) -> Vehicle:
    """Load a bundled vehicle or a URDF, with ideal instruments, or a folder of `jaxdrones fit` with fitted ones.

    Raises:
        UserError: an unknown vehicle, or invalid files.
    """
    folder = Path(vehicle)
    if not folder.is_dir():
        return Vehicle.of(load_params(vehicle))
    report = folder / REPORT
    try:
        entries = json.loads(report.read_text())["instruments"]
        names = [field.name for field in dataclasses.fields(Instruments)]
        instruments = Instruments(**{name: jnp.asarray(entries[name], float) for name in names})
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{report}: cannot be read ({error!r}); give the --output folder of `jaxdrones fit`") from None
    return Vehicle(load_params(folder / URDF), instruments)

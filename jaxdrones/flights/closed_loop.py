"""Closed-loop simulation with the firmware's PID on the set-points of a recorded flight."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.control import Setpoint, firmware_pid
from jaxdrones.dynamics.propulsion import FULL_PWM, Motors
from jaxdrones.errors import UserError
from jaxdrones.flights.log import PERIOD, FlightLog
from jaxdrones.flights.open_loop import lagged_rpm, moved
from jaxdrones.flights.vehicle import Vehicle
from jaxdrones.state import State
from jaxdrones.thrust_curves import thrust_at

_SUBSTEPS = 5  # per row: the firmware's attitude and rate loops run at 500 Hz
_THRUST_PER_OUTPUT = 1000.0  # gain from the output of the firmware's vertical velocity loop to its thrust command
_BLOCK = 500  # rows; inputs are padded to a multiple of it, to share compiled programs between flights
_CLIMB_TOLERANCE = 0.15  # m, distance to the height of the set-point at the end of the climb
_MIN_HEIGHT = 0.3  # m; below it the drone takes off or lands
_SATURATED_FRACTION = 0.01  # fraction of the rows with a saturated motor above which a flight counts as saturated


@dataclasses.dataclass(frozen=True)
class ClosedLoopResult:
    """Recorded flight and its closed-loop simulation in the K rows between climb and landing."""

    flight: str
    """Name of the log."""
    t: np.ndarray
    """(K,) time, s."""
    pos: np.ndarray
    """(K, 3) recorded position, m, world."""
    sim: State
    """Simulated states, (K, ...) on every array."""
    ref_pos: np.ndarray
    """(K, 3) set-points of the position, m, world."""
    pwm: np.ndarray
    """(K, 4) recorded PWM, 0 to 65535."""
    sim_pwm: np.ndarray
    """(K, 4) simulated PWM, 0 to 65535."""

    @property
    def sim_pos(self) -> np.ndarray:
        """(K, 3) simulated position, m, world."""
        return np.asarray(self.sim.pos)

    def as_dict(self) -> dict[str, float | str | bool]:
        """RMS distances between the paths, RMS tracking errors and mean PWM, for JSON."""

        def rms(a: np.ndarray, b: np.ndarray, axes: int = 3) -> float:
            return float(np.sqrt(np.mean(np.sum((a - b)[:, :axes] ** 2, axis=1))))

        saturated = max(np.mean(np.max(pwm, axis=1) >= FULL_PWM) for pwm in (self.pwm, self.sim_pwm))
        return {
            "flight": self.flight,
            "xy_rms_m": rms(self.sim_pos, self.pos, 2),
            "xyz_rms_m": rms(self.sim_pos, self.pos),
            "tracking_real_m": rms(self.pos, self.ref_pos),
            "tracking_sim_m": rms(self.sim_pos, self.ref_pos),
            "pwm_real": float(np.mean(self.pwm)),
            "pwm_sim": float(np.mean(self.sim_pwm)),
            "saturated": bool(saturated > _SATURATED_FRACTION),
        }


class ClosedLoopInputs(NamedTuple):
    """Inputs of a closed-loop simulation: initial state, and K rows of set-points and battery from take-off."""

    start: State
    """Initial state: upright and at rest on the ground, or the logged one for a log that begins in flight."""
    ground: Float[Array, ""]
    """Height at rest on the ground, m; minus infinity for a log that begins in flight."""
    setpoint: Setpoint
    """Set-points, (K,) on every array."""
    battery: Float[Array, " K"]
    """Voltage of the battery, V."""
    sag: Float[Array, ""]
    """Sag of the battery at take-off, V."""


def closed_loop_columns(log: FlightLog) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Set-points of position (K, 3) and heading (K,), PWM (K, 4) and battery voltage (K,) of a log."""
    if not log.has("target_pos", "target_yaw", "pwm", "vbat"):
        raise UserError(f"{log.name}: has no set-points; add ref_pos, ref_yaw, pwm and vbat for a closed loop")
    return log.target_pos[:, 0], log.target_yaw[:, 0], log.pwm[:, 0], log.vbat[:, 0]


def rows_after_climb(log: FlightLog) -> slice:
    """Rows from the end of the climb to the landing."""
    ref_pos, *_ = closed_loop_columns(log)
    height = log.pos[:, 0, 2]
    up = log.in_flight & (height > _MIN_HEIGHT) & (np.abs(height - ref_pos[:, 2]) < _CLIMB_TOLERANCE)
    if not up.any():
        raise UserError(
            f"{log.name}: is never within {_CLIMB_TOLERANCE:g} m of the height of its set-point; give another flight"
        )
    return slice(int(np.argmax(up)), int(np.flatnonzero(log.in_flight & (height > _MIN_HEIGHT))[-1]) + 1)


def closed_loop_inputs(log: FlightLog) -> ClosedLoopInputs:
    """Initial state, set-points and battery of a log, from the start of the motors."""
    stop = rows_after_climb(log).stop
    begin = motor_start_row(log)
    ref_pos, ref_yaw, _, vbat = closed_loop_columns(log)
    pos, quat, vel, omega = (jnp.asarray(x[begin, 0], float) for x in (log.pos, log.quat, log.vel, log.omega))
    start, ground = State(pos, quat, vel, omega, jnp.zeros(4)), jnp.array(-jnp.inf)
    if begin > 0:
        upright = rotation.from_rpy(rotation.to_rpy(quat) * jnp.array([0.0, 0, 1]))
        start, ground = State(pos, upright, jnp.zeros(3), jnp.zeros(3), jnp.zeros(4)), pos[2]
    length = -(-(stop - begin) // _BLOCK) * _BLOCK
    rows = np.minimum(np.arange(begin, begin + length), stop - 1)
    setpoint = Setpoint.at(jnp.asarray(ref_pos[rows], float), yaw=jnp.asarray(ref_yaw[rows], float))
    return ClosedLoopInputs(start, ground, setpoint, jnp.asarray(vbat[rows], float), jnp.asarray(log.sag, float))


def motor_start_row(log: FlightLog) -> int:
    """First row with all motors running."""
    return int(np.argmax(log.in_flight))


def simulate_closed_loop(
    log: FlightLog, vehicle: Vehicle, motors: Motors, gains: firmware_pid.Gains
) -> ClosedLoopResult:
    """Simulate a vehicle in closed loop on the set-points of a log, which also has PWM and battery voltage.

    The firmware's PID starts on the ground, with empty integrators, when the motors of the log start. Until the landing
    its only inputs are the logged set-points and battery voltage. For a log that begins in flight, the simulation
    starts in that state, with the vertical integrator at its value in hover. The result has the rows after the climb.
    """
    rows, begin = rows_after_climb(log), motor_start_row(log)
    ref_pos, _, recorded_pwm, _ = closed_loop_columns(log)
    simulated = jax.device_get(_simulate(vehicle, motors, gains, closed_loop_inputs(log)))
    sim, pwm = jax.tree.map(lambda x: x[rows.start - begin : rows.stop - begin], simulated)
    return ClosedLoopResult(log.name, log.t[rows], log.pos[rows, 0], sim, ref_pos[rows], recorded_pwm[rows], pwm)


def simulate(
    vehicle: Vehicle, motors: Motors, gains: firmware_pid.Gains, inputs: ClosedLoopInputs
) -> tuple[State, Float[Array, "K 4"]]:
    """States, (K, ...) on every array, and PWM (0 to 65535) of a closed-loop simulation."""
    params, instruments = vehicle.params, vehicle.instruments
    dt = PERIOD / _SUBSTEPS

    def substep(carry, setpoint, battery):
        memory, state = carry
        memory, command = firmware_pid.pwm(gains, memory, instruments.estimate(state), setpoint, battery, dt=dt)
        thrust = motors.thrust(command.pwm / FULL_PWM * instruments.motor_supply(battery, inputs.sag))
        rpm = lagged_rpm(params, state.rpm, thrust, dt)
        after = moved(params, state.replace(rpm=rpm), rpm, jnp.zeros(4), dt)
        return (memory, _above_ground(inputs, after)), command.pwm

    def row(carry, row_inputs):
        after, pwm = jax.lax.scan(lambda carry, _: substep(carry, *row_inputs), carry, length=_SUBSTEPS)
        return after, (carry[1], jnp.mean(pwm, axis=0))

    flying = jnp.isinf(inputs.ground)
    integral = jnp.where(flying, _hover_integral(vehicle, motors, gains, inputs), 0)
    memory = firmware_pid.init().replace(vel_integral=integral * jnp.array([0.0, 0, 1]))
    start = inputs.start.replace(rpm=jnp.where(flying, params.hover_rpm, 0) * jnp.ones(4))
    return jax.lax.scan(row, (memory, start), (inputs.setpoint, inputs.battery))[1]


def _above_ground(inputs: ClosedLoopInputs, state: State) -> State:
    """State, or below the ground the initial state with the present rotor speeds."""
    standing = inputs.start.replace(rpm=state.rpm)
    return jax.tree.map(lambda a, b: jnp.where(state.pos[2] < inputs.ground, a, b), standing, state)


def _hover_integral(
    vehicle: Vehicle, motors: Motors, gains: firmware_pid.Gains, inputs: ClosedLoopInputs
) -> Float[Array, ""]:
    """Integral of the vertical velocity error, m, for a thrust command equal to the weight."""
    battery = inputs.battery[0]
    duty = motors.voltage(vehicle.params.weight / 4) / vehicle.instruments.motor_supply(battery, inputs.sag)
    command = thrust_at(gains.motor.thrust, duty * battery) / gains.motor.max_thrust * FULL_PWM
    return (command - gains.base_thrust) / (_THRUST_PER_OUTPUT * gains.vel_i[2])


_simulate = jax.jit(simulate)

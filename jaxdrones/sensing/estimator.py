"""On-board state estimation from an IMU and motion capture."""

from typing import Annotated, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdrones import rotation
from jaxdrones.arguments import Hertz, checked
from jaxdrones.checks import check_number, check_shape
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.quantity import quantities
from jaxdrones.sensing import inertial, kalman
from jaxdrones.sensing.inertial import BMI088, ImuPart
from jaxdrones.sensing.mocap import VICON, MotionCaptureSystem
from jaxdrones.sensing.noise import Errors
from jaxdrones.sensing.scene import Scene
from jaxdrones.sensing.sensor import Sensor
from jaxdrones.state import State

_ROUNDING = 1e-6  # of a number of periods


def _check_start(name: str, start: Any) -> None:
    """Raise unless these are three standard deviations."""
    check_shape(f"{name} of state_estimate", start, (3,), "of position (m), velocity (m/s) and angle (rad)")
    for deviation in start:
        check_number(f"{name} of state_estimate", deviation, at_least=0)


class Sample(PyTreeNode):
    """One set of measurements: the IMU's means over the period before an instant, and the pose at the instant."""

    gyro: Array
    """(3,) rad/s, body."""
    acc: Array
    """(3,) specific force, m/s^2, body."""
    pos: Array
    """(3,) m, world."""
    quat: Array
    """(4,) body to world."""
    fresh: Array
    """() whether there is a pose."""


class Memory(PyTreeNode):
    """Memory of the sensor `state_estimate`."""

    estimate: kalman.Estimate
    """Estimate at the instant of the last pose that arrived or was due."""
    imu: dict[str, Errors]
    """Errors of the IMU."""
    samples: Sample
    """The samples of the estimate's instant and of all instants since, with a leading axis, the oldest one first."""
    quat: Array
    """(4,) attitude at the latest instant, at which the IMU begins to integrate."""
    vel: Array
    """(3,) velocity at the latest instant, m/s, world."""
    count: Array
    """() number of measurements."""


def imu_noise(part: ImuPart) -> kalman.ImuNoise:
    """Noise model of an IMU for the filter; a Gauss-Markov bias becomes a random walk."""
    densities = part.gyro.density, part.acc.density, part.gyro.bias_walk, part.acc.bias_walk
    return kalman.ImuNoise(*(jnp.asarray(density, float) for density in densities))


@checked
def state_estimate(
    part: ImuPart = BMI088,
    system: MotionCaptureSystem = VICON,
    rate: Hertz = 100.0,
    *,
    attitude: bool = True,
    start: Annotated[tuple[float, float, float], _check_start] = (0.001, 0.02, 0.01),
    name: str = "state_estimate",
) -> Sensor:
    """State estimate of an error-state Kalman filter; its reading is a `State` for policies and controllers.

    The filter, `jaxdrones.sensing.kalman`, fuses an IMU at the center of mass with motion capture. The IMU integrates
    over its period, as in flight controllers. Poses arrive late: the filter updates at their instant, and the IMU's
    samples since then propagate its estimate to the present. The reading's `rpm` is that of the drone, as in telemetry,
    and its `aux` is empty. The memory's `estimate` has the covariance. The filter does not model scale errors,
    saturation, or colored noise of poses.

    Args:
        part: errors of the IMU.
        system: rate, delay, dropouts and noise of the poses; rate and delay are multiples of the IMU's period.
        rate: of the IMU and of the estimates, 1/s; the control rate of the environment is a multiple of it.
        attitude: whether to use the attitude of the poses, or the position alone.
        start: standard deviations of the first estimate's position (m), velocity (m/s) and angle (rad).
        name: name of the reading in observation terms.

    Raises:
        ValueError: poses without noise, or with a rate or delay that is not a multiple of the IMU's period.
    """
    for noise, unit in ("pos_noise", "m"), *[("angle_noise", "rad")] * attitude:
        check_number(f"{noise} of {name}", getattr(system, noise), unit, above=0)
    every = _whole(name, "rate", rate / system.rate, f"{system.rate:g} Hz", rate, at_least=1)
    late = _whole(name, "delay", system.delay * rate, f"{system.delay:g} s", rate, at_least=0)
    dt = 1 / rate

    def init(key: jax.Array, params: Params) -> Memory:
        zero = jnp.zeros(3, params.mass.dtype)
        level = jnp.zeros(4, zero.dtype).at[3].set(1)
        sample = Sample(zero, zero, zero, level, jnp.zeros((), bool))
        return Memory(
            estimate=kalman.init(zero, zero, level, jnp.zeros(15, zero.dtype)),
            imu=inertial.begin(part, key, params),
            samples=jax.tree.map(lambda x: jnp.tile(x[None], (late + 1, *[1] * x.ndim)), sample),
            quat=level,
            vel=zero,
            count=jnp.zeros((), jnp.int32),
        )

    def measure(key: jax.Array, params: Params, state: State, rate: State, scene: Scene, memory: Memory):
        start_key, imu_key, pose_key, arrival_key = jax.random.split(key, 4)
        true = inertial.mean_motion(params, memory.quat, memory.vel, state, dt)
        true = _chosen(memory.count == 0, inertial.motion(params, state, rate), true)
        errors, read = inertial.read(part, imu_key, memory.imu, true, dt)
        pos, quat = system.noisy(pose_key, state.pos, state.quat)
        fresh = (memory.count % every == 0) & system.arrives(arrival_key)
        sample = Sample(read["gyro"], read["acc"], pos, quat, fresh)
        samples = jax.tree.map(lambda old, new: jnp.concatenate([old[1:], new[None]]), memory.samples, sample)

        first = begin(start_key, state)
        moved = advanced(memory.estimate, samples, params.gravity)
        estimate = _chosen(memory.count == 0, first, _chosen(memory.count > late, moved, memory.estimate))

        def forward(now: kalman.Estimate, since: tuple[Array, Sample]) -> tuple[kalman.Estimate, None]:
            number, sample = since
            return _chosen(number > 0, kalman.move(now, sample.gyro, sample.acc, params.gravity, dt), now), None

        numbers = memory.count - late + jnp.arange(late + 1)  # of the samples; negative where there was none yet
        since = jax.tree.map(lambda x: x[1:], (numbers, samples))
        now = jax.lax.scan(forward, estimate, since)[0]
        after = Memory(estimate, errors, samples, state.quat, state.vel, memory.count + 1)
        return after, seen(now, state, read, true)

    def begin(key: jax.Array, state: State) -> kalman.Estimate:
        """First estimate: the true state with errors."""
        dtype = state.pos.dtype
        deviation = jnp.repeat(jnp.asarray([*start, part.gyro.bias, part.acc.bias], dtype), 3)
        error = deviation[:9] * jax.random.normal(key, (9,), dtype)
        quat = rotation.multiply(state.quat, rotation.exp(error[kalman.ANGLE]))
        return kalman.init(state.pos + error[kalman.POS], state.vel + error[kalman.VEL], quat, deviation)

    def advanced(estimate: kalman.Estimate, samples: Sample, gravity: Array) -> kalman.Estimate:
        """Estimate one period later, with that pose if it arrived."""
        now = jax.tree.map(lambda x: x[0], samples)
        predicted = kalman.predict(imu_noise(part), estimate, now.gyro, now.acc, gravity, dt)
        updated = kalman.update_position(predicted, now.pos, system.pos_noise)
        if attitude:
            updated = kalman.update_attitude(updated, now.quat, system.angle_noise)
        return _chosen(now.fresh, updated, predicted)

    entries = (
        *quantities("position estimated", "m", "world"),
        *quantities("attitude estimated (quaternion, body to world)", parts="xyzw"),
        *quantities("velocity estimated", "m/s", "world"),
        *quantities("body rates estimated", "rad/s", "body"),
        *quantities("rotors", "RPM", parts=("speed of rotor 0", "1", "2", "3")),
    )
    return Sensor(name, measure, init, rate=rate, entries=entries, clocked=rate)


def seen(now: kalman.Estimate, state: State, read: dict[str, Array], true: dict[str, Array]) -> State:
    """Estimated state; body rates are those of the gyroscope, less its estimated bias.

    The error of the reading, which is a mean over the period, is used as that at the instant.
    """
    omega = state.omega + (read["gyro"] - true["gyro"]) - now.gyro_bias
    return State(now.pos, now.quat, now.vel, omega, state.rpm)


def _chosen(condition: Array, a: Any, b: Any) -> Any:
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def _whole(name: str, what: str, periods: float, given: str, rate: float, at_least: int) -> int:
    """Number of periods of the IMU as an integer; raise where it is not whole."""
    whole = round(periods)
    if whole < at_least or abs(periods - whole) > _ROUNDING * max(periods, 1):
        raise UserError(
            f"{what} of the poses of {name} is {given}, {periods:g} periods of the IMU at {rate:g} Hz; "
            "give one that is a whole number of them"
        )
    return whole

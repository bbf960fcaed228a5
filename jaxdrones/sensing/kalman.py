"""Error-state Kalman filter of attitude, velocity and position from an IMU and pose measurements.

The IMU propagates the nominal state. The error state (15,) is position (m) and velocity (m/s) in world axes, the
rotation (rad) from the estimated to the true body in body axes, and the biases of gyroscope (rad/s) and accelerometer
(m/s^2); the filter keeps its covariance. Solà, "Quaternion kinematics for the error-state Kalman filter", 2017,
sections 5 and 6.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.pytree import PyTreeNode
from jaxdrones.vector import along_z

POS, VEL, ANGLE, GYRO_BIAS, ACC_BIAS = (slice(3 * k, 3 * k + 3) for k in range(5))
"""Slices of the error state, (3,) each."""


class Estimate(PyTreeNode):
    """Nominal state and error covariance of one drone."""

    pos: Array
    """(3,) m, world."""
    vel: Array
    """(3,) m/s, world."""
    quat: Array
    """(4,) unit quaternion (x, y, z, w), body to world."""
    gyro_bias: Array
    """(3,) rad/s."""
    acc_bias: Array
    """(3,) m/s^2."""
    cov: Array
    """(15, 15) covariance of the error."""


class ImuNoise(PyTreeNode):
    """Noise densities of an IMU; scalars, or (3,) one for each axis."""

    gyro: Array
    """White noise of the gyroscope, rad/s/sqrt(Hz)."""
    acc: Array
    """White noise of the accelerometer, m/s^2/sqrt(Hz)."""
    gyro_walk: Array
    """Random walk of the gyroscope's bias, rad/s^2/sqrt(Hz)."""
    acc_walk: Array
    """Random walk of the accelerometer's bias, m/s^3/sqrt(Hz)."""


def init(
    pos: Float[Array, "3"], vel: Float[Array, "3"], quat: Float[Array, "4"], deviation: Float[Array, "15"]
) -> Estimate:
    """Initial estimate, without correlations and with zero biases; `deviation` is that of each part of the error."""
    zero = jnp.zeros_like(pos)
    return Estimate(pos, vel, quat, zero, zero, jnp.diag(deviation**2))


def predict(
    noise: ImuNoise,
    estimate: Estimate,
    gyro: Float[Array, "3"],
    acc: Float[Array, "3"],
    gravity: Float[Array, ""],
    dt: float | Array,
) -> Estimate:
    """Propagate the estimate and its covariance by one time step.

    Args:
        noise: of the IMU.
        estimate: at the start of the step.
        gyro: mean reading in the step, rad/s, body, or approximately the mean of the readings at its start and end.
        acc: mean reading in the step, specific force, m/s^2, in the body axes of mid-step.
        gravity: m/s^2.
        dt: time step, s.
    """
    # Rows are errors after the step and columns those before it, of position, velocity, angle and biases.
    eye, zero = jnp.eye(3, dtype=estimate.pos.dtype), jnp.zeros((3, 3), estimate.pos.dtype)
    half_turn = rotation.exp((gyro - estimate.gyro_bias) * dt / 2)
    middle = rotation.to_matrix(rotation.multiply(estimate.quat, half_turn))
    back = rotation.to_matrix(rotation.multiply(half_turn, half_turn)).T
    tilt = -middle @ _skew(acc - estimate.acc_bias) @ rotation.to_matrix(half_turn).T  # acceleration per angle
    transition = jnp.block(
        [
            [eye, dt * eye, dt**2 / 2 * tilt, -(dt**3) / 4 * tilt, -(dt**2) / 2 * middle],
            [zero, eye, dt * tilt, -(dt**2) / 2 * tilt, -dt * middle],
            [zero, zero, back, -dt * eye, zero],
            [zero, zero, zero, eye, zero],
            [zero, zero, zero, zero, eye],
        ]
    )
    growth = [jnp.zeros(3), noise.acc, noise.gyro, noise.gyro_walk, noise.acc_walk]
    added = jnp.concatenate([jnp.broadcast_to(x, (3,)).astype(eye.dtype) ** 2 * dt for x in growth])
    cov = transition @ estimate.cov @ transition.T + jnp.diag(added)
    return move(estimate, gyro, acc, gravity, dt).replace(cov=cov)


def move(
    estimate: Estimate, gyro: Float[Array, "3"], acc: Float[Array, "3"], gravity: Float[Array, ""], dt: float | Array
) -> Estimate:
    """Propagate the nominal state alone; arguments are those of `predict`."""
    turn = (gyro - estimate.gyro_bias) * dt
    middle = rotation.multiply(estimate.quat, rotation.exp(turn / 2))
    gained = (rotation.rotate(middle, acc - estimate.acc_bias) - along_z(gravity)) * dt
    return estimate.replace(
        pos=estimate.pos + (estimate.vel + gained / 2) * dt,
        vel=estimate.vel + gained,
        quat=rotation.normalize(rotation.multiply(estimate.quat, rotation.exp(turn))),
    )


def update(
    estimate: Estimate, residual: Float[Array, " k"], jacobian: Float[Array, "k 15"], cov: Float[Array, "k k"]
) -> Estimate:
    """Update the estimate with a residual, measured less expected; the covariance is in Joseph's form."""
    projected = jacobian @ estimate.cov
    gain = jnp.linalg.solve(projected @ jacobian.T + cov, projected).T
    kept = jnp.eye(15, dtype=gain.dtype) - gain @ jacobian
    error = gain @ residual
    after = kept @ estimate.cov @ kept.T + gain @ cov @ gain.T
    # The correction of the attitude rotates the body axes of its error.
    reset = jnp.eye(15, dtype=gain.dtype).at[ANGLE, ANGLE].add(-_skew(error[ANGLE] / 2))
    after = reset @ after @ reset.T
    return Estimate(
        pos=estimate.pos + error[POS],
        vel=estimate.vel + error[VEL],
        quat=rotation.normalize(rotation.multiply(estimate.quat, rotation.exp(error[ANGLE]))),
        gyro_bias=estimate.gyro_bias + error[GYRO_BIAS],
        acc_bias=estimate.acc_bias + error[ACC_BIAS],
        cov=(after + after.T) / 2,
    )


def update_position(
    estimate: Estimate, pos: Float[Array, "3"], deviation: float | Array, offset: Float[Array, "3"] | None = None
) -> Estimate:
    """Update the estimate with the position (m, world) of a point at an offset (m, body) from the IMU."""
    eye = jnp.eye(3, dtype=pos.dtype)
    offset = jnp.zeros_like(pos) if offset is None else offset
    turned = -rotation.to_matrix(estimate.quat) @ _skew(offset)
    jacobian = jnp.zeros((3, 15), pos.dtype).at[:, POS].set(eye).at[:, ANGLE].set(turned)
    residual = pos - estimate.pos - rotation.rotate(estimate.quat, offset)
    return update(estimate, residual, jacobian, deviation**2 * eye)


def update_attitude(estimate: Estimate, quat: Float[Array, "4"], deviation: float | Array) -> Estimate:
    """Update the estimate with a measured attitude, with this standard deviation about each axis, rad."""
    jacobian = jnp.zeros((3, 15), quat.dtype).at[:, ANGLE].set(jnp.eye(3, dtype=quat.dtype))
    return update(estimate, angle(estimate.quat, quat), jacobian, deviation**2 * jnp.eye(3, dtype=quat.dtype))


def update_height(estimate: Estimate, height: Float[Array, ""], deviation: float | Array) -> Estimate:
    """Update the estimate with a measured height, with this standard deviation, m."""
    jacobian = jnp.zeros((1, 15), height.dtype).at[0, 2].set(1)
    return update(estimate, (height - estimate.pos[2])[None], jacobian, deviation**2 * jnp.eye(1, dtype=height.dtype))


def update_direction(
    estimate: Estimate, measured: Float[Array, "3"], world: Float[Array, "3"], deviation: float | Array
) -> Estimate:
    """Update the estimate with a measured vector, in body axes, of known world direction, such as the magnetic field.

    The standard deviation of each axis is in units of the vector.
    """
    expected = rotation.rotate_inverse(estimate.quat, world)
    jacobian = jnp.zeros((3, 15), world.dtype).at[:, ANGLE].set(_skew(expected))
    return update(estimate, measured - expected, jacobian, deviation**2 * jnp.eye(3, dtype=world.dtype))


def error(
    estimate: Estimate,
    pos: Float[Array, "3"],
    vel: Float[Array, "3"],
    quat: Float[Array, "4"],
    gyro_bias: Float[Array, "3"],
    acc_bias: Float[Array, "3"],
) -> Float[Array, "15"]:
    """True state less estimated state, in the order of the covariance."""
    return jnp.concatenate(
        [
            pos - estimate.pos,
            vel - estimate.vel,
            angle(estimate.quat, quat),
            gyro_bias - estimate.gyro_bias,
            acc_bias - estimate.acc_bias,
        ]
    )


def angle(a: Float[Array, "4"], b: Float[Array, "4"]) -> Float[Array, "3"]:
    """Rotation vector from attitude a to attitude b, rad, in the axes of a."""
    return rotation.log(rotation.multiply(rotation.conjugate(a), b))


def _skew(v: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Matrix of v x."""
    x, y, z = v
    zero = jnp.zeros_like(x)
    return jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])

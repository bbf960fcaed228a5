"""An inertial measurement unit: accelerometers and gyroscopes with white noise and biases that walk at random."""

import dataclasses

import jax
import jax.numpy as jnp

import jaxdrones as jd


@dataclasses.dataclass(frozen=True)
class Imu:
    """Where the unit is and how well it measures; the defaults have no error."""

    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m from the center of mass, body
    dt: float = 0.01  # s between measurements
    acc_noise: float = 0.0  # m/s^2, standard deviation of a measurement
    gyro_noise: float = 0.0  # rad/s
    acc_walk: float = 0.0  # m/s^2 per root of a second, of the random walk of the bias
    gyro_walk: float = 0.0  # rad/s per root of a second

    @property
    def sensor(self) -> jd.Sensor:
        """Readings `acc` (3,) m/s^2, the specific force, and `gyro` (3,) rad/s, both in body axes."""
        return jd.Sensor("imu", self._measure, self._init, bound=200.0)

    def _init(self, key, params):
        zero = jnp.zeros(3, params.mass.dtype)
        return {"acc": zero, "gyro": zero}

    def _measure(self, key, params, state, rate, scene, bias):
        keys = jax.random.split(key, 4)
        normal = [jax.random.normal(key, (3,), state.pos.dtype) for key in keys]
        root_dt = jnp.sqrt(jnp.asarray(self.dt, state.pos.dtype))
        bias = {
            "acc": bias["acc"] + self.acc_walk * root_dt * normal[0],
            "gyro": bias["gyro"] + self.gyro_walk * root_dt * normal[1],
        }
        acc = specific_force(params, state, rate, jnp.asarray(self.offset, state.pos.dtype))
        return bias, {
            "acc": acc + bias["acc"] + self.acc_noise * normal[2],
            "gyro": state.omega + bias["gyro"] + self.gyro_noise * normal[3],
        }


def specific_force(params, state, rate, offset):
    """R^T (a - g) + omega_dot x r + omega x (omega x r) at r from the center of mass, m/s^2, body."""
    cross, omega = jd.vector.cross, state.omega
    at_center = jd.rotation.rotate_inverse(state.quat, rate.vel + jd.vector.along_z(params.gravity))
    return at_center + cross(rate.omega, offset) + cross(omega, cross(omega, offset))

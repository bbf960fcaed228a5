"""A range finder that looks along the body's -z axis, as the one below a Crazyflie."""

import dataclasses

import jax
import jax.numpy as jnp

import jaxdrones as jd
from jaxdrones.sensing import ray


@dataclasses.dataclass(frozen=True)
class RangeFinder:
    """How far it measures and how well; the default has no error."""

    max_range: float = 4.0  # m; the reading where there is nothing nearer
    noise: float = 0.0  # standard deviation, as a share of the range

    @property
    def sensor(self) -> jd.Sensor:
        """The reading () is the distance from the center of mass to the first surface below, m."""
        return jd.Sensor("range", self._measure, bound=self.max_range)

    def _measure(self, key, params, state, rate, scene, memory):
        down = -jd.rotation.z_axis(state.quat)
        distance = jnp.minimum(ray(scene, state.pos, down), self.max_range)
        measured = distance * (1 + self.noise * jax.random.normal(key, (), state.pos.dtype))
        return memory, jnp.clip(measured, 0, self.max_range)

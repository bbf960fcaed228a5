"""Motion capture, with noise, delay and dropouts."""

import dataclasses
import math
from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.arguments import checked, number
from jaxdrones.params import Params
from jaxdrones.quantity import Quantity, quantities
from jaxdrones.sensing.scene import Scene
from jaxdrones.sensing.sensor import Sensor
from jaxdrones.state import State

_NAME = "{argument} of {function}"
_AMOUNT = number(name=_NAME, at_least=0)


@checked
@dataclasses.dataclass(frozen=True, kw_only=True)
class MotionCaptureSystem:
    """Rate, delay, dropouts and noise of a motion capture system."""

    rate: Annotated[float, number("1/s", _NAME, above=0)] = 100.0
    """Poses per second."""
    delay: Annotated[float, _AMOUNT] = 0.0
    """Age of a pose when it arrives, s."""
    dropout: Annotated[float, number("a fraction", _NAME, at_least=0, at_most=1)] = 0.0
    """Fraction of lost poses."""
    pos_noise: Annotated[float, _AMOUNT] = 0.0
    """Standard deviation of each coordinate, m."""
    angle_noise: Annotated[float, _AMOUNT] = 0.0
    """Standard deviation of the attitude about each axis, rad."""

    def noisy(
        self, key: jax.Array, pos: Float[Array, "3"], quat: Float[Array, "4"]
    ) -> tuple[Float[Array, "3"], Float[Array, "4"]]:
        """Pose with noise."""
        pos_key, angle_key = jax.random.split(key)
        pos = pos + self.pos_noise * jax.random.normal(pos_key, (3,), pos.dtype)
        turn = self.angle_noise * jax.random.normal(angle_key, (3,), quat.dtype)
        return pos, rotation.multiply(quat, rotation.exp(turn))

    def arrives(self, key: jax.Array) -> Array:
        """Whether a pose arrives."""
        return jax.random.bernoulli(key, 1 - self.dropout)


VICON = MotionCaptureSystem(rate=100.0, delay=0.01, pos_noise=0.5e-3, angle_noise=0.01)
"""A Vicon system around a Crazyflie. Merriaux et al., "A Study of Vicon System Positioning Performance", Sensors 17(7),
2017, found 0.15 mm at rest and up to 2 mm in motion. The error of the attitude is that of small markers: 0.4 to 1.1
degrees in NanoBench's flights (docs/sensors.md). The delay is assumed."""


def motion_capture(system: MotionCaptureSystem = VICON, name: str = "motion_capture") -> Sensor:
    """Motion capture; its reading is `pos` (3,), m, world, `quat` (4,), body to world, and `fresh`.

    `fresh` () is true where a pose arrived; otherwise the last pose stays. A delay that is not a multiple of the period
    reads a mean of two measured poses. Before the start the drone rests at its initial pose.
    """
    periods = system.delay * system.rate
    late = math.ceil(periods - 1e-6)
    share = late - periods  # of the later one of the two poses that are `late` and `late` - 1 periods old

    def init(key: jax.Array, params: Params) -> dict[str, Array]:
        dtype = params.mass.dtype
        poses = {"pos": jnp.zeros((late + 1, 3), dtype), "quat": jnp.zeros((late + 1, 4), dtype)}
        return {
            **poses,
            "last_pos": jnp.zeros(3, dtype),
            "last_quat": jnp.zeros(4, dtype),
            "begun": jnp.zeros((), bool),
        }

    def measure(key: jax.Array, params: Params, state: State, rate: State, scene: Scene, memory: dict[str, Array]):
        noise_key, arrival_key = jax.random.split(key)

        def queue(old: Array, new: Array) -> Array:
            return jnp.where(memory["begun"], jnp.concatenate([old[1:], new[None]]), jnp.tile(new[None], (late + 1, 1)))

        pos, quat = queue(memory["pos"], state.pos), queue(memory["quat"], state.quat)
        later = min(1, late)
        nearer = jnp.where(quat[0] @ quat[later] < 0, -quat[later], quat[later])
        seen = system.noisy(
            noise_key,
            (1 - share) * pos[0] + share * pos[later],
            rotation.normalize((1 - share) * quat[0] + share * nearer),
        )
        fresh = system.arrives(arrival_key) | ~memory["begun"]
        last_pos, last_quat = (
            jnp.where(fresh, new, old) for new, old in zip(seen, (memory["last_pos"], memory["last_quat"]), strict=True)
        )
        after = {"pos": pos, "quat": quat, "last_pos": last_pos, "last_quat": last_quat, "begun": jnp.ones((), bool)}
        return after, {"pos": last_pos, "quat": last_quat, "fresh": fresh}

    entries = (
        Quantity("arrival of a pose", "-"),
        *quantities("position measured", "m", "world"),
        *quantities("attitude measured (quaternion, body to world)", parts="xyzw"),
    )
    return Sensor(name, measure, init, rate=system.rate, entries=entries, clocked=system.rate)

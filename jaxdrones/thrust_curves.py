"""Thrust of one motor as a monotonic cubic of its mean voltage."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.vector import components

THRUST_CURVES = {
    "2.1": (-0.014830745, 0.047244652, -0.018473644, 0.005960924),
    "2.1+": (-0.024765379, 0.065237935, -0.026792505, 0.006776789),
    "thrust upgrade": (-0.039782216, 0.109797389, -0.055453043, 0.016215002),
}
"""Of the motors of the Crazyflie, N/V^0 to N/V^3, by propellers: the firmware's constants (Bitcraze, 2025.12)."""


def thrust_at(coefficients: Float[Array, "4"], voltage: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Thrust at a voltage (V), N."""
    a, b, c, d = components(coefficients)
    return a + voltage * (b + voltage * (c + voltage * d))


def voltage_for(coefficients: Float[Array, "4"], thrust: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Voltage for a thrust (N), V: the single root of the cubic."""
    a, b, c, d = components(coefficients)
    middle = -c / (3 * d)  # where the cubic is least steep
    p = b / d - 3 * middle**2
    q = (a + middle * (b + middle * (c + middle * d)) - thrust) / d
    scale = jnp.sqrt(p / 3)
    return middle - 2 * scale * jnp.sinh(jnp.arcsinh(q / (2 * scale**3)) / 3)

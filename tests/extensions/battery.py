"""A lithium-polymer cell: its voltage falls with charge and current, and the highest rotor speed with the voltage."""

import jax.numpy as jnp

import jaxdrones as jd

CAPACITY = 0.25 * 3600  # A s
RESISTANCE = 0.08  # ohm
EFFICIENCY = 0.5  # of motors and rotors
FULL, EMPTY = 4.2, 3.2  # V, open circuit, in proportion to the charge in between
_RADIANS_PER_SECOND = 2 * jnp.pi / 60


def battery() -> jd.Model:
    """`state.aux["battery"]`: the charge of one drone, A s."""
    return jd.Model("battery", init=lambda params: jnp.full_like(params.mass, CAPACITY), rate=_rate)


def open_circuit_voltage(charge):
    """Voltage without a current, V."""
    return EMPTY + (FULL - EMPTY) * jnp.clip(charge / CAPACITY, 0, 1)


def current(params, state):
    """Current that the rotors draw, A: I (V_oc - R I) = P / efficiency, with P = sum of k_T rpm^2 omega."""
    power = jnp.sum(params.km * state.rpm**2 * _RADIANS_PER_SECOND * state.rpm) / EFFICIENCY
    voltage = open_circuit_voltage(state.aux["battery"])
    root = jnp.maximum(voltage**2 - 4 * RESISTANCE * power, 1e-6)  # the cell gives V_oc^2 / 4 R at most
    return (voltage - jnp.sqrt(root)) / (2 * RESISTANCE)


def rotors(params, state, command):
    """Lagging rotors whose highest speed is in proportion to the voltage at the terminals."""
    voltage = open_circuit_voltage(state.aux["battery"]) - RESISTANCE * current(params, state)
    return jd.lagging_rotors(params.replace(max_rpm=params.max_rpm * voltage / FULL), state, command)


def _rate(params, state, command):
    return jnp.where(state.aux["battery"] > 0, -current(params, state), 0)

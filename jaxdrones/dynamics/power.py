"""Lithium-polymer battery: charge, and voltage under the load of the rotors.

The circuit is an open-circuit voltage, a resistance, and one pair of resistance and capacitance in series (Thevenin).
"""

from typing import Annotated

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxdrones.arguments import checked, number
from jaxdrones.dynamics.model import Model, constants
from jaxdrones.dynamics.rotors import induced_speed, thrust
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.state import State
from jaxdrones.vector import safe_sqrt, total

# Open-circuit voltage of one cell by its state of charge s (Chen and Rincon-Mora, IEEE Trans. Energy Conversion 2006,
# equation 2), its linear term raised by 0.097 V so that a full cell has 4.2 V:
# -1.031 exp(-35 s) + 3.685 + 0.3126 s - 0.1178 s^2 + 0.3201 s^3
_KNEE, _KNEE_RATE = 1.031, 35.0  # V, 1
_CUBIC = (3.685, 0.3126, -0.1178, 0.3201)  # V
_BISECTIONS = 30
_SMALLEST_VOLTAGE = 1e-6  # V; voltage of an empty battery, which avoids a division by zero


class Battery(PyTreeNode):
    """Constants of a battery and its load, `Params.aux["battery"]`; `lithium_polymer` makes them."""

    capacity: Array
    """() charge when full, A s."""
    cells: Array
    """() number of cells in series."""
    resistance: Array
    """() instantaneous resistance of battery, plug and wires, ohm."""
    slow_resistance: Array
    """() resistance of the slow voltage drop, with time constant `slow_time`, ohm."""
    slow_time: Array
    """() time constant of the slow voltage drop, s."""
    efficiency: Array
    """() ideal rotor power in hover over electrical power of the motors."""
    idle_power: Array
    """() power of the electronics, W."""


@checked
def lithium_polymer(
    capacity: Annotated[ArrayLike, number("A s", "{argument} of the battery", above=0)] = 900.0,
    cells: Annotated[ArrayLike, number("", "{argument} of the battery", above=0)] = 1,
    resistance: Annotated[ArrayLike, number("ohm", "{argument} of the battery", at_least=0)] = 0.28,
    slow_resistance: Annotated[ArrayLike, number("ohm", "{argument} of the battery", at_least=0)] = 0.0,
    slow_time: Annotated[ArrayLike, number("s", "{argument} of the battery", above=0)] = 10.0,
    efficiency: Annotated[ArrayLike, number("", "{argument} of the battery", above=0, at_most=1)] = 0.3,
    idle_power: Annotated[ArrayLike, number("W", "{argument} of the battery", at_least=0)] = 0.5,
) -> Battery:
    """Constants of a battery; the defaults are those of a Crazyflie 2.1 with 250 mAh.

    Resistance and efficiency are fitted to flights of NanoBench (Ullah and Baca 2026): at an efficiency of 0.3 the
    batteries of its flights have 0.21 to 0.52 ohm, and no measurable slow resistance. Give the resistance of your own
    battery. The idle power is an estimate.

    Args:
        capacity: charge when full, A s; 3.6 times the mAh on the label.
        cells: number of cells in series.
        resistance: resistance of battery, plug and wires, all cells together, ohm.
        slow_resistance: resistance of the slow voltage drop, ohm.
        slow_time: time constant of the slow voltage drop, s.
        efficiency: ideal rotor power over electrical power of a motor at the same thrust.
        idle_power: power of the electronics, W.
    """
    numbers = capacity, cells, resistance, slow_resistance, slow_time, efficiency, idle_power
    return Battery(*(jnp.asarray(x, float) for x in numbers))


def battery() -> Model:
    """Model of a battery, full at the start; its constants are `Params.aux["battery"]`.

    `state.aux["battery"]` holds `charge` () in A s and `slow_drop` (), the lagging part of the voltage drop, V. The
    charge falls by exactly the integral of `battery_current`.
    """
    return Model("battery", _full, _rate)


def battery_power(params: Params, state: State) -> Float[Array, ""]:
    """Electrical power demand of motors and electronics, W.

    By momentum theory a rotor needs the power F sqrt(F / (2 rho A)) for its thrust F = k_F P^2 in hover. `efficiency`
    is this power over the electrical power; it includes the losses of rotor, motor and driver.
    """
    cell = _constants(params)
    ideal = total(thrust(params, state) * induced_speed(params, jnp.abs(state.rpm)))
    return cell.idle_power + ideal / cell.efficiency


def battery_voltage(params: Params, state: State) -> Float[Array, ""]:
    """Terminal voltage U under the load of the turning rotors, V, from U (E - U) = R P.

    E is the voltage before the resistance R. The power is limited to the battery's maximum E^2 / (4 R), at U = E / 2.
    Constants and state of the model `battery()` are in `aux["battery"]`.
    """
    source = _source(params, state)
    return (source + safe_sqrt(source**2 - 4 * _constants(params).resistance * battery_power(params, state))) / 2


def battery_current(params: Params, state: State) -> Float[Array, ""]:
    """Battery current, A: power over voltage, at most U / R, the current at maximum power."""
    power, voltage = battery_power(params, state), battery_voltage(params, state)
    return power / jnp.maximum(voltage, _constants(params).resistance * power / voltage)


def open_circuit_voltage(battery: Battery, charge: Float[Array, ""]) -> Float[Array, ""]:
    """Voltage of a battery at rest, V, at a charge in A s (Chen and Rincon-Mora 2006).

    Just below zero charge, voltage and current fall to zero.
    """
    share = charge / battery.capacity
    a, b, c, d = _CUBIC
    return battery.cells * (a + share * (b + share * (c + share * d)) - _KNEE * jnp.exp(-_KNEE_RATE * share))


def charge_at(battery: Battery, voltage: Float[ArrayLike, ""]) -> Float[Array, ""]:
    """Charge of a battery at rest with this voltage, A s, the inverse of `open_circuit_voltage`.

    Voltages are limited to those of an empty and of a full battery. In between, the derivative is exact.
    """
    voltage = jnp.asarray(voltage, battery.capacity.dtype)

    def halve(_: int, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = (low + high) / 2
        below = open_circuit_voltage(battery, middle) < voltage
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    bounds = jnp.zeros_like(battery.capacity), battery.capacity
    low, high = jax.lax.fori_loop(0, _BISECTIONS, halve, jax.lax.stop_gradient(bounds))
    charge = (low + high) / 2
    slope = jax.grad(open_circuit_voltage, argnums=1)(battery, charge)
    newton = charge + (voltage - open_circuit_voltage(battery, charge)) / slope
    return jnp.clip(newton, 0, battery.capacity)


def _full(params: Params) -> dict[str, Array]:
    capacity = _constants(params).capacity
    return {"charge": capacity, "slow_drop": jnp.zeros_like(capacity)}


def _rate(params: Params, state: State, command: Float[Array, "4"]) -> dict[str, Array]:
    cell, current = _constants(params), battery_current(params, state)
    change = cell.slow_resistance * current - state.aux["battery"]["slow_drop"]
    return {"charge": -current, "slow_drop": change / cell.slow_time}


def _source(params: Params, state: State) -> Float[Array, ""]:
    """Voltage before the resistance, V."""
    memory = state.aux["battery"]
    voltage = open_circuit_voltage(_constants(params), memory["charge"]) - memory["slow_drop"]
    return jnp.maximum(voltage, _SMALLEST_VOLTAGE)


def _constants(params: Params) -> Battery:
    battery: Battery = constants(params, "battery", "jaxdrones.lithium_polymer()")
    return battery

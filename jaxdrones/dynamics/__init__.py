"""Wrenches and how they move a drone. The tables below are what the command line knows by name."""

from jaxdrones.dynamics.aero import (
    drag,
    drag_world_axes,
    external_force,
    ground_effect,
    ground_effect_2021,
    quadratic_drag,
)
from jaxdrones.dynamics.contact import drone_contact, ground_contact, obstacle_contact
from jaxdrones.dynamics.flapping import flapping_moment, rate_damping, trim_torque
from jaxdrones.dynamics.inflow import inflow_thrust
from jaxdrones.dynamics.integrators import euler, implicit_midpoint, midpoint, rk4, semi_implicit_euler
from jaxdrones.dynamics.interaction import downwash, downwash_2021
from jaxdrones.dynamics.model import Model
from jaxdrones.dynamics.power import (
    Battery,
    battery,
    battery_current,
    battery_power,
    battery_voltage,
    charge_at,
    lithium_polymer,
    open_circuit_voltage,
)
from jaxdrones.dynamics.propulsion import (
    FULL_PWM,
    Motors,
    crazyflie_motors,
    cubic_motors,
    failing,
    pwm_of_thrust,
    pwm_rotors,
    supply_voltage,
)
from jaxdrones.dynamics.rigid_body import newton_euler, quat_rate
from jaxdrones.dynamics.rotors import instant_rotors, lagging_rotors, rotor_wrench
from jaxdrones.dynamics.wind import clock, in_wind, logarithmic_wind

EFFECTS = {
    f.__name__: f
    for f in (
        drag,
        drag_world_axes,
        ground_effect,
        ground_effect_2021,
        inflow_thrust,
        flapping_moment,
        rate_damping,
        trim_torque,
        ground_contact,
        obstacle_contact,
        external_force,
    )
}
PAIRS = {f.__name__: f for f in (downwash, downwash_2021, drone_contact)}
ROTORS = {"instant": instant_rotors, "lagging": lagging_rotors}
INTEGRATORS = {f.__name__: f for f in (semi_implicit_euler, euler, midpoint, rk4, implicit_midpoint)}

__all__ = [
    "EFFECTS",
    "FULL_PWM",
    "INTEGRATORS",
    "PAIRS",
    "ROTORS",
    "Battery",
    "Model",
    "Motors",
    "battery",
    "battery_current",
    "battery_power",
    "battery_voltage",
    "charge_at",
    "clock",
    "crazyflie_motors",
    "cubic_motors",
    "downwash",
    "downwash_2021",
    "drag",
    "drag_world_axes",
    "drone_contact",
    "euler",
    "external_force",
    "failing",
    "flapping_moment",
    "ground_contact",
    "ground_effect",
    "ground_effect_2021",
    "implicit_midpoint",
    "in_wind",
    "inflow_thrust",
    "instant_rotors",
    "lagging_rotors",
    "lithium_polymer",
    "logarithmic_wind",
    "midpoint",
    "newton_euler",
    "obstacle_contact",
    "open_circuit_voltage",
    "pwm_of_thrust",
    "pwm_rotors",
    "quadratic_drag",
    "quat_rate",
    "rate_damping",
    "rk4",
    "rotor_wrench",
    "semi_implicit_euler",
    "supply_voltage",
    "trim_torque",
]

"""Wrenches, rotors, models and integrators of a drone, with the tables of names for the command line."""

from jaxdrones.dynamics.aero import drag, drag_world_axes, external_force, ground_effect, ground_effect_2021
from jaxdrones.dynamics.contact import drone_contact, ground_contact, obstacle_contact
from jaxdrones.dynamics.flapping import flapping_moment, rate_damping, trim_torque
from jaxdrones.dynamics.inflow import inflow_thrust
from jaxdrones.dynamics.integrators import euler, implicit_midpoint, midpoint, rk4, semi_implicit_euler
from jaxdrones.dynamics.interaction import downwash, downwash_2021
from jaxdrones.dynamics.rotors import instant_rotors, lagging_rotors

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

"""Wrenches and how they move a drone. The tables below are what the command line knows by name."""

from jaxdrones.dynamics.aero import drag, drag_world_axes, external_force, ground_effect, ground_effect_2021
from jaxdrones.dynamics.contact import drone_contact, ground_contact, obstacle_contact
from jaxdrones.dynamics.integrators import euler, implicit_midpoint, rk4, semi_implicit_euler
from jaxdrones.dynamics.interaction import downwash, downwash_2021
from jaxdrones.dynamics.model import Model
from jaxdrones.dynamics.rigid_body import newton_euler, quat_rate
from jaxdrones.dynamics.rotors import instant_rotors, lagging_rotors, rotor_wrench

EFFECTS = {
    f.__name__: f
    for f in (
        drag,
        drag_world_axes,
        ground_effect,
        ground_effect_2021,
        ground_contact,
        obstacle_contact,
        external_force,
    )
}
PAIRS = {f.__name__: f for f in (downwash, downwash_2021, drone_contact)}
ROTORS = {"instant": instant_rotors, "lagging": lagging_rotors}
INTEGRATORS = {f.__name__: f for f in (semi_implicit_euler, euler, rk4, implicit_midpoint)}

__all__ = [
    "EFFECTS",
    "INTEGRATORS",
    "PAIRS",
    "ROTORS",
    "Model",
    "downwash",
    "downwash_2021",
    "drag",
    "drag_world_axes",
    "drone_contact",
    "euler",
    "external_force",
    "ground_contact",
    "ground_effect",
    "ground_effect_2021",
    "implicit_midpoint",
    "instant_rotors",
    "lagging_rotors",
    "newton_euler",
    "obstacle_contact",
    "quat_rate",
    "rk4",
    "rotor_wrench",
    "semi_implicit_euler",
]

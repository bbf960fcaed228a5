"""Wrenches, rotors, models and integrators of a drone, with the tables of names for the command line."""

from jaxdrones.dynamics import aero
from jaxdrones.dynamics.contact import drone_contact, ground_contact, obstacle_contact
from jaxdrones.dynamics.inflow import inflow_thrust
from jaxdrones.dynamics.integrators import euler, implicit_midpoint, midpoint, rk4, semi_implicit_euler
from jaxdrones.dynamics.interaction import downwash, downwash_2021
from jaxdrones.dynamics.rotors import instant_rotors, lagging_rotors

_FORCES = aero.drag, aero.drag_world_axes, aero.ground_effect, aero.ground_effect_2021, inflow_thrust
_TORQUES = aero.flapping_moment, aero.rate_damping, aero.trim_torque
_CONTACTS = ground_contact, obstacle_contact
EFFECTS = {f.__name__: f for f in (*_FORCES, *_TORQUES, *_CONTACTS, aero.external_force)}
PAIRS = {f.__name__: f for f in (downwash, downwash_2021, drone_contact)}
ROTORS = {"instant": instant_rotors, "lagging": lagging_rotors}
INTEGRATORS = {f.__name__: f for f in (semi_implicit_euler, euler, midpoint, rk4, implicit_midpoint)}

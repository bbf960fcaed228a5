"""A vectorized, differentiable simulator of quadrotor teams."""

from jaxdrones import rotation, vector
from jaxdrones.accelerate.worlds import over_worlds
from jaxdrones.dynamics.aero import (
    drag,
    drag_world_axes,
    external_force,
    flapping_moment,
    ground_effect,
    ground_effect_2021,
    quadratic_drag,
    rate_damping,
    trim_torque,
)
from jaxdrones.dynamics.contact import drone_contact, ground_contact, obstacle_contact
from jaxdrones.dynamics.inflow import inflow_thrust
from jaxdrones.dynamics.integrators import euler, implicit_midpoint, midpoint, rk4, semi_implicit_euler
from jaxdrones.dynamics.interaction import downwash, downwash_2021
from jaxdrones.dynamics.model import Model, PointMass
from jaxdrones.dynamics.payload import Payload, cable, cable_tension, payload, with_payload
from jaxdrones.dynamics.power import Battery, battery, battery_current, battery_voltage, charge_at, lithium_polymer
from jaxdrones.dynamics.propulsion import (
    Motors,
    crazyflie_motors,
    cubic_motors,
    failing,
    pwm_of_thrust,
    pwm_rotors,
    supply_voltage,
)
from jaxdrones.dynamics.rotors import instant_rotors, lagging_rotors
from jaxdrones.dynamics.wind import clock, in_wind, logarithmic_wind
from jaxdrones.engine.explicit import make_derivative, make_step
from jaxdrones.engine.neighbors import NeighborGrid
from jaxdrones.engine.rollout import rollout
from jaxdrones.engine.step import Step
from jaxdrones.engine.wrenches import Effect, Pair, TeamEffect
from jaxdrones.envs import dryden, explain, make
from jaxdrones.learning.policies import make_policy
from jaxdrones.params import Params, repeat, stack
from jaxdrones.sensing import Camera, Scene, Sensor, render
from jaxdrones.state import State
from jaxdrones.urdf import load_params
from jaxdrones.visualization.viewer import show
from jaxdrones.wrench import Wrench

__all__ = ["Params", "State", "Wrench", "load_params", "repeat", "rotation", "stack", "vector"]
__all__ += ["Effect", "Model", "NeighborGrid", "Pair", "PointMass", "Step", "TeamEffect"]
__all__ += ["make_derivative", "make_step", "over_worlds", "rollout"]
__all__ += ["euler", "implicit_midpoint", "midpoint", "rk4", "semi_implicit_euler"]
__all__ += ["drag", "drag_world_axes", "external_force", "flapping_moment", "quadratic_drag"]
__all__ += ["rate_damping", "trim_torque"]
__all__ += ["downwash", "downwash_2021", "ground_effect", "ground_effect_2021", "inflow_thrust"]
__all__ += ["drone_contact", "ground_contact", "obstacle_contact"]
__all__ += ["clock", "dryden", "in_wind", "logarithmic_wind"]
__all__ += ["Payload", "cable", "cable_tension", "payload", "with_payload"]
__all__ += ["Battery", "battery", "battery_current", "battery_voltage"]
__all__ += ["charge_at", "lithium_polymer", "supply_voltage"]
__all__ += ["Motors", "crazyflie_motors", "cubic_motors", "failing"]
__all__ += ["instant_rotors", "lagging_rotors", "pwm_of_thrust", "pwm_rotors"]
__all__ += ["Camera", "Scene", "Sensor", "explain", "make", "make_policy", "render", "show"]

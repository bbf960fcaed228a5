"""A vectorized, differentiable simulator of quadrotor teams."""

from jaxdrones import rotation, vector
from jaxdrones.accelerate.worlds import over_worlds
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

__all__ = [
    "Battery",
    "Camera",
    "Effect",
    "Model",
    "Motors",
    "NeighborGrid",
    "Pair",
    "Params",
    "Payload",
    "PointMass",
    "Scene",
    "Sensor",
    "State",
    "Step",
    "TeamEffect",
    "Wrench",
    "battery",
    "battery_current",
    "battery_voltage",
    "cable",
    "cable_tension",
    "charge_at",
    "clock",
    "crazyflie_motors",
    "cubic_motors",
    "downwash",
    "downwash_2021",
    "drag",
    "drag_world_axes",
    "drone_contact",
    "dryden",
    "euler",
    "explain",
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
    "load_params",
    "logarithmic_wind",
    "make",
    "make_derivative",
    "make_policy",
    "make_step",
    "midpoint",
    "obstacle_contact",
    "over_worlds",
    "payload",
    "pwm_of_thrust",
    "pwm_rotors",
    "quadratic_drag",
    "rate_damping",
    "render",
    "repeat",
    "rk4",
    "rollout",
    "rotation",
    "semi_implicit_euler",
    "show",
    "stack",
    "supply_voltage",
    "trim_torque",
    "vector",
    "with_payload",
]

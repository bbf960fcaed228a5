"""A vectorised, differentiable simulator of quadrotor teams."""

from jaxdrones import rotation, vector
from jaxdrones.accelerate.worlds import over_worlds
from jaxdrones.dynamics import (
    Model,
    downwash,
    downwash_2021,
    drag,
    drag_world_axes,
    drone_contact,
    euler,
    external_force,
    ground_contact,
    ground_effect,
    ground_effect_2021,
    implicit_midpoint,
    instant_rotors,
    lagging_rotors,
    obstacle_contact,
    rk4,
    semi_implicit_euler,
)
from jaxdrones.engine.explicit import make_derivative, make_step
from jaxdrones.engine.neighbors import NeighborGrid
from jaxdrones.engine.rollout import rollout
from jaxdrones.engine.step import Step
from jaxdrones.engine.wrenches import Effect, Pair, TeamEffect
from jaxdrones.envs import explain, make
from jaxdrones.params import Params, repeat, stack
from jaxdrones.sensing import Camera, Scene, Sensor, render
from jaxdrones.state import State
from jaxdrones.urdf import load_params
from jaxdrones.visualization.viewer import show
from jaxdrones.wrench import Wrench

__all__ = [
    "Camera",
    "Effect",
    "Model",
    "NeighborGrid",
    "Pair",
    "Params",
    "Scene",
    "Sensor",
    "State",
    "Step",
    "TeamEffect",
    "Wrench",
    "downwash",
    "downwash_2021",
    "drag",
    "drag_world_axes",
    "drone_contact",
    "euler",
    "explain",
    "external_force",
    "ground_contact",
    "ground_effect",
    "ground_effect_2021",
    "implicit_midpoint",
    "instant_rotors",
    "lagging_rotors",
    "load_params",
    "make",
    "make_derivative",
    "make_step",
    "obstacle_contact",
    "over_worlds",
    "render",
    "repeat",
    "rk4",
    "rollout",
    "rotation",
    "semi_implicit_euler",
    "show",
    "stack",
    "vector",
]

"""A vectorised, differentiable simulator of quadrotor teams."""

from typing import TYPE_CHECKING, Any

from jaxdrones import rotation
from jaxdrones.backends.cells import Cells
from jaxdrones.backends.explicit import Step, make_step
from jaxdrones.backends.rollout import rollout
from jaxdrones.backends.worlds import over_worlds
from jaxdrones.backends.wrenches import Effect, Pair
from jaxdrones.compiler import kernel_options
from jaxdrones.dynamics import (
    downwash,
    downwash_paper,
    drag,
    drag_world_axes,
    drone_contact,
    euler,
    external_push,
    ground_contact,
    ground_effect,
    ground_effect_paper,
    implicit_midpoint,
    instant_rotors,
    lagging_rotors,
    rk4,
    semi_implicit_euler,
)
from jaxdrones.envs import make
from jaxdrones.params import Params, repeat, stack
from jaxdrones.state import State
from jaxdrones.urdf import load_params
from jaxdrones.wrench import Wrench

__all__ = [
    "KERNEL_OPTIONS",
    "Cells",
    "Effect",
    "Pair",
    "Params",
    "State",
    "Step",
    "Wrench",
    "downwash",
    "downwash_paper",
    "drag",
    "drag_world_axes",
    "drone_contact",
    "euler",
    "external_push",
    "ground_contact",
    "ground_effect",
    "ground_effect_paper",
    "implicit_midpoint",
    "instant_rotors",
    "lagging_rotors",
    "load_params",
    "make",
    "make_step",
    "over_worlds",
    "repeat",
    "rk4",
    "rollout",
    "rotation",
    "semi_implicit_euler",
    "stack",
]


if TYPE_CHECKING:
    KERNEL_OPTIONS: dict[str, Any]
else:

    def __getattr__(name: str):
        if name == "KERNEL_OPTIONS":  # the compiler of the device is asked, which importing should not start
            return kernel_options()
        raise AttributeError(f"module 'jaxdrones' has no attribute {name!r}")

"""The step of a world, whatever integrates it."""

from __future__ import annotations

import abc
from typing import Any

import jax
from jax.typing import ArrayLike

from jaxdrones.engine.physics import Physics
from jaxdrones.params import Params
from jaxdrones.sensing import Camera, Images, Scene
from jaxdrones.state import State


class Step(abc.ABC):
    """`step(params, state, rpm) -> state` of a team, and the derivative that it integrates."""

    physics: Physics
    integrator: str
    """Name of what integrates."""
    dt: float
    """Physics step, s."""
    substeps: int
    """Physics steps per call."""

    @abc.abstractmethod
    def __call__(self, params: Params, state: State, rpm: ArrayLike, scene: Scene | None = None) -> State:
        """Advance a team of n drones by one control step.

        Args:
            params: constants of the team.
            state: of the team.
            rpm: (n, 4) commanded rotor speeds, RPM.
            scene: what stands around in this episode; that of `make_step` when left out.
        """

    @abc.abstractmethod
    def rate(self, params: Params, state: State, rpm: ArrayLike, scene: Scene | None = None) -> State:
        """Time derivative of the state under commanded rotor speeds, in the type of the state.

        `vel` holds the acceleration (m/s^2, world), `omega` the angular acceleration (rad/s^2, body).
        """

    def init(self, params: Params, state: State) -> State:
        """The state with the states of this step's models, which start anew unless they are there."""
        return self.physics.init(params, state)


class HostStep(Step):
    """A step that leaves JAX.

    Compiled code reaches it through a callback; a rollout that is not itself compiled loops over it in Python.
    """

    @abc.abstractmethod
    def camera(self, params: Params, state: State, camera: Camera, scene: Scene | None = None) -> Images:
        """What the camera on every drone of a team sees."""

    @abc.abstractmethod
    def close(self) -> None:
        """Give back what the step holds; it cannot be called any more then."""


def is_traced(tree: Any) -> bool:
    """Whether some array of a pytree is being traced, so that it has no value yet."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))

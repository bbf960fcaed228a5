"""Interfaces of steps."""

import abc
from typing import Any

import jax
from jax.typing import ArrayLike

from jaxdrones.engine.physics import Physics
from jaxdrones.params import Params
from jaxdrones.sensing import Camera, Images, Scene
from jaxdrones.state import State


class Step(abc.ABC):
    """`step(params, state, rpm) -> state` of a team, and its derivative."""

    physics: Physics
    integrator: str
    """Name of the integrator."""
    dt: float
    """Physics step, s."""
    substeps: int
    """Physics steps per call."""
    period: float | None = None
    """Duration of a call, s, if known."""

    @abc.abstractmethod
    def __call__(self, params: Params, state: State, rpm: ArrayLike, scene: Scene | None = None) -> State:
        """Advance a team of n drones by one control step with commanded rotor speeds (n, 4), RPM.

        `scene` is the scene of this call, by default that of `make_step`.
        """

    @abc.abstractmethod
    def rate(self, params: Params, state: State, rpm: ArrayLike, scene: Scene | None = None) -> State:
        """Time derivative of the state under commanded rotor speeds, in the type of the state.

        `vel` holds the acceleration (m/s^2, world), `omega` the angular acceleration (rad/s^2, body).
        """

    def init(self, params: Params, state: State) -> State:
        """State with missing model states initialized."""
        return self.physics.init(params, state)


class HostStep(Step):
    """Step that runs outside of JAX.

    Compiled code calls it through a callback; an uncompiled rollout loops over it in Python.
    """

    scene: Scene
    """Scene of calls without one, of NumPy arrays."""

    @abc.abstractmethod
    def camera(self, params: Params, state: State, camera: Camera, scene: Scene | None = None) -> Images:
        """Images of the camera of every drone of a team."""

    @abc.abstractmethod
    def close(self) -> None:
        """Release the resources of the step."""


def is_traced(tree: Any) -> bool:
    """Whether any array of a pytree is traced."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))

"""Three ways to differentiate a simulated flight.

The gradients of a long flight of an unstable vehicle grow or shrink with every control step.

- `exact`: the derivative of the simulated physics.
- `decay`: the gradient is multiplied by a factor below one at every control step backward, so that distant steps
  contribute little.
- `surrogate`: the physics is simulated as it is, but differentiated as a simpler step, by default one rigid body step
  per control period. This is cheaper, and smooth where the simulated physics is not; the gradient is biased.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from jaxdrones.engine.explicit import make_step
from jaxdrones.engine.step import Step
from jaxdrones.envs import Env
from jaxdrones.learning.settings import Scalar
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.state import State


def with_gradient(env: Env, gradient: str, surrogate: Step | None = None) -> Env:
    """The environment whose physics is differentiated in the way that `gradient` names.

    Args:
        env: environment.
        gradient: exact, decay or surrogate.
        surrogate: step whose derivatives are taken with `surrogate`; a rigid body with instant rotors when left out.
    """
    if gradient != "surrogate":
        return env
    changed = copy.copy(env)
    changed.physics = SurrogateStep(env.physics, surrogate or make_step(dt=env.dt))
    return changed


def gradient_between_steps(gradient: str, factor: Scalar) -> Callable[[Any], Any]:
    """A function that is applied to the worlds between control steps; it changes their gradient, not their values."""
    if gradient == "decay":
        return lambda worlds: scale_gradient(worlds, factor)
    return lambda worlds: worlds


def scale_gradient(tree: Any, factor: Scalar) -> Any:
    """The same numbers, with their gradient multiplied by `factor`."""

    def scale(x):
        if not jnp.issubdtype(x.dtype, jnp.floating):
            return x
        return jax.lax.stop_gradient(x) + factor * (x - jax.lax.stop_gradient(x))

    return jax.tree.map(scale, tree)


class SurrogateStep(Step):
    """A step with the values of `step` and the derivatives of `surrogate` at the same state."""

    def __init__(self, step: Step, surrogate: Step):
        self.physics, self._step = step.physics, step

        @jax.custom_vjp
        def mixed(scene, *arguments):
            return step(*arguments, scene)

        def forward(scene, *arguments):
            return step(*arguments, scene), (scene, arguments)

        def backward(saved, cotangent):
            scene, arguments = saved
            return jax.tree.map(jnp.zeros_like, scene), *jax.vjp(surrogate, *arguments)[1](cotangent)

        mixed.defvjp(forward, backward)
        self._mixed = mixed

    def __call__(self, params: Params, state: State, rpm: ArrayLike, scene: Scene | None = None) -> State:
        """Advance a team by one control step."""
        return self._mixed(scene, params, state, rpm)

    def rate(self, params: Params, state: State, rpm: ArrayLike, scene: Scene | None = None) -> State:
        """The time derivative of the step that gives the values."""
        return self._step.rate(params, state, rpm, scene)

"""What a gradient goes through, and how long.

A long flight of an unstable drone has gradients that grow or shrink with every control step. Three ways:

- `exact`: the derivative of what was simulated.
- `decay`: every control step back multiplies it by a factor below one, which bounds how far back an error is blamed.
- `surrogate`: physics is simulated as it is, but differentiated as a simpler step, one rigid body step per control
  period by default: cheaper, and smooth where the simulated physics is not. The gradient is biased.
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
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.state import State

GRADIENTS = ("exact", "decay", "surrogate")


def with_gradient(env: Env, config: Any) -> Env:
    """The environment, differentiated as the settings say."""
    if config.gradient != "surrogate":
        return env
    changed = copy.copy(env)
    changed.physics = Surrogate(env.physics, config.surrogate or make_step(dt=env.dt))
    return changed


def linked(config: Any) -> Callable:
    """What happens to the gradient of worlds between two control steps."""
    if config.gradient == "decay":
        return lambda worlds: scale_gradient(worlds, config.decay)
    return lambda worlds: worlds


def scale_gradient(tree: Any, factor: float) -> Any:
    """The same numbers, with a gradient multiplied by `factor`."""

    def scale(x):
        if not jnp.issubdtype(x.dtype, jnp.floating):
            return x
        return jax.lax.stop_gradient(x) + factor * (x - jax.lax.stop_gradient(x))

    return jax.tree.map(scale, tree)


class Surrogate(Step):
    """A step with the values of one and the derivatives of another, at the same state."""

    def __init__(self, step: Step, simple: Step):
        self.physics, self._step = step.physics, step

        @jax.custom_vjp
        def mixed(scene, *arguments):
            return step(*arguments, scene)

        def forward(scene, *arguments):
            return step(*arguments, scene), (scene, arguments)

        def backward(saved, cotangent):
            scene, arguments = saved
            return jax.tree.map(jnp.zeros_like, scene), *jax.vjp(simple, *arguments)[1](cotangent)

        mixed.defvjp(forward, backward)
        self._mixed = mixed

    def __call__(self, params: Params, state: State, rpm: ArrayLike, scene: Scene | None = None) -> State:
        """Advance a team by one control step."""
        return self._mixed(scene, params, state, rpm)

    def rate(self, params: Params, state: State, rpm: ArrayLike, scene: Scene | None = None) -> State:
        """The time derivative of the step that gives the values."""
        return self._step.rate(params, state, rpm, scene)

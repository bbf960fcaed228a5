"""Four ways to differentiate a simulated flight.

The gradients of a long flight of an unstable vehicle grow or shrink with every control step.

- `exact`: the derivative of the simulated physics.
- `decay`: the gradient is multiplied by a factor below one at every control step backward, so that distant steps
  contribute little.
- `surrogate`: the physics is simulated as it is, but differentiated as a simpler step, by default one rigid body step
  per control period. This is cheaper, and smooth where the simulated physics is not; the gradient is biased.
- `point_mass`: the physics is simulated as it is, but differentiated as a point mass whose acceleration is commanded;
  attitudes have no gradient. See `point_mass`.

With each of them, the gradient may go through the images of cameras or leave them out. It is that of the visible
surface: a depth jumps at the edge of an obstacle, and the derivative does not show it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Annotated, Any, Literal, get_args

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from jaxdrones import vector
from jaxdrones.checks import check_callable, check_choice
from jaxdrones.dynamics import rotors
from jaxdrones.dynamics.rigid_body import newton_euler
from jaxdrones.engine.explicit import make_step
from jaxdrones.engine.step import Step
from jaxdrones.envs import Env
from jaxdrones.learning.settings import BelowOne, Bool, Config, Fraction, Scalar
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.state import State
from jaxdrones.wrench import Wrench

GradientName = Literal["exact", "decay", "surrogate", "point_mass"]


def _check_gradient(name: str, value: Any) -> None:
    check_choice(name, value, get_args(GradientName))


def _check_surrogate(name: str, step: Any) -> None:
    if step is not None:
        check_callable(name, step, "jaxdrones.make_step()")


@dataclasses.dataclass(frozen=True)
class GradientConfig(Config):
    """Settings of the learners that differentiate the simulation."""

    adam_b2: BelowOne = 0.95
    """Decay rate of Adam's mean of squared gradients, of the policy. It is low because gradients shrink by orders of
    magnitude while the policy learns."""
    gradient: Annotated[GradientName, _check_gradient] = "exact"
    """How the flight is differentiated: exact, decay, surrogate or point_mass; see `learning.gradients`."""
    gradient_decay: Fraction = 0.98
    """Factor on the gradient per control step with `gradient="decay"`."""
    surrogate: Annotated[Step | None, _check_surrogate] = None
    """Step whose derivatives are taken with `gradient="surrogate"`; a rigid body with instant rotors when left out."""
    image_gradient: Bool = True
    """Whether the gradient goes through the images of cameras, or takes them for constants."""


def with_gradient(env: Env, config: GradientConfig) -> Env:
    """The environment whose physics and images are differentiated as the settings say."""
    changed: dict[str, Any] = {}
    if config.gradient == "surrogate":
        changed["physics"] = SurrogateStep(env.physics, config.surrogate or make_step(dt=env.dt))
    if config.gradient == "point_mass":
        changed["physics"] = SurrogateStep(env.physics, point_mass(env.dt))
    if env.vision and not config.image_gradient:
        render = env.vision.render
        changed["vision"] = dataclasses.replace(env.vision, render=lambda *seen: render(*jax.lax.stop_gradient(seen)))
    return dataclasses.replace(env, **changed) if changed else env


def gradient_between_steps(config: GradientConfig) -> Callable[[Any], Any]:
    """A function of the worlds between control steps; it changes their gradient, not their values."""
    if config.gradient == "decay":
        return lambda worlds: scale_gradient(worlds, config.gradient_decay)
    return lambda worlds: worlds


def scale_gradient(tree: Any, factor: Scalar) -> Any:
    """The same numbers, with their gradient multiplied by `factor`."""

    def scale(x):
        if not jnp.issubdtype(x.dtype, jnp.floating):
            return x
        return jax.lax.stop_gradient(x) + factor * (x - jax.lax.stop_gradient(x))

    return jax.tree.map(scale, tree)


def point_mass(dt: float, response: float = 0.1) -> Callable[[Params, State, Array], State]:
    """A step of a team as points, for `SurrogateStep`: only its derivatives have a meaning.

    The rotors command an acceleration: their thrust along the axis to which their torque turns the body. A torque that
    changes the body rates by dw in a control period turns the thrust by dw times `response` at once. Position and
    velocity are differentiated with respect to that acceleration and to each other, attitude and rotors not at all.

    Args:
        dt: control period, s.
        response: time in which a change of the body rates turns the body before it is corrected, s.
    """

    def step(params: Params, state: State, rpm: Array) -> State:
        fixed = jax.lax.stop_gradient(state)
        turning = fixed.replace(rpm=rotors.limited(params, rpm))
        wrench = rotors.rotor_wrench(params, turning)
        _, angular_acc = newton_euler(params, turning, wrench)
        turn = angular_acc * dt * response
        force = wrench.force + vector.cross(turn - jax.lax.stop_gradient(turn), wrench.force)
        acc, _ = newton_euler(params, fixed, Wrench(force, wrench.torque))
        vel = state.vel + acc * dt
        return fixed.replace(pos=state.pos + vel * dt, vel=vel)

    return jax.vmap(step)


class SurrogateStep(Step):
    """A step with the values of `step` and the derivatives of `surrogate` at the same state."""

    def __init__(self, step: Step, surrogate: Callable[[Params, State, Array], State]):
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

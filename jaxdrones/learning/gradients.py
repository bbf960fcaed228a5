"""Gradients of a simulated flight: exact, decayed, or of a surrogate.

The gradients of a long flight of an unstable vehicle grow or shrink with every control step.

- `exact`: the derivative of the simulated physics.
- `decay`: the gradient is multiplied by a factor below one at every control step backward, so distant steps contribute
  little.
- `surrogate`: the full physics is simulated, but differentiated as a simpler step, by default one rigid body step per
  control period. This is cheaper and smooth, with a biased gradient.
- `point_mass`: the full physics is simulated, but differentiated as a point mass with commanded acceleration;
  attitudes have no gradient. See `point_mass`.

Each can include or exclude the gradient of camera images. That gradient is of the visible surface, without the jumps of
depth at the edges of obstacles.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Annotated, Any, Literal, get_args

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from jaxdrones import vector
from jaxdrones.arguments import BelowOne, Fraction, PositiveOrInfinite, Scalar, Switch, choice, function
from jaxdrones.checks import is_concrete
from jaxdrones.dynamics import rotors
from jaxdrones.dynamics.rigid_body import newton_euler
from jaxdrones.engine.explicit import make_step
from jaxdrones.engine.step import Step
from jaxdrones.envs import Env
from jaxdrones.errors import UserError
from jaxdrones.learning.layers import expand
from jaxdrones.learning.settings import Config
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.state import State
from jaxdrones.wrench import Wrench

_UNLIMITED = 1e9  # times the median; JSON has no infinity
GradientName = Literal["exact", "decay", "surrogate", "point_mass"]


@dataclasses.dataclass(frozen=True)
class GradientConfig(Config):
    """Settings of learners with gradients of the simulation."""

    adam_b2: BelowOne = 0.95
    """Decay rate of Adam's mean of squared gradients, of the policy. It is low because gradients shrink by orders of
    magnitude during training."""
    gradient: Annotated[GradientName, choice("gradient", get_args(GradientName))] = "exact"
    """Kind of gradient: exact, decay, surrogate or point_mass; see `learning.gradients`."""
    gradient_decay: Fraction = 0.98
    """Factor on the gradient per control step with `gradient="decay"`."""
    outlier_gradient: PositiveOrInfinite = _UNLIMITED
    """Largest gradient of a world at a control step, relative to the median of the worlds of its device with a
    gradient. Longer ones are scaled down, so that a few chaotic worlds do not dominate."""
    surrogate: Annotated[Step | None, function("jaxdrones.make_step()")] = None
    """Surrogate step of `gradient="surrogate"`, of one control period; by default a rigid body with instant rotors."""
    image_gradient: Switch = True
    """Whether to differentiate camera images, or treat them as constants."""


def with_gradient(env: Env, config: GradientConfig) -> Env:
    """Environment with the gradient of the settings."""
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
    """Function of the worlds between control steps; it changes gradients, not values."""
    limited = not (is_concrete(config.outlier_gradient) and config.outlier_gradient >= _UNLIMITED)

    def changed(worlds: Any) -> Any:
        if limited:
            worlds = limit_gradient(worlds, config.outlier_gradient)
        return scale_gradient(worlds, config.gradient_decay) if config.gradient == "decay" else worlds

    return changed


def scale_gradient(tree: Any, factor: Scalar) -> Any:
    """Identity with the gradient multiplied by `factor`."""
    return jax.tree.map(lambda x: _scaled(x, factor) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)


@jax.custom_jvp
def _scaled(x: Array, factor: Scalar) -> Array:
    return x


@_scaled.defjvp
def _(arguments: tuple[Array, Scalar], changes: tuple[Array, Scalar]) -> tuple[Array, Array]:
    (x, factor), (change, _) = arguments, changes
    return x, jnp.asarray(factor, change.dtype) * change


@jax.custom_vjp
def limit_gradient(worlds: Any, limit: Scalar) -> Any:
    """Identity, in which the gradient of no world is longer than `limit` times the median of all worlds of the device.

    Worlds whose gradient is zero, as after an episode, or not finite do not count.
    """
    return worlds


def _limited(limit: Scalar, cotangent: Any) -> tuple[Any, None]:
    leaves = [x for x in jax.tree.leaves(cotangent) if x.dtype != jax.dtypes.float0]
    length = jnp.sqrt(sum(jnp.sum(x**2, axis=tuple(range(1, x.ndim))) for x in leaves))
    counts = jnp.isfinite(length) & (length > 0)
    ordered, count = jnp.sort(jnp.where(counts, length, jnp.inf)), jnp.sum(counts)
    rank = jnp.arange(len(ordered))
    middle = 1 * (rank == (count - 1) // 2) + (rank == count // 2)
    longest = limit * jnp.sum(jnp.where(middle > 0, middle * ordered, 0)) / 2
    scale = jnp.where(length > longest, longest / jnp.where(length > 0, length, 1), 1)
    scale = jnp.where(jnp.isfinite(length), scale, 0)

    def scaled(x):
        return x if x.dtype == jax.dtypes.float0 else jnp.where(expand(scale, x.ndim) > 0, expand(scale, x.ndim) * x, 0)

    return jax.tree.map(scaled, cotangent), None


limit_gradient.defvjp(lambda worlds, limit: (worlds, limit), _limited)


def point_mass(dt: float, response: float = 0.1) -> Callable[[Params, State, Array], State]:
    """Step of a team of point masses, for the derivatives of `SurrogateStep`.

    The rotors command an acceleration: thrust along a body axis that their torque rotates. A torque that changes the
    body rates by dw in a control period dt (s) rotates the thrust by dw times `response` at once, the time (s) for
    which such a change acts before it is corrected. Position and velocity are differentiated with respect to that
    acceleration and to each other; attitude and rotors are not.
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
    """Step with the values of `step` and the derivatives of `surrogate` at the same state.

    Parameters and scene are constants to it: their derivatives are zero.
    """

    def __init__(self, step: Step, surrogate: Callable[[Params, State, Array], State]):
        period = surrogate.period if isinstance(surrogate, Step) else None
        if period and step.period and not math.isclose(period, step.period, rel_tol=1e-6):
            raise UserError(
                f"a call of the surrogate takes {period:.4g} s, and one of the physics {step.period:.4g} s; give for "
                f"example surrogate=jaxdrones.make_step(dt={step.period:.4g})"
            )
        self.physics, self.period, self._step = step.physics, step.period, step

        @jax.custom_vjp
        def mixed(scene, params, state, rpm):
            return step(params, state, rpm, scene)

        def forward(scene, params, state, rpm):
            return step(params, state, rpm, scene), (scene, params, state, rpm)

        def backward(saved, cotangent):
            scene, params, *arguments = saved
            constants = jax.tree.map(jnp.zeros_like, (scene, params))
            return *constants, *jax.vjp(functools.partial(surrogate, params), *arguments)[1](cotangent)

        mixed.defvjp(forward, backward)
        self._mixed = mixed

    def __call__(self, params: Params, state: State, rpm: ArrayLike, scene: Scene | None = None) -> State:
        """Advance a team by one control step."""
        return self._mixed(scene, params, state, rpm)

    def rate(self, params: Params, state: State, rpm: ArrayLike, scene: Scene | None = None) -> State:
        """Time derivative of `step`."""
        return self._step.rate(params, state, rpm, scene)

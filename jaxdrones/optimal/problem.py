"""Cost functions and reference motions of optimal controllers."""

import math
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxdrones import rotation
from jaxdrones.arguments import whole
from jaxdrones.checks import check_shape, is_concrete, short_repr
from jaxdrones.control import Setpoint, attitude
from jaxdrones.control.allocation import rpm_from_wrench
from jaxdrones.dynamics.model import PointMass
from jaxdrones.errors import UserError
from jaxdrones.optimal.coordinates import command_unit, of_point_masses
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.state import State
from jaxdrones.status import is_finite
from jaxdrones.vector import along_z, cross, dot, safe_sqrt, sin_cos, unit

Horizon = Annotated[int, whole(minimum=2)]
"""Control steps of a plan; two have an angular acceleration of the reference."""

_SMALL = 1e-3  # thrust over weight, or angle between thrust and heading, rad, below which an attitude is undefined
_LIFT = 1e-6  # least vertical force over a thrust along the heading, to compute the limit


class Weights(PyTreeNode):
    """Weights of squared errors."""

    pos: Array
    """(3,) 1/m^2, along the heading of the target."""
    attitude: Array
    """(3,) 1/rad^2, body."""
    vel: Array
    """(3,) 1/(m/s)^2, along the heading of the target."""
    omega: Array
    """(3,) 1/(rad/s)^2, body."""
    command: Array
    """(4,) of the command's difference from the reference, over the hover speed."""

    def state_matrix(self, size: int) -> Float[Array, "d d"]:
        """Matrix Q of the state cost z Q z / 2; rotor speeds and models have zero weight."""
        weighted = jnp.concatenate([self.pos, self.attitude, self.vel, self.omega])
        return jnp.diag(jnp.pad(weighted, (0, size - len(weighted))))

    def command_matrix(self) -> Float[Array, "4 4"]:
        """Matrix R of the command cost u R u / 2."""
        return jnp.diag(self.command)


def weights() -> Weights:
    """Weights for tracking: 3 cm, 20 degrees of tilt, 0.5 m/s, 10 rad/s and 30 % of the hover speed cost the same."""
    return Weights(
        pos=jnp.full(3, 1000.0),
        attitude=jnp.full(3, 8.0),
        vel=jnp.full(3, 4.0),
        omega=jnp.full(3, 0.01),
        command=jnp.full(4, 10.0),
    )


def checked_weights(given: Weights | None) -> Weights:
    """Weights, by default those of `weights`.

    Raises:
        ValueError: a wrong shape, a negative number, or a command that costs nothing, so that no command is the best.
    """
    if given is None:
        return weights()
    for name, size in (("pos", 3), ("attitude", 3), ("vel", 3), ("omega", 3), ("command", 4)):
        x = getattr(given, name)
        check_shape(f"weights.{name}", x, (size,), "a weight for each axis" if size == 3 else "a weight for each rotor")
        least = jnp.finfo(float).tiny if name == "command" else 0
        if is_concrete(x) and not np.all(np.isfinite(x) & (np.asarray(x) >= least)):
            wanted = "positive, finite numbers" if least else "finite numbers of at least 0"
            raise UserError(f"weights.{name} is {short_repr(x)}; give {wanted}")
    return given


def checked_step(step: Any) -> Any:
    """Step of a planner, which commands rotor speeds.

    Raises:
        ValueError: a step whose commands are PWM.
    """
    if (physics := getattr(step, "physics", None)) is not None:
        refuse_pwm("step", physics.takes_pwm)
    return step


def refuse_pwm(name: str, takes_pwm: bool) -> None:
    """Raise if the commands of a model are PWM."""
    if takes_pwm:
        raise UserError(
            f"{name} takes the PWM of pwm_rotors, and planners command rotor speeds, RPM; give a model with "
            "rotors=jaxdrones.lagging_rotors, and convert its commands with jaxdrones.pwm_of_thrust"
        )


class Reference(PyTreeNode):
    """Reference motion at H + 1 control steps."""

    state: State
    """States of one drone, arrays (H + 1, ...)."""
    rpm: Array
    """(H + 1, 4) rotor speeds of the motion without drag and other effects, RPM."""


def reference(params: Params, setpoints: Setpoint, aux: dict, dt: float) -> Reference:
    """Reference motion through setpoints by differential flatness (Mellinger, Kumar 2011).

    Thrust and attitude are those of the acceleration and heading; angular velocities and torques are differences of
    attitudes over `dt` (s). The angular velocity of the H + 1 >= 3 setpoints is not used. `aux` are states of models of
    a drone at the origin; point masses, such as loads, follow the setpoints.
    """
    quat, thrust = jax.vmap(lambda acc, yaw: _upright(params, acc, yaw))(setpoints.acc, setpoints.yaw)
    turns = jax.vmap(rotation.multiply)(jax.vmap(rotation.conjugate)(quat[:-1]), quat[1:])
    omega = _with_last(jax.vmap(rotation.log)(turns) / dt)
    omega_rate = _with_last(jnp.diff(omega[:-1], axis=0) / dt, 2)
    rpm = jax.vmap(lambda f, w, a: rpm_from_wrench(params, f, params.inertia * a + cross(w, params.inertia * w)))(
        thrust, omega, omega_rate
    )
    length = len(thrust)
    shared = jax.tree.map(lambda x: jnp.broadcast_to(x, (length, *jnp.shape(x))), aux)
    along = of_point_masses(lambda x: PointMass(x.pos + setpoints.pos, setpoints.vel), shared)
    return Reference(State(setpoints.pos, quat, setpoints.vel, omega, rpm, along), rpm)


def _upright(params: Params, acc: Float[Array, "3"], yaw: Float[Array, ""]) -> tuple[Array, Array]:
    """Attitude and thrust (N) of an acceleration.

    The attitude of a free fall is level. That of a thrust along the heading is the limit from upright ones.
    """
    force = params.mass * (acc + along_z(params.gravity))
    sin, cos = sin_cos(yaw)
    aside = cross(unit(force), jnp.stack([cos, sin, jnp.zeros_like(yaw)]))
    least = _SMALL * params.mass * params.gravity
    undefined = (dot(force, force) < least**2) | (dot(aside, aside) < _SMALL**2)
    thrust = safe_sqrt(dot(force, force))
    lift = jnp.maximum(least, _LIFT * thrust)
    axes = attitude.from_thrust(force + along_z(jnp.where(undefined, lift, 0)), yaw)
    return rotation.from_matrix(jnp.stack(axes, axis=-1)), thrust


def _with_last(x: Float[Array, "k 3"], times: int = 1) -> Float[Array, "_ 3"]:
    return jnp.concatenate([x, *[x[-1:]] * times])


def hover(params: Params, state: State) -> State:
    """Level hover of one drone at the origin, heading along x, with the models of `state` around it."""
    zero = jnp.zeros_like(state.pos)
    quat = jnp.zeros_like(state.quat).at[3].set(1)
    rpm = jnp.broadcast_to(command_unit(params), state.rpm.shape)
    aux = of_point_masses(lambda x: PointMass(x.pos - state.pos, zero), state.aux)
    return state.replace(pos=zero, quat=quat, vel=zero, omega=zero, rpm=rpm, aux=aux)


def posed(
    settings: Any, params: Params, memory: Any, state: State, setpoints: Setpoint, dt: float, on_failure: str
) -> tuple[Bool[Array, ""], State, Reference]:
    """Problem of a call of a planner: its validity, the state and the reference.

    An invalid problem is replaced by hover at the origin, to keep NaN out of plans and gradients.

    Raises:
        ValueError: a wrong time between calls, number of setpoints, or `on_failure` for these arguments.
    """
    check_plan(settings.horizon, setpoints, settings.step, dt, on_failure, (params, memory, state))
    squares = jax.vmap(lambda acc: jnp.sum((params.mass * (acc + along_z(params.gravity))) ** 2))(setpoints.acc)
    valid = is_finite((state, setpoints, squares))  # an attitude needs the square of its force
    rest = hover(params, state)
    rest = rest.replace(aux=jax.tree.map(jnp.zeros_like, rest.aux))
    zero = jax.tree.map(jnp.zeros_like, setpoints)
    given, safe = (state, setpoints), (rest, zero)
    state, setpoints = jax.tree.map(lambda x, y: jnp.where(valid, x, y), given, safe)
    return valid, state, reference(params, setpoints, hover(params, state).aux, dt)


def check_plan(
    horizon: int, setpoints: Setpoint, step: Any = None, dt: float = 0.0, on_failure: str = "hold", given: Any = ()
) -> None:
    """Raise on a wrong number of setpoints, a `dt` other than the period of `step`, or `raise` while traced."""
    period = getattr(step, "period", None)
    if period is not None and not math.isclose(period, dt, rel_tol=1e-6):
        raise UserError(f"dt is {dt} s and the step takes {period:g} s; give a step of one control period")
    check_shape("setpoints.pos", setpoints.pos, (horizon + 1, 3), "this and the next H control steps")
    if on_failure == "raise" and not all(map(is_concrete, jax.tree.leaves((setpoints, given)))):
        raise UserError(
            "on_failure is 'raise' inside jax.jit or jax.vmap, where errors cannot depend on values; leave it out, and "
            "check the status of the memory"
        )

"""State differences of one drone as unconstrained vectors, for linear and quadratic models.

A unit quaternion has four components and three degrees of freedom. A linearization in its components would have an
uncontrollable direction, and its Riccati equation no solution. Attitude differences are therefore vectors (3,) of the
tangent space.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.checks import check_shape, is_concrete, short_repr
from jaxdrones.dynamics.model import PointMass
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.state import State

SingleStep = Callable[[Params, State, Float[Array, "4"]], State]
"""`(params, state, rpm) -> state` of one drone."""

SIZE = 16
"""Length of a difference of states without models."""


def single(step: Callable) -> SingleStep:
    """Convert a step or a derivative of a team to one of a single drone."""

    def step_of_one(params: Params, state: State, rpm: Float[Array, "4"]) -> State:
        team = jax.tree.map(lambda x: jnp.asarray(x)[None], (params, state))
        return jax.tree.map(lambda x: x[0], step(*team, rpm[None]))

    return step_of_one


def command_unit(params: Params) -> Float[Array, ""]:
    """Unit of commands and rotor speeds here: the hover speed, RPM."""
    check_shape("params.mass", params.mass, (), "optimal control is for one drone; use jax.vmap for a team")
    if is_concrete(params.gravity) and not np.asarray(params.gravity) > 0:
        raise UserError(
            f"params.gravity is {short_repr(params.gravity)}; optimal control scales commands by the hover speed, "
            "give a positive gravity"
        )
    return params.hover_rpm


def difference(params: Params, state: State, reference: State) -> Float[Array, " d"]:
    """Difference between two states of one drone as a vector.

    Returns:
        (d,) in this order: position, m, world; `small_turn` from the reference to the state, rad, body; velocity, m/s,
        world; angular velocity, rad/s, body; rotor speeds over that of hover; states of models in their own units. d is
        16 without models.
    """
    return ravel_pytree(_parts(params, state, reference))[0]


def _parts(params: Params, state: State, reference: State) -> tuple[Any, ...]:
    return (
        state.pos - reference.pos,
        small_turn(reference.quat, state.quat),
        state.vel - reference.vel,
        state.omega - reference.omega,
        (state.rpm - reference.rpm) / command_unit(params),
        jax.tree.map(jnp.subtract, state.aux, reference.aux),
    )


def small_turn(quat: Float[Array, "4"], after: Float[Array, "4"]) -> Float[Array, "3"]:
    """Twice the vector part of the rotation between two attitudes; in the limit of small angles rad, body."""
    error = rotation.multiply(rotation.conjugate(quat), after)
    return jnp.where(error[3] < 0, -2, 2) * error[:3]


def displaced(params: Params, state: State, vector: Float[Array, " d"]) -> State:
    """Displace the state of one drone by a vector; to first order the inverse of `difference`."""
    parts = (state.pos, state.pos, state.vel, state.omega, state.rpm, state.aux)
    pos, turn, vel, omega, rpm, aux = ravel_pytree(parts)[1](vector)
    return state.replace(
        pos=state.pos + pos,
        quat=rotation.multiply(state.quat, rotation.exp(turn)),
        vel=state.vel + vel,
        omega=state.omega + omega,
        rpm=state.rpm + command_unit(params) * rpm,
        aux=jax.tree.map(jnp.add, state.aux, aux),
    )


def tracking_error(params: Params, state: State, reference: State) -> Float[Array, " d"]:
    """`difference` with positions and velocities along the heading of the reference instead of the world's axes.

    Weights and gains are then independent of the heading.
    """
    parts = _parts(params, state, reference)
    return _along(_heading(reference.quat), parts, parts[1])


def feedback_error(params: Params, state: State, reference: State) -> Float[Array, " d"]:
    """`tracking_error` for large errors of the heading, the same to first order.

    A drone accelerates along its own heading. Up to a tilt of 90 degrees from the reference, positions and velocities
    are therefore along the heading of the drone, and the attitude is a turn about the z axis of the reference (third
    component) and then a tilt about the x and y axes of the body, each as twice the vector part of its quaternion.
    Beyond, where a heading means little, it is the `tracking_error`.
    """
    parts = _parts(params, state, reference)
    error = rotation.multiply(rotation.conjugate(reference.quat), state.quat)
    error = jnp.where(error[3] < 0, -error, error)
    square = error[2] ** 2 + error[3] ** 2  # squared cosine of half the tilt
    upright = square > 0.5
    length = jnp.sqrt(jnp.where(upright, square, 1))
    sin, cos = jnp.where(upright, error[2] / length, 0), jnp.where(upright, error[3] / length, 1)  # of half the turn
    zero = jnp.zeros_like(sin)
    x, y, _, _ = rotation.multiply(jnp.stack([zero, zero, -sin, cos]), error)
    turn = jnp.where(upright, 2 * jnp.stack([x, y, sin]), parts[1])
    c, s = _heading(reference.quat)
    cos_turn, sin_turn = cos * cos - sin * sin, 2 * sin * cos
    return _along((c * cos_turn - s * sin_turn, s * cos_turn + c * sin_turn), parts, turn)


def _heading(quat: Float[Array, "4"]) -> tuple[Array, Array]:
    """Cosine and sine of the heading of an attitude."""
    x_axis = rotation.axes(quat)[0]
    x, y = x_axis[0], x_axis[1]
    length = jnp.sqrt(jnp.maximum(x * x + y * y, jnp.finfo(x.dtype).tiny))
    return x / length, y / length


def _along(heading: tuple[Array, Array], parts: tuple[Any, ...], turn: Float[Array, "3"]) -> Float[Array, " d"]:
    """Parts of a difference as a vector, with positions and velocities along a heading, and another turn."""
    cos, sin = heading
    pos, _, vel, omega, rpm, aux = parts

    def along(v: Array) -> Array:
        return jnp.stack([cos * v[0] + sin * v[1], cos * v[1] - sin * v[0], v[2]])

    aux = of_point_masses(lambda x: PointMass(along(x.pos), along(x.vel)), aux)
    return ravel_pytree((along(pos), turn, along(vel), omega, rpm, aux))[0]


def of_point_masses(function: Callable[[PointMass], PointMass], aux: dict[str, Any]) -> dict[str, Any]:
    """States of models with a function of those that are point masses, such as loads."""

    def of(x: Any) -> Any:
        return function(x) if isinstance(x, PointMass) else x

    return jax.tree.map(of, aux, is_leaf=lambda x: isinstance(x, PointMass))


def linearize_step(
    step: SingleStep, params: Params, state: State, rpm: Float[Array, "4"]
) -> tuple[Float[Array, "d d"], Float[Array, "d 4"]]:
    """Matrices A and B of z' = A z + B u about a state and a command (4,) (RPM) of one drone.

    The step is that of one drone, such as `single(make_step(...))`.

    Returns:
        (d, d) and (d, 4): z is the `difference` from the state before the step, z' that from the state after it, and u
        the change of the command over the rotor speed of hover.
    """
    unit = command_unit(params)
    after = step(params, state, rpm)

    def moved(z: Array, u: Array) -> Array:
        return difference(params, step(params, displaced(params, state, z), rpm + unit * u), after)

    zero = jnp.zeros_like(difference(params, state, state))
    return jax.jacfwd(moved, (0, 1))(zero, jnp.zeros_like(rpm))


def linearize(
    derivative: SingleStep, params: Params, state: State, rpm: Float[Array, "4"]
) -> tuple[Float[Array, "d d"], Float[Array, "d 4"]]:
    """Matrices A and B of the continuous model z' = A z + B u about the motion through a state of one drone.

    The derivative is that of one drone, such as `single(make_derivative(...))`, under a command (4,) (RPM).

    Returns:
        (d, d) 1/s and (d, 4) 1/s: z is the `difference` from the motion, u the change of the command over the rotor
        speed of hover.
    """
    unit = command_unit(params)
    rate = derivative(params, state, rpm)

    def moving(z: Array, u: Array) -> Array:
        other = displaced(params, state, z)
        rates = (derivative(params, other, rpm + unit * u), rate)
        return jax.jvp(lambda a, b: difference(params, a, b), (other, state), rates)[1]

    zero = jnp.zeros_like(difference(params, state, state))
    return jax.jacfwd(moving, (0, 1))(zero, jnp.zeros_like(rpm))

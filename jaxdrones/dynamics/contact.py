"""Compliant contact: of a drone with the ground, and of two drones with each other.

For the explicit backend only. Bullet resolves contacts itself; with these effects it would do so twice.

A drone touches with what it touches with in Bullet: a ring of balls as high as its collision cylinder, on a disc. What
is a depth x inside and moves further in at x' is pushed out, per mass, by

    s (a + b x') + c x,  s = x^2 / (d^2 + x^2),  and never pulled in.

This is the law of Hunt and Crossley (1975) where it sets in: the damping grows from zero with the depth, so that no
force jumps and what leaves leaves slowly. Further in, the damping levels off, because an explicit step cannot
do with more. Friction is Coulomb's, and viscous at low speed. All forces are in proportion to a mass, so that one set
of numbers serves every vehicle.

The numbers are for `semi_implicit_euler` with steps of up to 1/240 s: what is damped at a rate above 1/dt overshoots,
at one above 2/dt it gains energy. The price is depth: what lands at 1 m/s sinks in 8 mm, at 5 m/s 3 cm.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.vector import components, cross, dot
from jaxdrones.wrench import Wrench

_BALLS = 8  # as in Bullet
_ANGLES = 2 * np.pi / _BALLS * np.arange(_BALLS)

_ONSET = 2.5e-3  # m, d: half of the damping is there; a drone at rest is 1.5 mm deep; 1 mm makes gradients noisier
_PUSH = 20.0  # m/s^2, a: about twice gravity, so that a drone rests near the surface
_DAMPING = 120.0  # 1/s, a b: half of 1/dt for a drone that heaves; the tilting of a level hb is 3.3 times as fast
_STIFFNESS = 3000.0  # 1/s^2, c: (55 rad/s)^2; with the damping just above critical, so that little bounces
_GRIP = 400.0  # 1/s: the fastest rate at which friction slows a point of the rim, for all ways it can move together
_GRIP_ON_DRONE = 15.0  # 1/s: the same at one of 16 points between drones, so that one below another does not shake
_SHARE_ON_DRONE = 4.0  # share of the push for one point over that of its lever: three that share it stay below 2/dt
_SLOW = 0.01  # m/s: friction is viscous below, however light the touch; a drone's weight makes it 0.05 (cf2x)
_ON_GROUND = 0.5  # friction coefficient: the reference's drone 0.5 times its plane 1.0
_ON_DRONE = 0.25  # friction coefficient: 0.5 times 0.5
_NEAR = 1e-4  # m: rounds off the distance of two points that meet


def ground_contact(params: Params, state: State) -> Wrench:
    """What the ground, the plane z = 0, does to a drone that touches it: it pushes and rubs, and never pulls.

    Not for the Bullet backend, whose ground does it already.
    """
    ball, ring = _shape(params)
    x_axis, y_axis, z_axis = rotation.axes(state.quat)
    omega = rotation.rotate(state.quat, state.omega)
    # Everything below is world frame. The lowest point of the ball at angle t is p + x cos t + y sin t from the centre
    # of mass, and so are its velocity and, summed over the balls, the moments of the forces.
    p = params.collision_offset * z_axis - ball * jnp.array([0, 0, 1], ball.dtype)
    x, y = ring * x_axis, ring * y_axis
    cos, sin = (jnp.asarray(f(_ANGLES), ball.dtype) for f in (np.cos, np.sin))

    def around(a: Array, b: Array, c: Array) -> list[Float[Array, " balls"]]:
        return [i + j * cos + k * sin for i, j, k in zip(components(a), components(b), components(c), strict=True)]

    _, _, height = around(state.pos + p, x, y)
    vel = around(state.vel + cross(omega, p), cross(omega, x), cross(omega, y))
    normal = params.mass / _BALLS * _push(-height, -vel[2])
    rub = _rub(_ON_GROUND * normal, vel[0] ** 2 + vel[1] ** 2, _GRIP * _sliding_mass(params) / _BALLS)
    forces = [-rub * vel[0], -rub * vel[1], normal]

    force = jnp.stack([sum(components(f)) for f in forces])
    torque = cross(p, force)
    torque += cross(x, jnp.stack([dot(cos, f) for f in forces])) + cross(y, jnp.stack([dot(sin, f) for f in forces]))
    return Wrench(rotation.rotate_inverse(state.quat, force), rotation.rotate_inverse(state.quat, torque))


def drone_contact(params: Params, state: State, other: Params, other_state: State) -> Wrench:
    """What a drone does to another that it touches, here to the first; the second gets the opposite.

    The balls of each meet the disc of the other, rounded by its balls: 16 points, which share one push, so that two
    edges that meet and two discs that lie on each other give way alike. Not for the Bullet backend, which does it
    already.

    Softer than the ground, and than Bullet. Two cf2x that meet rim to rim stop each other at 1 m/s; at 3 m/s most slip
    past each other, one over the other (26 of 30, in Bullet 1 of 30). Flat onto each other they stop up to 3 m/s and
    pass through at 5 m/s. A drone that lies on another, off its middle, slides down; in Bullet it stays.
    """
    # World frame, positions from the first's centre of mass, so that they are as exact far from the origin.
    own, its = _body(params, state, jnp.zeros_like(state.pos)), _body(other, other_state, other_state.pos - state.pos)
    mine, theirs = _touch(own, its), _touch(its, own)
    point, normal, depth = (
        jnp.concatenate(pair) for pair in zip(mine, (theirs[0], -theirs[1], theirs[2]), strict=True)
    )
    share = _both(_tilting_mass(params), _tilting_mass(other)) / (1 + sum(components(_onset(depth))))
    grip = share * _GRIP_ON_DRONE

    def at(point: Float[Array, "3"], normal: Float[Array, "3"], depth: Float[Array, ""]) -> Wrench:
        vel = _velocity(own, point) - _velocity(its, point)
        inward = -dot(vel, normal)
        slip = vel + inward * normal
        push = share * _push(depth, inward)
        force = push * normal - _rub(_ON_DRONE * push, dot(slip, slip), grip) * slip
        return Wrench(force, cross(point, force))

    total = jax.tree.map(
        lambda x: jnp.stack([sum(components(row)) for row in _rows(x.T)]), jax.vmap(at)(point, normal, depth)
    )
    return jax.tree.map(lambda v: rotation.rotate_inverse(state.quat, v), total)


class _Body(NamedTuple):
    """A drone as it is touched; world frame, positions from where the caller has put the origin."""

    pos: Array
    vel: Array
    omega: Array
    center: Array
    """Of the disc."""
    axes: list[Array]
    """x, y, z of the body."""
    ball: Array
    ring: Array


def _body(params: Params, state: State, pos: Float[Array, "3"]) -> _Body:
    axes = rotation.axes(state.quat)
    center = pos + params.collision_offset * axes[2]
    return _Body(pos, state.vel, rotation.rotate(state.quat, state.omega), center, axes, *_shape(params))


def _velocity(body: _Body, point: Float[Array, "3"]) -> Float[Array, "3"]:
    return body.vel + cross(body.omega, point - body.pos)


def _touch(balls: _Body, disc: _Body) -> tuple[Float[Array, "8 3"], Float[Array, "8 3"], Float[Array, " 8"]]:
    """Where each ball of one body meets the disc of another: point, direction from disc to ball, depth (m)."""
    x, y, _ = balls.axes
    normal = disc.axes[2]

    def of_ball(cos: Float[Array, ""], sin: Float[Array, ""]):
        to_ball = balls.center + balls.ring * (cos * x + sin * y) - disc.center
        in_plane = to_ball - dot(to_ball, normal) * normal
        nearest = in_plane * disc.ring / jnp.sqrt(jnp.maximum(dot(in_plane, in_plane), disc.ring**2))
        apart = to_ball - nearest
        distance = jnp.sqrt(dot(apart, apart) + _NEAR**2)
        direction = apart / distance
        return disc.center + nearest + disc.ball * direction, direction, balls.ball + disc.ball - distance

    cos, sin = (jnp.asarray(f(_ANGLES), x.dtype) for f in (np.cos, np.sin))
    return jax.vmap(of_ball)(cos, sin)


def _push(depth: Array, rate: Array) -> Array:
    """Normal force per mass at a depth (m) that grows at a rate (m/s): N/kg, not negative."""
    return jnp.maximum(_onset(depth) * (_PUSH + _DAMPING * rate) + _STIFFNESS * jnp.maximum(depth, 0), 0)


def _onset(depth: Array) -> Array:
    """From 0 at the surface to 1 well inside, with a continuous slope."""
    square = jnp.maximum(depth, 0) ** 2
    return square / (_ONSET**2 + square)


def _rub(limit: Array, slip_squared: Array, grip: Array) -> Array:
    """Friction per slip velocity, N s/m: of a force up to `limit` (N), and itself less than `grip` (N s/m)."""
    return limit / jnp.sqrt(slip_squared + _SLOW**2 + (limit / grip) ** 2)


def _shape(params: Params) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Radius of the balls and of the circle of their centres, m; as in Bullet."""
    ball = jnp.minimum(params.collision_height, params.collision_radius) / 2
    return ball, params.collision_radius - ball


def _sliding_mass(params: Params) -> Float[Array, ""]:
    """What a force on the rim must move if it slides, tilts and turns the drone at once, kg."""
    ball, ring = _shape(params)
    low = jnp.abs(params.collision_offset) + ball
    ix, _, iz = components(params.inertia)
    return 1 / (1 / params.mass + low**2 / ix + ring**2 / iz)


def _tilting_mass(params: Params) -> Float[Array, ""]:
    """What a ball that is hit along the thrust axis must move, times a constant, but not more than the mass, kg."""
    ix, _, _ = components(params.inertia)
    return jnp.minimum(params.mass, _SHARE_ON_DRONE / (1 / params.mass + _shape(params)[1] ** 2 / ix))


def _both(a: Array, b: Array) -> Array:
    """The mass that two masses put up against each other."""
    return a * b / (a + b)


def _rows(matrix: Float[Array, "m n"]) -> list[Float[Array, " n"]]:
    """The rows of a matrix."""
    return [jnp.squeeze(row, 0) for row in jax.lax.split(matrix, [1] * len(matrix))]

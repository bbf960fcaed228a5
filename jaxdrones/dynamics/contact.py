"""Compliant contact of a drone with the ground, with obstacles and with other drones.

For the explicit backend only: Bullet resolves contacts itself.

The collision shape of a drone is that of Bullet: a disc with a ring of spheres as its rim, as high as its collision
cylinder. The normal force per mass at a penetration depth x that grows at the rate x' is

    s (a + b x') + c x,  s = x^2 / (d^2 + x^2),  and never negative.

At the surface this is the law of Hunt and Crossley (1975): the damping grows from zero with the depth, so the force is
continuous at touchdown and does not pull on a drone that takes off. Deeper inside the damping levels off, because
explicit integration is unstable with more. Friction is Coulomb's, and viscous at low slip speed. All forces are
proportional to a mass, so one set of coefficients serves every vehicle.

A velocity that is damped at a rate above 1/dt overshoots in explicit integration, and at a rate above 2/dt it gains
energy. For every vehicle, heave, tilt and slip are each damped at no more than 408 1/s, 1.7 over `LARGEST_STEP`;
`make_step` rejects longer steps. Coupled, the highest rate of a level drone is 275 1/s where it rests (hb: 334), and
490 1/s at a depth of 2 cm (hb: 610, above 2/dt). That rate is friction's at rest, which falls as soon as the drone
slips, so that the overshoot is a slip of the order of 1 cm/s. Such soft contact allows penetration: 8 mm for a drone
that lands at 1 m/s, 3 cm at 5 m/s.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.dynamics.needs import Needs, declare
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.vector import along_z, components, cross, dot, safe_sqrt, total
from jaxdrones.wrench import Wrench

_SPHERES = 8  # as in Bullet
_ANGLES = 2 * np.pi / _SPHERES * np.arange(_SPHERES)

_ONSET_DEPTH = 2.5e-3  # m, d: depth of half the damping; a drone at rest is 1.5 mm deep; 1 mm makes gradients noisier
_PRELOAD = 20.0  # m/s^2, a: about twice gravity, so that a drone rests near the surface
_DAMPING = 120.0  # 1/s, a b: half of 1/dt for a drone that heaves
_MAX_TILTING = 3.4  # largest ratio of the damping rate of tilt of a level drone to that rate, 1.7/dt; 3.3 for an hb
_STIFFNESS = 3000.0  # 1/s^2, c: (55 rad/s)^2; the damping is just above critical, so drones hardly bounce
_FRICTION_RATE = 400.0  # 1/s: highest rate of friction on the ground at a point of the rim
LARGEST_STEP = 1 / 240
"""Longest physics step with which contact is stable, for every vehicle, s."""
_FRICTION_RATE_ON_DRONE = 15.0  # 1/s: the same between drones at each of 16 points; more shakes a carried drone
_MAX_SHARE_ON_DRONE = 4.0  # normal force at one point over that of its lever; three loaded points then stay below 2/dt
_STICTION_SPEED = 0.01  # m/s: friction is viscous below; with the weight of a cf2x below 0.05 m/s
_GROUND_FRICTION = 0.5  # coefficient, also of obstacles: gym-pybullet-drones gives its drones 0.5 and its plane 1.0
_DRONE_FRICTION = 0.25  # coefficient: 0.5 times 0.5
_ROUNDING = 1e-4  # m: smooths the distance of coincident points


@declare(Needs(contact="ground", ground_only=True, largest_step=LARGEST_STEP))
def ground_contact(params: Params, state: State, scene: Any = None) -> Wrench:
    """Normal force and friction of the ground, the plane z = 0, on a drone.

    Without a ground in the scene the wrench is zero. Not for the Bullet backend, which resolves contact with the ground
    itself.
    """
    if scene is not None and not scene.ground:
        return Wrench(jnp.zeros_like(state.pos), jnp.zeros_like(state.pos))
    radius, ring = rim(params)
    x_axis, y_axis, z_axis = rotation.axes(state.quat)
    omega = rotation.rotate(state.quat, state.omega)
    # Everything below is in the world frame. The lowest point of the sphere at angle t is p + x cos t + y sin t from
    # the center of mass, and so are its velocity and, summed over the spheres, the moments of the forces.
    p = params.collision_offset * z_axis - along_z(radius)
    x, y = ring * x_axis, ring * y_axis
    cos, sin = (jnp.asarray(f(_ANGLES), radius.dtype) for f in (np.cos, np.sin))

    def around(a: Array, b: Array, c: Array) -> list[Float[Array, " spheres"]]:
        """Components of a + b cos t + c sin t at every sphere."""
        return [i + j * cos + k * sin for i, j, k in zip(components(a), components(b), components(c), strict=True)]

    _, _, height = around(state.pos + p, x, y)
    vx, vy, vz = around(state.vel + cross(omega, p), cross(omega, x), cross(omega, y))
    normal_force, viscosity = _load(params, -height, -vz, vx**2 + vy**2)
    forces = [-viscosity * vx, -viscosity * vy, normal_force]

    force = jnp.stack([total(f) for f in forces])
    torque = cross(p, force)
    torque += cross(x, jnp.stack([dot(cos, f) for f in forces])) + cross(y, jnp.stack([dot(sin, f) for f in forces]))
    return Wrench(rotation.rotate_inverse(state.quat, force), rotation.rotate_inverse(state.quat, torque))


@declare(Needs(contact="obstacles", largest_step=LARGEST_STEP))
def obstacle_contact(params: Params, state: State, scene: Any) -> Wrench:
    """Normal force and friction of the obstacles of a scene on a drone, by the law of the ground.

    Each of the eight spheres touches its nearest or deepest obstacle. Thin poles and corners can reach between two
    spheres into the disc. The explicit backend also sweeps the motion of every physics step and stops the disc, less
    its rounding, at the surface of an obstacle (`stop_at`). Not for the Bullet backend, which resolves these contacts
    itself.

    The ground of the scene is that of `ground_contact`.
    """
    if not scene.has_obstacles:
        zero = jnp.zeros_like(state.pos)
        return Wrench(zero, zero)
    radius, ring = rim(params)
    x_axis, y_axis, z_axis = rotation.axes(state.quat)
    omega = rotation.rotate(state.quat, state.omega)
    cos, sin = (jnp.asarray(f(_ANGLES), radius.dtype)[:, None] for f in (np.cos, np.sin))
    centers = (params.collision_offset * z_axis)[None] + ring * (cos * x_axis[None] + sin * y_axis[None])

    def at_sphere(center: Float[Array, "3"], surface: Any) -> Wrench:
        point = center - radius * surface.normal
        vel = state.vel + cross(omega, point)
        depth_rate = -dot(vel, surface.normal)
        slip = vel + depth_rate * surface.normal
        normal_force, viscosity = _load(params, radius - surface.distance, depth_rate, dot(slip, slip))
        force = normal_force * surface.normal - viscosity * slip
        return Wrench(force, cross(point, force))

    surfaces = scene.touched(state.pos[None] + centers, radius)
    wrench = jax.tree.map(lambda x: jax.vmap(total)(x.T), jax.vmap(at_sphere)(centers, surfaces))
    return jax.tree.map(lambda v: rotation.rotate_inverse(state.quat, v), wrench)


def stop_at(
    pos: Float[Array, "3"], vel: Float[Array, "3"], normals: Float[Array, "planes 3"], heights: Float[Array, " planes"]
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Project position and velocity of a drone onto the half spaces n . pos >= h: no depth and no approach.

    The impact is inelastic and without spin, so it adds no energy; compliant contact does the rest. The `normals` n are
    unit vectors, world, or zero for no plane; the `heights` are h, m.
    """
    for normal, height in zip(normals, heights, strict=True):
        behind = height - dot(normal, pos)
        pos += jnp.maximum(behind, 0) * normal
        vel -= jnp.where(behind > 0, jnp.minimum(dot(vel, normal), 0), 0) * normal
    return pos, vel


def contact_radius(params: Params) -> Float[Array, ""]:
    """Radius of the bounding ball of a drone's collision shape about the center of mass, m."""
    radius, ring = rim(params)
    return safe_sqrt(ring**2 + params.collision_offset**2) + radius


@declare(Needs(contact="drones", largest_step=LARGEST_STEP))
def drone_contact(params: Params, state: State, other: Params, other_state: State) -> Wrench:
    """Normal force and friction of another drone on a drone; the other drone gets the opposite.

    The spheres of each drone touch the rounded disc of the other. These 16 points share one normal force, so contact
    of two rims and of two discs is equally stiff. Not for the Bullet backend, which resolves these contacts itself.

    Contact of drones is softer than with the ground, and softer than in Bullet. Two cf2x stop each other rim to rim at
    1 m/s; at 3 m/s most slip past each other, one over the other (26 of 30, in Bullet 1 of 30). Disc to disc they stop
    each other up to 3 m/s, and pass through each other at 5 m/s. A drone that lies off-center on another slides down;
    in Bullet it stays.
    """
    # World frame, with positions relative to the center of mass of the first drone, for precision far from the origin.
    first = _body(params, state, jnp.zeros_like(state.pos))
    second = _body(other, other_state, other_state.pos - state.pos)
    ours, theirs = _contacts(first, second), _contacts(second, first)
    contacts = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), ours, theirs._replace(normal=-theirs.normal))
    mass = _series_mass(_tilting_mass(params), _tilting_mass(other))
    share = mass / (1 + total(_onset(contacts.depth)))

    def at_point(contact: _Contact) -> Wrench:
        vel = _velocity(first, contact.point) - _velocity(second, contact.point)
        depth_rate = -dot(vel, contact.normal)
        slip = vel + depth_rate * contact.normal
        normal_force = share * _normal_force_per_mass(contact.depth, depth_rate)
        viscosity = _friction_per_slip(_DRONE_FRICTION * normal_force, dot(slip, slip), share * _FRICTION_RATE_ON_DRONE)
        force = normal_force * contact.normal - viscosity * slip
        return Wrench(force, cross(contact.point, force))

    wrench = jax.tree.map(lambda x: jax.vmap(total)(x.T), jax.vmap(at_point)(contacts))
    return jax.tree.map(lambda v: rotation.rotate_inverse(state.quat, v), wrench)


def gap(params: Params, state: State, other: Params, other_state: State) -> Float[Array, ""]:
    """Distance between the collision shapes of two drones, as their contact sees it, m; negative if they overlap."""
    first = _body(params, state, jnp.zeros_like(state.pos))
    second = _body(other, other_state, other_state.pos - state.pos)
    return -jnp.maximum(jnp.max(_contacts(first, second).depth), jnp.max(_contacts(second, first).depth))


class _Body(NamedTuple):
    """Collision shape of a drone and its motion; world frame, with an origin chosen by the caller."""

    pos: Array
    """Center of mass."""
    vel: Array
    omega: Array
    center: Array
    """Center of the disc."""
    axes: list[Array]
    """x, y, z of the body."""
    radius: Array
    """Radius of the spheres, and half the thickness of the disc."""
    ring: Array
    """Radius of the circle of the spheres' centers."""


class _Contact(NamedTuple):
    """Nearest points of a sphere of one body and the disc of another."""

    point: Float[Array, "3"]
    """On the surface of the disc."""
    normal: Float[Array, "3"]
    """From the disc to the sphere, of unit length."""
    depth: Float[Array, ""]
    """Penetration, m; negative for a gap."""


def _body(params: Params, state: State, pos: Float[Array, "3"]) -> _Body:
    axes = rotation.axes(state.quat)
    center = pos + params.collision_offset * axes[2]
    return _Body(pos, state.vel, rotation.rotate(state.quat, state.omega), center, axes, *rim(params))


def _velocity(body: _Body, point: Float[Array, "3"]) -> Float[Array, "3"]:
    return body.vel + cross(body.omega, point - body.pos)


def _contacts(spheres: _Body, disc: _Body) -> _Contact:
    """Contact of each sphere of one body with the disc of another; arrays have a leading axis over spheres."""
    x, y, _ = spheres.axes
    axis = disc.axes[2]

    def of_sphere(cos: Float[Array, ""], sin: Float[Array, ""]) -> _Contact:
        to_sphere = spheres.center + spheres.ring * (cos * x + sin * y) - disc.center
        in_plane = to_sphere - dot(to_sphere, axis) * axis
        nearest = in_plane * disc.ring / jnp.sqrt(jnp.maximum(dot(in_plane, in_plane), disc.ring**2))
        separation = to_sphere - nearest
        distance = jnp.sqrt(dot(separation, separation) + _ROUNDING**2)
        normal = separation / distance
        point = disc.center + nearest + disc.radius * normal
        return _Contact(point, normal, spheres.radius + disc.radius - distance)

    cos, sin = (jnp.asarray(f(_ANGLES), x.dtype) for f in (np.cos, np.sin))
    return jax.vmap(of_sphere)(cos, sin)


def _normal_force_per_mass(depth: Array, depth_rate: Array, damping: ArrayLike = _DAMPING) -> Array:
    """Normal force per mass at a penetration depth (m) that grows at a rate (m/s): N/kg, never negative."""
    return jnp.maximum(_onset(depth) * (_PRELOAD + damping * depth_rate) + _STIFFNESS * jnp.maximum(depth, 0), 0)


def _load(params: Params, depth: Array, depth_rate: Array, slip_squared: Array) -> tuple[Array, Array]:
    """Normal force (N) and friction over slip velocity (N s/m) at one sphere on a static body."""
    ix, iy, _ = components(params.inertia)
    tilting = params.mass * rim(params)[1] ** 2 / 2 / jnp.minimum(ix, iy)  # rate of damped tilt over that of heave
    damping = _DAMPING / jnp.maximum(1, tilting / _MAX_TILTING)
    normal_force = params.mass / _SPHERES * _normal_force_per_mass(depth, depth_rate, damping)
    max_viscosity = _FRICTION_RATE * _sliding_mass(params) / _SPHERES
    return normal_force, _friction_per_slip(_GROUND_FRICTION * normal_force, slip_squared, max_viscosity)


def _onset(depth: Array) -> Array:
    """The factor s, from 0 at the surface to 1 well inside, with a continuous slope."""
    square = jnp.maximum(depth, 0) ** 2
    return square / (_ONSET_DEPTH**2 + square)


def _friction_per_slip(max_friction: Array, slip_squared: Array, max_viscosity: Array) -> Array:
    """Friction over slip velocity, N s/m: less than `max_viscosity`, and for a friction of up to `max_friction` (N)."""
    return max_friction / jnp.sqrt(slip_squared + _STICTION_SPEED**2 + (max_friction / max_viscosity) ** 2)


def rim(params: Params) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Radius of the spheres and of the circle of their centers, m; as in Bullet."""
    radius = jnp.minimum(params.collision_height, params.collision_radius) / 2
    return radius, params.collision_radius - radius


def _sliding_mass(params: Params) -> Float[Array, ""]:
    """Effective mass of a point of the rim under a sideways force, with the drone free to slide, tilt and turn, kg."""
    radius, ring = rim(params)
    low = jnp.abs(params.collision_offset) + radius
    ix, iy, iz = components(params.inertia)
    return 1 / (1 / params.mass + low**2 / jnp.minimum(ix, iy) + ring**2 / iz)


def _tilting_mass(params: Params) -> Float[Array, ""]:
    """Effective mass of a sphere under a force along the thrust axis, times a constant; at most the mass, kg."""
    ix, iy, _ = components(params.inertia)
    tilting = rim(params)[1] ** 2 / jnp.minimum(ix, iy)
    return jnp.minimum(params.mass, _MAX_SHARE_ON_DRONE / (1 / params.mass + tilting))


def _series_mass(a: Array, b: Array) -> Array:
    return a * b / (a + b)

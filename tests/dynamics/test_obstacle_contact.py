"""Contact with obstacles: walls hold, energy never grows, and a box is as good as the ground."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, assert_finite, jit_unoptimized

import jaxdrones as jd
from jaxdrones.dynamics.contact import stop_at
from jaxdrones.sensing import Box, Capsule, Cylinder, Scene, Sphere, gate

VEHICLES = {name: jd.load_params(name) for name in ("cf2x", "hb", "racer")}
CRAZYFLIE = VEHICLES["cf2x"]
WALL = Scene.of(Box(pos=(1.15, 0, 0), size=(0.3, 100, 100)), ground=False)  # its face is at x = 1 m
SCENE = Scene.of(
    Box(pos=(0, 0, 0), quat=(0, 0, np.sin(0.2), np.cos(0.2)), size=(0.5, 0.4, 0.3), active=True),
    Sphere(pos=(0.4, 0, 0), radius=0.2, active=True),
    Cylinder(pos=(0, 0.5, 0), quat=(np.sin(0.5), 0, 0, np.cos(0.5)), radius=0.2, height=0.4, active=True),
    Capsule(pos=(-0.5, 0, 0), radius=0.2, height=0.3, active=True),
    ground=False,
)
step = jd.make_step(effects=(jd.obstacle_contact,))


def random_states(n, seed=0):
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(n, 4))
    return jd.State(
        pos=jnp.asarray(rng.uniform([-0.7, -0.3, -0.3], [0.6, 0.7, 0.3], (n, 3))),
        quat=jnp.asarray(quat / np.linalg.norm(quat, axis=1, keepdims=True)),
        vel=jnp.asarray(rng.uniform(-3, 3, (n, 3))),
        omega=jnp.asarray(rng.uniform(-10, 10, (n, 3))),
        rpm=jnp.zeros((n, 4)),
    )


@partial(jit_unoptimized, static_argnames="length")
def fly(params, starts, scene, rpm, length):
    """The trajectories of single drones in worlds of one scene."""
    team = jd.repeat(params, 1)

    def trajectory(start):
        def advance(state, _):
            after = step(team, state, jnp.full((1, 4), rpm), scene)
            return after, after

        return jax.lax.scan(advance, jax.tree.map(lambda x: x[None], start), length=length)[1]

    return jax.tree.map(lambda x: x[:, :, 0], jax.vmap(trajectory)(starts))


@jit_unoptimized
def wrenches(scene, states):
    return jax.vmap(jd.obstacle_contact, (None, 0, None))(CRAZYFLIE, states, scene)


def solid(kind, thickness):
    """One solid about the origin, or a gate, that is as thick as asked for."""
    long, half = jnp.full_like(thickness, 9.0), thickness / 2
    if kind == "gate":
        return Scene.of(gate((0, 0, 0.0), depth=0.02, frame=0.05), ground=False)
    boxes = {"wall": (thickness, long, long), "beam": (thickness, thickness, long), "bar": (thickness, long, thickness)}
    if kind in boxes:
        return Scene.of(Box(pos=(0, 0, 0), size=jnp.stack(boxes[kind])), ground=False)
    round_ones = {"sphere": Sphere, "cylinder": Cylinder, "capsule": Capsule}
    height = {} if kind == "sphere" else {"height": long}
    return Scene.of(round_ones[kind](pos=(0, 0, 0), radius=half, **height), ground=False)


def deepest(params, states, scene):
    """How deep the disc of a drone, without its rounding, is in solids at and between the states of a flight, m."""
    rounding = jnp.minimum(params.collision_height, params.collision_radius) / 2
    angle = jnp.linspace(0, 2 * jnp.pi, 16, endpoint=False)
    around = jnp.stack([jnp.cos(angle), jnp.sin(angle), 0 * angle], axis=1)
    disc = jnp.concatenate([r * (params.collision_radius - rounding) * around for r in (0.0, 0.4, 0.7, 1.0)])
    disc += jnp.stack([0.0, 0.0, params.collision_offset])[None]

    def depth(pos, quat):
        points = pos[None] + jax.vmap(jd.rotation.rotate, (None, 0))(quat, disc)
        return -jnp.min(jax.vmap(scene.distance)(points))

    between = (states.pos[:-1] + share * jnp.diff(states.pos, axis=0) for share in (0.25, 0.5, 0.75, 1.0))
    return jnp.max(jnp.stack([jax.vmap(depth)(pos, states.quat[1:]) for pos in between]))


def flights_at(kind, vehicle, n, seed=0, max_rate=0.0, step=step):
    """Depths, gains of energy and trajectories of n drones without weight that fly at a solid at 1 to 20 m/s."""
    rng = np.random.default_rng(seed)
    params = jd.load_params(vehicle).replace(gravity=jnp.zeros(()))
    quat = rng.normal(size=(n, 4))
    quat[::2] = 0, 0, 0, 1
    speed, radius = np.linspace(1, 20, n), float(params.collision_radius)
    vel = speed[:, None] * np.stack([np.ones(n), *rng.uniform(-0.2, 0.2, (2, n))], axis=1)
    omega = max_rate * np.random.default_rng(seed).uniform(-1, 1, (n, 3))
    aim = np.array([-radius - 0.3, 0, 0]) * np.ones((n, 1))
    aim[:, 1:] = rng.uniform(-0.5, 0.5, (n, 2)) * radius + (kind == "gate") * np.array([[0.225, 0]])
    starts = jax.vmap(jd.State.at_rest)(jnp.zeros((n, 1, 3))).replace(
        pos=jnp.array(aim - vel * ((radius + 0.3) / speed)[:, None] + [radius + 0.3, 0, 0])[:, None],
        vel=jnp.array(vel)[:, None],
        omega=jnp.array(omega)[:, None],
        quat=jnp.asarray(quat / np.linalg.norm(quat, axis=1, keepdims=True))[:, None],
    )
    thickness = jnp.array([0.02, 0.05, 0.2])[np.arange(n) % 3]
    scenes = jax.vmap(lambda t: solid(kind, t))(thickness)
    team = jd.repeat(params, 1)

    @jit_unoptimized
    @jax.vmap
    def flown(start, scene):
        def advance(state, _):
            return (after := step(team, state, jnp.zeros((1, 4)), scene)), after

        states = jax.tree.map(lambda x: x[:, 0], jax.lax.scan(advance, start, length=96)[1])
        energy = params.mass * jnp.sum(states.vel**2, axis=1) + states.omega**2 @ params.inertia
        first = params.mass * jnp.sum(start.vel**2) + jnp.sum(start.omega**2 @ params.inertia)
        return deepest(params, states, scene), jnp.max(energy) / first, states

    return flown(starts, scenes)


def test_a_thin_wall_stops_drones_at_any_speed():
    speed = np.linspace(1, 20, 16)
    starts = random_states(16).replace(
        pos=jnp.asarray(np.stack([np.full(16, 0.5), np.zeros(16), np.zeros(16)], axis=1)),
        vel=jnp.array(speed[:, None] * [1, 0.1, 0]),
    )
    thin = Scene.of(Box(pos=(1.01, 0, 0), size=(0.02, 100, 100)), ground=False)
    states = fly(CRAZYFLIE.replace(gravity=jnp.zeros(())), starts, thin, 0.0, length=150)
    assert states.pos[..., 0].max() < 1
    assert (np.abs(states.vel[:, -1, 0]) < 1).all()


@pytest.mark.float32
@pytest.mark.slow
@pytest.mark.parametrize("vehicle", ["cf2x", "hb", "racer", "x500"])
@pytest.mark.parametrize("kind", ["wall", "beam", "bar", "sphere", "cylinder", "capsule", "gate"])
def test_nothing_flies_into_a_solid_however_thin_it_is_and_no_energy_is_gained(kind, vehicle):
    """The disc of a drone, which its rounding surrounds, stays out; rim first it may get in by a few millimeters.

    After an impact a drone turns about the point that touches, so that the center of mass of an hb, 7.5 cm beside its
    disc, may go on towards a wall. So the law is one of places.
    """
    depths, gains, states = flights_at(kind, vehicle, n=24)
    assert_finite(states)
    assert depths.max() < 0.01
    assert gains.max() < 1.001


@pytest.mark.float32
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["wall", "cylinder", "gate"])
def test_contact_gives_spinning_drones_no_energy(kind):
    """By an integrator that conserves the energy of a free spin."""
    midpoint = jd.make_step(effects=(jd.obstacle_contact,), integrator=jd.dynamics.INTEGRATORS["implicit_midpoint"])
    depths, gains, _ = flights_at(kind, "x500", n=24, max_rate=10.0, step=midpoint)
    assert depths.max() < 0.01
    assert 0.99 < gains.max() < 1 + 1e-5


@pytest.mark.parametrize("vehicle", VEHICLES)
@pytest.mark.slow
def test_a_wall_holds_at_5_meters_per_second_and_gives_no_energy(vehicle):
    """Level and tilted, for half a second without gravity or thrust; the center sinks in by less than 6 cm."""
    params = VEHICLES[vehicle].replace(gravity=jnp.array(0.0))
    speed, yaw, tilt = (x.ravel() for x in np.meshgrid([1.0, 3.0, 5.0], [0.0, 0.2, 0.4], [-0.5, 0.0, 0.5]))
    n = len(speed)
    zero = jnp.zeros((n, 3))
    quat = jax.vmap(jd.rotation.from_rpy)(jnp.stack([0 * yaw, tilt, yaw], axis=-1))
    start = zero.at[:, 0].set(1 - params.collision_radius - 0.5 * params.collision_height)
    vel = zero.at[:, 0].set(speed)
    states = fly(params, jd.State(start, quat, vel, zero, jnp.zeros((n, 4))), WALL, 0.0, 120)
    assert np.all(states.pos[..., 0] < 1.06) and np.all(np.min(states.vel[..., 0], axis=1) < 0.3)
    energy = 0.5 * params.mass * jnp.sum(states.vel**2, -1) + 0.5 * states.omega**2 @ params.inertia
    before = 0.5 * params.mass * speed**2
    assert np.all(energy <= before[:, None] * (1 + 1e-3))  # 0.1 %: the integrator's explicit gyroscopic term
    assert np.all(energy[:, -1] < 0.6 * before)


def test_a_box_is_as_good_as_the_ground():
    """The same wrench to rounding, whatever the drone does, wherever the top of the box is."""
    states = random_states(200)
    states = states.replace(pos=states.pos * jnp.array([[1, 1, 0.15]]))
    low = Scene.of(Box(pos=(0, 0, -50), size=(300, 300, 100)), ground=False)
    of_ground = jit_unoptimized(jax.vmap(jd.ground_contact, (None, 0)))(CRAZYFLIE, states)
    assert np.mean(np.any(of_ground.force != 0, axis=1)) > 0.5
    assert_close(wrenches(low, states), of_ground, 1e-12)
    raised, up = Scene.of(Box(pos=(0, 0, -48), size=(300, 300, 100)), ground=False), jnp.array([[0, 0, 2]])
    assert_close(wrenches(raised, states.replace(pos=states.pos + up)), of_ground, 1e-9)


@pytest.mark.slow
def test_forces_push_out_within_the_cone_of_friction_and_take_energy():
    """Their power on a drone that does not turn and moves inward is never positive."""
    states = random_states(300)
    still = states.replace(omega=0 * states.omega, vel=0 * states.vel)
    pushed = wrenches(SCENE, still)
    force = jax.vmap(jd.rotation.rotate)(states.quat, pushed.force)
    assert np.mean(np.any(force != 0, axis=1)) > 0.3
    slope = jax.vmap(lambda p: SCENE.nearest(p).normal)(states.pos)
    assert np.mean(jnp.sum(force * slope, -1)[np.any(force != 0, axis=1)] > 0) > 0.9
    moving = states.replace(
        omega=0 * states.omega, vel=-force / jnp.maximum(jnp.linalg.norm(force, axis=1), 1e-9)[:, None]
    )
    against = jax.vmap(jd.rotation.rotate)(states.quat, wrenches(SCENE, moving).force)
    assert np.all(jnp.sum(against * moving.vel, -1) <= 1e-9)


@pytest.mark.slow
def test_what_is_not_active_or_out_of_reach_is_not_touched():
    states = random_states(50)
    nothing = jax.tree.map(lambda x: x & False if x.dtype == bool else x, SCENE)
    assert all(np.all(x == 0) for x in jax.tree.leaves(wrenches(nothing, states)))
    assert all(np.all(x == 0) for x in jax.tree.leaves(jd.obstacle_contact(CRAZYFLIE, states, Scene())))
    far = states.replace(pos=states.pos + 2.0)
    assert all(np.all(x == 0) for x in jax.tree.leaves(wrenches(SCENE, far)))


@pytest.mark.slow
def test_looking_only_at_what_is_within_reach_changes_nothing():
    """In a heap of overlapping obstacles, every sphere meets the surface that is nearest to it."""
    rng = np.random.default_rng(1)
    heap = Scene.of(
        Box(pos=rng.uniform(-1, 1, (20, 3)), size=rng.uniform(0.1, 0.5, (20, 3))),
        Sphere(pos=rng.uniform(-1, 1, (20, 3)), radius=rng.uniform(0.1, 0.3, 20)),
        ground=False,
    )
    centers = jnp.asarray(rng.uniform(-1, 1, (100, 1, 3)))
    points = centers + jnp.asarray(0.05 * rng.normal(size=(100, 8, 3)))
    found = jit_unoptimized(jax.vmap(lambda points: heap.touched(points, 0.02)))(points)
    nearest = jit_unoptimized(jax.vmap(jax.vmap(heap.nearest)))(points)
    near = np.asarray(nearest.distance) < 0.02
    assert 0.1 < near.mean() < 0.9
    assert np.all(found.distance[~near] >= 0.02)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(nearest), strict=True):
        np.testing.assert_allclose(a[near], b[near], atol=1e-12)


@pytest.mark.parametrize(("toward", "kept"), [(-2.0, 0.0), (3.0, 3.0)])
def test_a_plane_takes_the_velocity_toward_it_and_no_other(toward, kept):
    normal, along = jnp.array([0.6, 0.0, 0.8]), jnp.array([0.8, 0.0, -0.6])
    pos, vel = jnp.zeros(3), toward * normal + 5 * along
    stopped_pos, stopped_vel = stop_at(pos, vel, jnp.stack([normal, jnp.zeros(3)]), jnp.array([0.01, 0.0]))
    np.testing.assert_allclose(stopped_vel, kept * normal + 5 * along, atol=1e-12)
    np.testing.assert_allclose(stopped_pos, 0.01 * normal, atol=1e-12)
    np.testing.assert_array_equal(stop_at(pos, vel, normal[None], jnp.array([-0.01]))[1], vel)


SPHERE = Sphere(pos=(0.5, 0.01, 1.0), radius=0.3)
BOX = Box(pos=(0.5, 0.0, 1.0), size=(0.6, 2, 2))


@pytest.mark.slow
@pytest.mark.parametrize(("solid", "speed"), [(SPHERE, 0.3), (BOX, 0.3), (BOX, 2.0)])
def test_the_gradient_through_a_collision_is_that_of_central_differences(solid, speed):
    """Of the place after a hit, in the start; at 0.3 m/s compliant contact alone stops the drone at the sphere."""
    team, rpm = jd.repeat(CRAZYFLIE, 1), jnp.zeros((1, 4))

    def end(x, to):
        scene = Scene.of(solid.replace(pos=solid.pos.at[0].add(to)), ground=False)
        start = jd.State.at_rest(jnp.stack([x, 0.0, 1.0])[None]).replace(vel=jnp.array([[speed, 0.1, 0.5]]))
        length = 40 + int(20 / speed)
        return jax.lax.scan(lambda s, _: (step(team, s, rpm, scene), None), start, length=length)[0].pos[0].sum()

    x, h = 0.1013, 1e-7
    slope, slope_to = jit_unoptimized(jax.grad(end, (0, 1)))(x, 0.0)
    end = jit_unoptimized(end)
    np.testing.assert_allclose(slope, (end(x + h, 0.0) - end(x - h, 0.0)) / (2 * h), rtol=1e-5, atol=1e-6)
    if solid is SPHERE:  # no swept stop, which takes an obstacle for resting
        np.testing.assert_allclose(slope_to, (end(x, h) - end(x, -h)) / (2 * h), rtol=1e-5)


@pytest.mark.slow
@pytest.mark.float32
def test_gradients_are_finite_wherever_a_drone_is():
    with jax.enable_x64(True):
        states = random_states(100)
        special = jnp.array([(0.4, 0, 0), (0, 0, 0), (9, 9, 9), (0, 0.5, 0)])
        states = states.replace(pos=states.pos.at[:4].set(special))
    states, params, scene = jax.tree.map(lambda x: np.asarray(x, np.float32), (states, CRAZYFLIE, SCENE))

    def push(scene, state):
        return sum(jnp.sum(x) for x in jax.tree.leaves(jd.obstacle_contact(params, state, scene)))

    assert_finite(jit_unoptimized(jax.vmap(jax.grad(push, (0, 1)), (None, 0)))(scene, states))


@pytest.mark.slow
def test_a_fast_drone_stops_where_the_wall_is_whatever_its_speed_and_goes_with_the_wall_of_its_own_way_along_it():
    """At 20 m/s: what is left of its velocity is that along the wall, and its place depends on its start along it."""

    def end(y, speed):
        start = jd.State.at_rest([[0.2, 0.0, 0.0]]).replace(
            pos=jnp.stack([jnp.full_like(y, 0.2), y, jnp.zeros_like(y)])[None],
            vel=jnp.stack([speed, speed / 10, 0 * speed])[None],
        )
        weightless = jd.repeat(CRAZYFLIE.replace(gravity=jnp.zeros(())), 1)

        def hold(params, memory, state, k):
            return memory, jnp.zeros((1, 4))

        return jd.rollout(partial(step, scene=WALL), hold, weightless, start, None, length=16)[0]

    y, speed = jnp.zeros(()), jnp.full((), 20.0)
    final = jit_unoptimized(end)(y, speed)
    assert abs(final.pos[0, 0] - (1 - CRAZYFLIE.collision_radius)) < 0.02 and abs(final.vel[0, 0]) < 0.7
    assert final.pos[0, 1] > 0.1
    slopes = jit_unoptimized(jax.jacfwd(lambda y, speed: end(y, speed).pos[0, :2], argnums=(0, 1)))(y, speed)
    assert_finite(slopes)
    assert abs(slopes[0][1] - 1) < 1e-6 and abs(slopes[0][0]) < 1e-6

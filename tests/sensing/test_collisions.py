"""Collision flags: geometry that can be worked out by hand, and Bullet's answers."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized

import jaxdrones
from jaxdrones import State, rotation
from jaxdrones.engine import bullet
from jaxdrones.sensing import Box, Capsule, Cylinder, Mesh, Scene, Sphere, Urdf, collisions, gate
from jaxdrones.sensing.collisions import met_on_the_way

CRAZYFLIE = jaxdrones.load_params("cf2x")
RADIUS, HEIGHT = 0.06, 0.025  # m, of the cf2x
RNG = np.random.default_rng(0)


def quats(*shape):
    quat = RNG.normal(size=(*shape, 4))
    return quat / np.linalg.norm(quat, axis=-1, keepdims=True)


POST = Cylinder(pos=(0, 0.5, 0.5), quat=tuple(quats()), radius=0.05, height=0.3)
BLOCK = Box(pos=(0, 0, 0.5), quat=tuple(quats()), size=(0.2, 0.1, 0.3))
PILL = Capsule(pos=(0.5, 0.5, 0.2), quat=tuple(quats()), radius=0.05, height=0.2)
SCENE = Scene.of(BLOCK, Sphere(pos=(0.5, 0, 0.5), radius=0.1), POST, PILL)


def random_teams(worlds, n, high=(0.7, 0.7, 0.7)):
    """At rest in a box, any attitude; in half of the worlds the second drone is near the first."""
    for k in range(worlds):
        pos = RNG.uniform([-0.2, -0.2, 0], high, (n, 3))
        if k % 2:
            pos[1] = pos[0] + RNG.uniform(-0.1, 0.1, 3)
        yield State(pos=np.abs(pos), quat=quats(n), vel=np.zeros((n, 3)), omega=np.zeros((n, 3)), rpm=np.zeros((n, 4)))


flags = jit_unoptimized(collisions)


def team(*pos, rpy=(0.0, 0.0, 0.0), vehicle=None):
    vehicle = CRAZYFLIE if vehicle is None else vehicle
    quat = jnp.tile(rotation.from_rpy(jnp.array(rpy))[None], (len(pos), 1))
    return jaxdrones.repeat(vehicle, len(pos)), State.at_rest(pos).replace(quat=quat)


@pytest.mark.parametrize("roll", [0.0, 0.4, np.pi / 2, 2.5, np.pi])
def test_a_tilted_drone_touches_the_ground_with_its_lowest_edge(roll):
    lowest = RADIUS * abs(np.sin(roll)) + HEIGHT / 2 * abs(np.cos(roll))
    for gap, touches in (-0.01, True), (0.0009, True), (0.0011, False), (0.3, False):
        found = flags(*team((3.0, -2.0, lowest + gap), rpy=(roll, 0.0, 0.7)))
        assert found.ground.tolist() == [touches] and not found.drones.any() and not found.scene.any()
    assert not flags(*team((0, 0, 0)), Scene(ground=False)).ground.any()


def test_what_is_not_active_is_not_touched():
    for active in True, False:
        ball = Scene.of(Sphere(pos=(0, 0, 1), radius=0.1, active=active))
        for margin, height in (0.0, 1.1), (0.1, 1.2):
            assert flags(*team((0, 0, height)), ball, margin).scene.tolist() == [active]


def test_the_cylinder_of_an_hb_is_below_its_centre_of_mass():
    hb = jaxdrones.load_params("hb")
    for height, touches in (0.1505, True), (0.152, False):
        assert flags(*team((0, 0, height), vehicle=hb)).ground.tolist() == [touches]
    above = 0.15 + 2 * float(hb.collision_offset)  # where it is upside down
    for height, touches in (above + 0.0005, True), (above + 0.002, False):
        assert flags(*team((0, 0, height), vehicle=hb, rpy=(np.pi, 0, 0))).ground.tolist() == [touches]


def test_drones_that_flew_through_each_other_met_on_the_way_and_those_side_by_side_did_not():
    params, state = team((1, 0, 5), (-1, 0, 5))
    met = jit_unoptimized(met_on_the_way)
    for before, expected in (([[-1.0, 0, 5], [1, 0, 5]], True), ([[1.0, -2, 5], [-1, -2, 5]], False)):
        assert met(params, state, jnp.array(before), 1e-3).tolist() == [expected] * 2


@pytest.mark.parametrize(
    ("direction", "distance"),
    [
        ((0, 0, 1), HEIGHT),
        ((np.cos(0.3), np.sin(0.3), 0), 2 * RADIUS),
        ((0.6, 0, 0.8), HEIGHT / 0.8),  # faces meet before edges do: the discs overlap seen from above
        ((np.cos(0.1), 0, np.sin(0.1)), 2 * RADIUS / np.cos(0.1)),
    ],
    ids=["stacked", "side by side", "steep", "slanted"],
)
def test_level_drones_touch_where_their_cylinders_do(direction, distance):
    for gap, touches in (-0.002, True), (0.0005, True), (0.003, False):
        other = np.array([0, 0, 5]) + (distance + gap) * np.array(direction)
        assert flags(*team((0, 0, 5), other)).drones.tolist() == [touches, touches]


def test_a_drone_on_its_edge_touches_the_face_of_another():
    """The edge reaches as far down as the radius."""
    params, state = team((0, 0, 5), (0.03, 0, 5 + HEIGHT / 2 + RADIUS))
    upright = state.quat.at[1].set(rotation.from_rpy(jnp.array([np.pi / 2, 0, 0])))
    for gap, touches in (0.0005, True), (0.003, False):
        raised = state.pos.at[1, 2].add(gap)
        assert flags(params, state.replace(quat=upright, pos=raised)).drones.tolist() == [touches, touches]


def test_only_those_that_touch_are_flagged_and_nobody_touches_itself():
    params, state = team((0, 0, 1), (0.3, 0, 1), (0.4, 0, 1), (0, 0, 0.0125))
    found = flags(params, state)
    assert found.drones.tolist() == [False, True, True, False]
    assert found.ground.tolist() == [False, False, False, True]
    assert flags(*team((0, 0, 1))).drones.tolist() == [False]
    assert flags(*team((0, 0, 1), (0, 0, 1))).drones.tolist() == [True, True]


def test_a_drone_fits_through_a_gate_and_not_through_its_frame():
    scene = Scene.of(gate((0, 0, 1), yaw=0.5))
    left = np.array([-np.sin(0.5), np.cos(0.5), 0])
    for aside, touches in (0, False), (0.13, False), (0.145, True), (-0.28, True), (0.45, False):
        assert flags(*team(np.array([0, 0, 1]) + aside * left), scene).scene.tolist() == [touches]


@pytest.mark.slow
def test_flags_of_many_worlds_are_those_of_each():
    params = jaxdrones.repeat(CRAZYFLIE, 3)
    worlds = list(random_teams(30, 3, high=(0.1, 0.1, 0.2)))
    together = jax.tree.map(lambda *x: np.stack(x), *worlds)
    at_once = jit_unoptimized(jax.vmap(partial(collisions, scene=SCENE), (None, 0)))(params, together)
    each = [flags(params, world, SCENE) for world in worlds]
    for name in "ground", "drones", "scene":
        found = getattr(at_once, name)
        np.testing.assert_array_equal(found, np.stack([getattr(one, name) for one in each]))
        assert found.dtype == bool and found.shape == (30, 3)
    assert 0.1 < at_once.drones.mean() < 0.9 and 0.1 < at_once.ground.mean() < 0.9


@pytest.mark.slow
@pytest.mark.float32
def test_flags_in_float32_far_from_the_origin():
    """At 100 m a float32 is right to 4 micrometres."""
    vehicle = jax.tree.map(lambda x: x.astype(np.float32), CRAZYFLIE)
    found = flags(*team((100, 100, 0.012), (100.119, 100, 0.0125), (100.0, 100, 0.3), vehicle=vehicle))
    assert found.drones.tolist() == [True, True, False] and found.ground.tolist() == [True, True, False]


def bullets_distances(client) -> dict[str, list[float]]:
    """Of each drone to the ground, to the other, to the nearest obstacle, m; 1 if beyond 0.1."""

    def distance(body, other):
        points = client.p.getClosestPoints(body, other, 0.1, physicsClientId=client.id)
        return min((point[8] for point in points), default=1.0)

    return dict(
        ground=[distance(body, client.surroundings.ground) for body in client.drones],
        drones=[distance(*client.drones)] * 2,
        scene=[
            min(distance(body, obstacle) for obstacle in client.surroundings.obstacles.values())
            for body in client.drones
        ],
    )


@pytest.mark.slow
@pytest.mark.needs("pybullet")
def test_flags_agree_with_bullets_distances_whatever_the_margin():
    """To 1 mm, Bullet's own margin; projections that have not converged make it 6 mm for 1 in 200."""
    params = jaxdrones.repeat(CRAZYFLIE, 2)
    wrong, compared, touching = [], 0, 0
    with bullet.make_step(scene=SCENE, collision="cylinder") as step:
        for state in random_teams(500, 2):
            step.contacts(params, state)
            step.client.place(np.concatenate([state.pos, state.quat, np.zeros((2, 6))], axis=1))
            distances = bullets_distances(step.client)
            for margin in 0.0, 0.01, 0.03:
                found = flags(params, state, SCENE, margin)
                for name, distance in distances.items():
                    beyond = np.array(distance) - margin
                    differ = np.asarray(getattr(found, name)) != (beyond <= 0)
                    wrong += np.abs(beyond[differ]).tolist()
                    compared, touching = compared + 2, touching + (beyond <= 0).sum()
    assert touching > 0.1 * compared
    assert max(wrong) < 6e-3 and np.sum(np.array(wrong) > 1e-3) < compared / 200


@pytest.mark.slow
@pytest.mark.needs("pybullet")
def test_what_bullet_lets_touch_is_flagged():
    """Its balls lie inside the cylinder."""
    params = jaxdrones.repeat(CRAZYFLIE, 2)
    found = {"ground": 0, "drone": 0, "obstacle": 0}
    name_of = {"ground": "ground", "drone": "drones", "obstacle": "scene"}
    with bullet.make_step(scene=SCENE) as step:
        for state in random_teams(300, 2):
            mine = flags(params, state, SCENE)
            for contact in step.contacts(params, state):
                if contact.depth > -1e-3:  # it also answers for what comes nearer within the step
                    kind, body = contact.other.split()[0], int(contact.body.split()[1])
                    assert getattr(mine, name_of[kind])[body]
                    found[kind] += 1
    assert min(found.values()) > 20


@pytest.mark.slow
@pytest.mark.needs("pybullet")
def test_a_drone_at_rest_on_either_ground_touches_it():
    params, state = team((0, 0, 0.03))
    explicit = jaxdrones.make_step(effects=(jaxdrones.ground_contact,))
    with bullet.make_step() as step:
        for a_step in explicit, step:
            now = state
            assert not flags(params, now).ground[0]
            for _ in range(120):
                now = a_step(params, now, np.zeros((1, 4)))
            assert flags(params, now).ground[0]


def test_wrong_input_is_told_apart(tmp_path):
    params, state = team((0, 0, 1))
    file = tmp_path / "rock.obj"
    file.write_text("")
    for shape in Mesh, Urdf:
        scene = Scene.of(BLOCK, shape(pos=(0, 0, 0), path=file))
        with pytest.raises(ValueError, match=rf"the scene has a {shape.__name__}, .*step\.contacts"):
            flags(params, state, scene)
    with pytest.raises(ValueError, match=r"params\.collision_radius has shape \(\).*jaxdrones\.repeat"):
        collisions(CRAZYFLIE, state)
    with pytest.raises(ValueError, match=r"state\.pos has shape \(3,\)"):
        collisions(params, jax.tree.map(lambda x: x[0], state))
    with pytest.raises(ValueError, match=r"margin is -0\.1"):
        collisions(params, state, margin=-0.1)
    with pytest.raises(ValueError, match="scene is 3"):
        collisions(params, state, scene=3)
    many = jax.tree.map(lambda x: jnp.stack([x, x]), SCENE)
    with pytest.raises(ValueError, match=r"scene\.boxes\.pos has shape \(2, 1, 3\); .*jax\.vmap"):
        collisions(params, state, many)

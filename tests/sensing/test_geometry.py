"""Distances and rays: laws of geometry, central differences, and Bullet's answers."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, assert_finite, jit_unoptimized

import jaxdrones as jd
from jaxdrones.engine import bullet
from jaxdrones.sensing import Box, Capsule, Cylinder, Scene, Sphere, Urdf, ray

RNG = np.random.default_rng(0)
UP, DOWN = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
LYING = (np.sin(np.pi / 4), 0, 0, np.cos(np.pi / 4))  # the axis along -y
BRICK = Box(pos=(0, 0, 2), size=(2, 4, 1))
BALL = Sphere(pos=(0, 0, 2), radius=0.5)
POLE = Cylinder(pos=(0, 0, 2), radius=0.5, height=2.0)
PILL = Capsule(pos=(0, 0, 2), radius=0.5, height=2.0)
SOLIDS = [BRICK, BALL, POLE, PILL]

distances = jit_unoptimized(jax.vmap(Scene.distance, (None, 0)))
distances_and_slopes = jit_unoptimized(jax.vmap(jax.value_and_grad(Scene.distance, argnums=1), (None, 0)))
rays = jit_unoptimized(jax.vmap(ray, (None, 0, 0)))


def units(*shape):
    v = RNG.normal(size=shape)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def random_scene() -> Scene:
    """Some of each kind, of any attitude, within some 2 m of the z axis."""

    def places(k):
        return dict(pos=RNG.uniform([-2, -2, 0], [2, 2, 3], (k, 3)), quat=units(k, 4))

    def lengths(*shape):
        return RNG.uniform(0.3, 1.0, shape)

    return Scene.of(
        Box(**places(4), size=lengths(4, 3)),
        Sphere(**places(3), radius=lengths(3)),
        Cylinder(**places(4), radius=lengths(4), height=lengths(4)),
        Capsule(**places(3), radius=lengths(3), height=lengths(3)),
    )


SCENE = random_scene()
POINTS = RNG.uniform([-4, -4, 0.01], [4, 4, 4], (300, 3))
DIRECTIONS = RNG.uniform([-2, -2, 0], [2, 2, 3], (300, 3)) - POINTS  # most look at the obstacles
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


@pytest.mark.parametrize(
    ("solid", "point", "expected"),
    [
        (BRICK, (2, 0, 2), 1.0),
        (BRICK, (1 + 0.3, 2 + 0.4, 2), 0.5),  # from an edge
        (BRICK, (0, 0, 2.1), -0.4),
        (BALL, (0, 3, 2), 2.5),
        (BALL, (0.1, 0, 2), -0.4),
        (POLE, (0.8, 0, 3.4), 0.5),  # from the rim
        (POLE, (0, 0, 2.8), -0.2),
        (PILL, (0, 0, 4), 0.5),
        (PILL, (0.9, 0, 2.7), 0.4),
        (Cylinder(pos=(0, 0, 2), quat=LYING, radius=0.5, height=2.0), (0, 1.5, 2), 0.5),
        (Capsule(pos=(0, 0, 2), quat=LYING, radius=0.5, height=2.0), (0, 1.5, 2), 0.0),
    ],
)
def test_distances_that_are_worked_out_by_hand(solid, point, expected):
    np.testing.assert_allclose(distances(Scene.of(solid, ground=False), np.array([point], float)), expected, atol=1e-12)


def test_the_ground_is_a_surface_and_nothing_is_infinitely_far():
    assert Scene().distance((3, 4, 5)) == 5 and Scene().distance((3, 4, -1)) == -1
    assert Scene.of(BALL).distance((0, 0, 0.1)) == 0.1
    assert Scene(ground=False).distance((0, 0, 1)) == jnp.inf
    assert ray(Scene(), (3, 4, 5), DOWN) == 5 and ray(Scene(), (3, 4, 5), (0.8, 0, -0.6)) == pytest.approx(5 / 0.6)
    assert ray(Scene(), (3, 4, 5), UP) == ray(Scene(), (3, 4, 5), (1, 0, 0)) == jnp.inf
    assert ray(Scene(ground=False), (3, 4, 5), DOWN) == jnp.inf


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda solid: type(solid).__name__)
def test_the_nearest_point_of_the_surface_is_a_distance_down_the_gradient(solid):
    """Exactness: distance changes by 1 m per metre, and the point that it leads to is on the surface."""
    scene = Scene.of(solid, ground=False)
    points = RNG.uniform([-1, -1, 1], [1, 1, 3], (300, 3))
    found, slopes = distances_and_slopes(scene, points)
    assert np.sum(found < 0) > 10 and np.sum(found > 0) > 10
    np.testing.assert_allclose(np.linalg.norm(slopes, axis=1), 1, rtol=1e-9)
    np.testing.assert_allclose(distances(scene, points - found[:, None] * slopes), 0, atol=1e-9)


@pytest.mark.parametrize(
    ("solid", "point"), [(BRICK, (1.0, 0.5, 0.1)), (POLE, (0.1, 0.0, 1.0)), (POLE, (0.5, 0.0, 0.1))]
)
def test_the_gradient_on_a_face_is_the_normal(solid, point):
    @jit_unoptimized
    def at(solid, point):
        return *jax.value_and_grad(solid.distance)(point), solid.outward(point)

    found, slope, normal = at(solid, np.array(point))
    assert found == 0
    np.testing.assert_allclose(slope, normal, atol=1e-12)


surfaces = jit_unoptimized(jax.vmap(Scene.nearest, (None, 0)))


def test_what_a_camera_takes_for_the_normal_is_outward_where_a_point_is_on_the_surface():
    """From points inside those that have edges, at which a point outside sees neither face."""
    reach = np.array([(1, 2, 0.5), (1, 1, 1), (0.35, 0.35, 1), (1, 1, 2)])

    def cosine(solid, point):
        outward = solid.outward(point)
        normal = jnp.stack(solid.normals(list(point - solid.distance(point) * outward)))
        return outward @ normal / jnp.linalg.norm(normal)

    found = jit_unoptimized(jax.vmap(lambda points: [cosine(*pair) for pair in zip(SOLIDS, points, strict=True)]))
    np.testing.assert_allclose(found(RNG.uniform(-1, 1, (100, 4, 3)) * reach), 1, rtol=1e-9)


def test_of_the_ground_and_solids_of_several_kinds_the_nearest_ones_are_found():
    scene = Scene.of(Box(pos=(2, 0, 5), size=(1, 1, 1)), Sphere(pos=(-2, 0, 5), radius=0.5))

    @jit_unoptimized
    def found(point):
        return scene.nearest(point).point, scene.nearest_few(point, 2).point

    wall, ball = [1.5, 0, 5], [-1.5, 0, 5]
    for point, expected in (([1.0, 0, 5], [wall, ball]), ([-1.0, 0, 5], [ball, wall]), ([0.1, 0, 2], [[0.1, 0, 0]])):
        nearest, few = found(jnp.array(point))
        np.testing.assert_allclose(nearest, expected[0], atol=1e-12)
        np.testing.assert_allclose(few[: len(expected)], expected, atol=1e-12)


@pytest.mark.slow
def test_the_nearest_surface_is_a_distance_away_along_its_normal():
    """Inside and outside; the normal is the gradient of the distance."""
    points = np.concatenate([POINTS, RNG.uniform([-2, -2, -0.2], [2, 2, 3], (300, 3))])
    found, (far, slopes) = surfaces(SCENE, points), distances_and_slopes(SCENE, points)
    assert np.sum(far < 0) > 50 and np.sum(far > 0) > 50
    np.testing.assert_allclose(found.distance, far, atol=1e-12)
    np.testing.assert_allclose(found.normal, slopes, atol=1e-9)
    np.testing.assert_allclose(found.point + far[:, None] * found.normal, points, atol=1e-12)


@pytest.mark.slow
def test_the_nearest_few_surfaces_are_those_of_the_nearest_obstacles_and_the_ground():
    scene, count = SCENE.replace(spheres=SCENE.spheres.replace(active=np.array([True, False, True]))), 16
    alone = [Scene.of(obstacle, ground=False) for obstacle in scene.obstacles if obstacle.active] + [Scene()]
    each = [surfaces(one, POINTS[:40]) for one in alone]
    order = np.argsort([one.distance for one in each], axis=0)
    found = jit_unoptimized(jax.vmap(Scene.nearest_few, (None, 0, None)), static_argnums=2)(scene, POINTS[:40], count)
    for name in ("distance", "point", "normal"):
        expected = np.stack([getattr(one, name) for one in each])[order, np.arange(40)]
        np.testing.assert_allclose(np.swapaxes(getattr(found, name), 0, 1)[: len(alone)], expected, atol=1e-12)
    assert np.all(found.distance[:, len(alone) :] == jnp.inf) and found.distance.shape == (40, count)


@pytest.mark.slow
def test_normals_have_unit_length_and_finite_gradients_also_at_centers_and_on_faces_and_edges():
    places = np.array([(0, 0, 2), (1, 0, 2), (1, 2, 2), (1, 2, 2.5), (0.5, 0, 2), (0, 0, 3), (0.5, 0, 3), (0, 0, 3.5)])
    scenes = [Scene.of(solid, ground=False) for solid in SOLIDS]

    @jit_unoptimized
    @jax.vmap
    def normals(point):
        return [scene.nearest(point).normal for scene in scenes]

    @jit_unoptimized
    @partial(jax.vmap, in_axes=(None, 0))
    @partial(jax.grad, argnums=(0, 1))
    def slopes(scenes, point):
        found = [scene.nearest(point) for scene in scenes]
        return sum(jnp.sum(x * jnp.arange(1.0, 1 + x.size)) for x in jax.tree.leaves(found))

    np.testing.assert_allclose(np.linalg.norm(normals(places), axis=-1), 1, rtol=1e-12)
    assert_finite(slopes(scenes, places))
    nothing = Scene(ground=False).nearest((0, 0, 1))
    assert nothing.distance == jnp.inf and np.all(nothing.normal == 0) and np.all(nothing.point == jnp.inf)


@pytest.mark.slow
def test_an_obstacle_that_is_not_active_is_not_there():
    """For distances, surfaces and rays; the others are as they were."""
    mask = np.arange(14) % 3 > 0
    of_kinds = np.split(mask, [4, 7, 11])
    kinds = ("boxes", "spheres", "cylinders", "capsules")
    some = SCENE.replace(**{k: getattr(SCENE, k).replace(active=m) for k, m in zip(kinds, of_kinds, strict=True)})
    few = Scene.of(*(obstacle for obstacle in some.obstacles if obstacle.active))
    assert [bool(obstacle.active) for obstacle in some.obstacles] == mask.tolist()
    np.testing.assert_allclose(distances(some, POINTS), distances(few, POINTS), rtol=1e-12)
    np.testing.assert_allclose(rays(some, POINTS, DIRECTIONS), rays(few, POINTS, DIRECTIONS), rtol=1e-9)
    assert_close(surfaces(some, POINTS), surfaces(few, POINTS), 1e-12)
    none = Scene.of(BALL.replace(active=False), ground=False)
    assert none.distance((0, 0, 2)) == none.nearest((0, 0, 2)).distance == ray(none, (5, 0, 2), (-1, 0, 0)) == jnp.inf


@pytest.mark.slow
def test_a_ray_ends_at_the_first_surface():
    """Where it ends the distance is zero, and positive before, so that nothing is jumped over."""
    outside, far = distances(SCENE, POINTS) > 0, np.asarray(rays(SCENE, POINTS, DIRECTIONS))
    hit = np.isfinite(far)
    assert 0.3 < hit.mean() < 0.98
    length = np.where(hit, far, 15.0)[:, None]
    np.testing.assert_allclose(distances(SCENE, POINTS + length * DIRECTIONS)[outside & hit], 0, atol=1e-9)
    for share in np.linspace(0, 0.999, 100):
        assert np.all(distances(SCENE, POINTS + share * length * DIRECTIONS)[outside] > 0)


@pytest.mark.slow
def test_a_ray_that_starts_inside_ends_at_once_and_one_that_looks_away_never():
    inside = distances(SCENE, POINTS) < 0
    assert inside.sum() > 10
    np.testing.assert_array_equal(rays(SCENE, POINTS, DIRECTIONS)[inside], 0)
    for solid in SOLIDS:
        assert ray(Scene.of(solid, ground=False), (5, 0, 2), (1, 0, 0)) == jnp.inf


@pytest.mark.parametrize("ground", [True, False])
def test_a_ray_from_a_place_that_is_not_a_number_is_no_miss(ground):
    """Nor is it a hit: the distance is NaN, as are all other measurements of a drone that is nowhere."""
    scene = Scene.of(Sphere(pos=(0, 0, 2), radius=0.3), ground=ground)
    places = jnp.full((3, 3), 1.0).at[jnp.arange(3), jnp.arange(3)].set(jnp.nan)
    assert np.isnan(rays(scene, places, jnp.full((3, 3), 0.1))).all()
    assert np.isnan(rays(scene, jnp.full((3, 3), 0.1), places)).all()


def test_a_ray_is_measured_in_lengths_of_its_direction():
    far = rays(SCENE, POINTS, DIRECTIONS)
    np.testing.assert_allclose(rays(SCENE, POINTS, 4 * DIRECTIONS), far / 4, rtol=1e-9)


def central_differences(function, x, step=1e-6):
    """The gradient of a scalar function of an array."""
    x, slope = np.asarray(x, float), np.zeros(np.shape(x))
    for i in np.ndindex(x.shape):
        offset = np.zeros(x.shape)
        offset[i] = step
        slope[i] = (function(x + offset) - function(x - offset)) / (2 * step)
    return slope


@jax.jit
def total_distance(scene, points):
    return jnp.sum(jax.vmap(Scene.distance, (None, 0))(scene, points))


@jax.jit
def total_ray(scene, origins, directions):
    """The mean of the rays that hit."""
    far = jax.vmap(ray, (None, 0, 0))(scene, origins, directions)
    return jnp.sum(jnp.where(jnp.isfinite(far), far, 0))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["boxes", "spheres", "cylinders", "capsules"])
@pytest.mark.parametrize("name", ["distance", "ray"])
def test_gradients_are_central_differences(name, kind):
    """In points and rays, and in places, attitudes and sizes of the obstacles."""
    solids = getattr(SCENE, kind)
    alone = SCENE.replace(**dict.fromkeys(("boxes", "spheres", "cylinders", "capsules"))).replace(ground=False)

    def at(**fields):
        return alone.replace(**{kind: solids.replace(**fields)})

    if name == "distance":
        of_scene, arguments = total_distance, (POINTS[:50],)
    else:
        of_scene, arguments = total_ray, (POINTS[:50], DIRECTIONS[:50])
        assert np.isfinite(rays(at(), POINTS, DIRECTIONS))[:50].sum() > 3
    slope, *others = jit_unoptimized(jax.grad(of_scene, argnums=tuple(range(1 + len(arguments)))))(at(), *arguments)
    for field in set(vars(solids)) - {"color", "active"}:
        numbers = central_differences(lambda x, f=field: of_scene(at(**{f: x}), *arguments), getattr(solids, field))
        np.testing.assert_allclose(getattr(getattr(slope, kind), field), numbers, rtol=1e-5, atol=1e-6, err_msg=field)
    for i, other in enumerate(others):

        def moved(x, i=i):
            return of_scene(at(), *(x if j == i else argument for j, argument in enumerate(arguments)))

        np.testing.assert_allclose(other, central_differences(moved, arguments[i]), rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_gradients_are_finite_everywhere():
    """At centers, on axes, edges and rims, along faces, grazing and missing."""
    scene = Scene.of(*SOLIDS)
    places = jnp.array(
        [(0, 0, 2), (0, 0, 3), (0.5, 0, 3), (1, 2, 2.5), (1, 0, 2), (0, 0, 0), (5, 5, 5), (1, -9, 2)], float
    )
    assert_finite(jit_unoptimized(jax.vmap(jax.grad(Scene.distance, argnums=(0, 1)), (None, 0)))(scene, places))
    directions = jnp.array([UP, DOWN, (1, 0, 0), (0, -1, 0), (0.6, 0.8, 0)], float)
    of_rays = jit_unoptimized(jax.vmap(jax.vmap(jax.grad(ray, argnums=(0, 1, 2)), (None, None, 0)), (None, 0, None)))
    assert_finite(of_rays(scene, places, directions))
    missing = of_rays(scene, places + 9.0, jnp.abs(directions.at[1].set(0.6)))
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(missing))


@pytest.mark.slow
def test_rays_through_drawn_scenes_are_the_same_over_worlds_as_mapped():
    def seen(key, origin, direction):
        pos = jax.random.uniform(key, (6, 3), minval=-2.0, maxval=2.0)
        scene = Scene.of(Sphere(pos=pos, radius=0.3), Box(pos=pos[:2], size=(0.5, 0.5, 2.0)), ground=False)
        return ray(scene, origin, direction), scene.distance(origin)

    arguments = jax.random.split(jax.random.key(0), len(POINTS)), jnp.asarray(POINTS), jnp.asarray(DIRECTIONS)
    assert_close(jax.jit(jd.over_worlds(seen))(*arguments), jax.jit(jax.vmap(seen))(*arguments), 1e-12)


@pytest.mark.slow
@pytest.mark.float32
def test_in_float32_a_ray_is_right_to_rounding():
    scene, points, directions = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (SCENE, POINTS, DIRECTIONS))
    found = rays(scene, points, directions)
    with jax.enable_x64(True):
        exact = rays(scene, np.asarray(points, float), np.asarray(directions, float))
    hit = np.isfinite(found) & np.isfinite(exact)
    assert found.dtype == np.float32 and hit.sum() > 20
    np.testing.assert_array_equal(np.isfinite(found), np.isfinite(exact))
    np.testing.assert_allclose(found[hit], exact[hit], atol=1e-4)


@pytest.fixture(scope="module")
def client():
    with bullet.make_step(scene=SCENE) as step:
        yield step.client


@pytest.mark.needs("pybullet")
def test_rays_hit_what_bullets_rays_hit(client):
    """Bullet's rays end up to 1 mm before a surface, its collision margin, and never behind it."""
    outside = np.asarray(distances(SCENE, POINTS)) > 1e-3
    reach, points, directions = 20.0, POINTS[outside], DIRECTIONS[outside]
    far = np.asarray(rays(SCENE, POINTS, DIRECTIONS))[outside]
    ends = points + reach * directions
    answers = client.p.rayTestBatch(points.tolist(), ends.tolist(), physicsClientId=client.id)
    hit, theirs = np.array([answer[0] >= 0 for answer in answers]), reach * np.array([answer[2] for answer in answers])
    assert 0.5 < hit.mean() < 0.99 and np.all(far[~hit] > reach)
    assert np.all(far[hit] > theirs[hit] - 1e-5) and np.median(far[hit] - theirs[hit]) < 1e-4
    assert np.max(distances(SCENE, points + theirs[:, None] * directions)[hit]) < 1e-3


@pytest.mark.needs("pybullet")
def test_distances_are_bullets_distances(client):
    """To 1 mm, the collision margin by which Bullet rounds edges and rims off."""
    far, points = np.asarray(distances(SCENE, POINTS))[:100], POINTS[:100]

    dot = client.p.createCollisionShape(client.p.GEOM_SPHERE, radius=1e-6, physicsClientId=client.id)

    def theirs(point):
        ball = dict(bodyB=-1, collisionShapeB=dot, collisionShapePositionB=point.tolist())
        pairs = (
            client.p.getClosestPoints(bodyA=body, distance=9.0, physicsClientId=client.id, **ball)
            for body in (*client.surroundings.obstacles.values(), client.surroundings.ground)
        )
        return min(pair[8] for found in pairs for pair in found)

    outside = far > 0.01
    assert outside.sum() > 50
    np.testing.assert_allclose(far[outside], [theirs(point) for point in points[outside]], atol=1e-3)


def test_what_has_no_geometry_is_refused(tmp_path):
    file = tmp_path / "body.urdf"
    file.write_text("")
    scene = Scene.of(Urdf(pos=(0, 0, 0), path=file))
    for call in (lambda s: Scene.distance(s, UP), lambda s: ray(s, UP, DOWN)):
        with pytest.raises(ValueError, match="the scene has a Urdf, supported by Bullet only; give Box, Sphere"):
            call(scene)
        with pytest.raises(ValueError, match=r"scene\.spheres\.pos has shape \(2, 1, 3\); .*jax\.vmap"):
            call(jax.tree.map(lambda x: jnp.stack([x, x]), Scene.of(BALL)))
    with pytest.raises(ValueError, match="scene is 3"):
        ray(3, UP, DOWN)
    with pytest.raises(ValueError, match=r"point has shape \(2, 3\); .*jax\.vmap"):
        SCENE.distance(np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"direction has shape \(2,\)"):
        ray(SCENE, UP, (1, 0))


@pytest.mark.needs("pybullet")
def test_obstacles_that_are_not_active_are_not_in_bullet_and_the_others_keep_their_numbers():
    balls = Scene.of(Sphere(pos=RNG.uniform(1, 2, (3, 3)), radius=0.1, active=[False, True, False]), ground=False)
    with bullet.make_step(scene=balls) as step:
        assert list(step.client.names().values()) == ["obstacle 1"]


@pytest.mark.needs("pybullet")
def test_bullet_refuses_a_scene_without_values():
    def fly(scene):
        bullet.make_step(scene=scene)
        return 0

    with pytest.raises(ValueError, match="the scene is traced by jit, vmap or grad"):
        jax.jit(fly)(SCENE)
    with pytest.raises(ValueError, match=r"scene\.spheres\.pos has shape \(2, 1, 3\)"):
        bullet.make_step(scene=jax.tree.map(lambda x: jnp.stack([x, x]), Scene.of(BALL)))

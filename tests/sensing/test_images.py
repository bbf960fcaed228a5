"""Images hold what geometry says, and their depth moves as the surfaces do."""

import functools

import jax
import jax.numpy as jnp
import marching
import numpy as np
import pytest
from helpers import jit_unoptimized

import jaxdrones
from jaxdrones import Camera, Scene, State, render, rotation
from jaxdrones.sensing import Box, Capsule, Cylinder, Mesh, Sphere, shading
from jaxdrones.sensing.frustum import Ground
from jaxdrones.sensing.images import drone_solids, view_of
from jaxdrones.sensing.shading import SUN, shade
from jaxdrones.sensing.visibility import depth

CRAZYFLIE = jaxdrones.load_params("cf2x")
CAMERA = Camera(resolution=(32, 24), field_of_view=70, far=30.0)


def team(*drones) -> tuple[jaxdrones.Params, State]:
    """Drones at positions with roll, pitch and yaw."""
    pos, rpy = (jnp.array(rows, float) for rows in zip(*drones, strict=True))
    state = State.at_rest(pos).replace(quat=jax.vmap(rotation.from_rpy)(rpy))
    return jaxdrones.repeat(CRAZYFLIE, len(drones)), state


def scattered(seed: int, of_each: int = 3) -> Scene:
    """Obstacles of all kinds between 4 m and 7 m ahead of (-5, 0, 1.5)."""
    rng = np.random.default_rng(seed)

    def poses():
        quat = rng.normal(size=(of_each, 4))
        pos = rng.uniform([-1, -2, 0.3], [2, 2, 3], (of_each, 3))
        return dict(pos=pos, quat=quat / np.linalg.norm(quat, axis=1, keepdims=True))

    return Scene.of(
        Box(**poses(), size=rng.uniform(0.3, 1, (of_each, 3))),
        Sphere(**poses(), radius=rng.uniform(0.2, 0.5, of_each)),
        Cylinder(**poses(), radius=rng.uniform(0.2, 0.4, of_each), height=rng.uniform(0.4, 1.5, of_each)),
        Capsule(**poses(), radius=rng.uniform(0.1, 0.3, of_each), height=rng.uniform(0.3, 1, of_each)),
    )


WATCHING = team(([-5.0, 0, 1.5], [0.1, 0.05, 0.0]), ([-4.2, 0.1, 1.5], [0.3, -0.2, 0.4]), ([-3, -0.5, 2], [0, 0.4, 3]))


def interior(segmentation: np.ndarray) -> np.ndarray:
    """Pixels whose neighbors show the same."""
    padded = np.pad(segmentation, 1, mode="edge")
    h, w = segmentation.shape
    shifts = [padded[i : i + h, j : j + w] for i in range(3) for j in range(3)]
    return np.all([shift == segmentation for shift in shifts], axis=0)


@pytest.mark.slow
def test_depth_is_that_of_a_march_along_every_ray():
    scene, (params, state) = scattered(0), WATCHING
    images = render(scene, params, state, CAMERA)
    parts = [solid for kind in drone_solids(params, state) for solid in marching.single(kind)]
    owners = [0, 1, 2, *np.repeat([0, 1, 2], 4)]
    for i in range(3):
        view = view_of(CAMERA, *jax.tree.map(lambda x, i=i: x[i], (params, state)))
        visible = [part for part, owner in zip(parts, owners, strict=True) if owner != i]
        depth = marching.depth(view, [*scene.obstacles, *visible], CAMERA.far)
        inside = interior(np.asarray(images.segmentation[i])) & (depth < CAMERA.far)
        assert inside.mean() > 0.15
        np.testing.assert_allclose(np.asarray(images.depth[i])[inside], depth[inside], rtol=1e-6)


@pytest.mark.slow
def test_a_narrow_view_shows_the_middle_of_a_wide_one():
    """What is beside a view is left out of the computation: other solids for the one than for the other."""
    wide = Camera(resolution=(64, 48), field_of_view=90.0, far=30.0)
    narrow = Camera(resolution=(16, 12), field_of_view=float(np.degrees(2 * np.arctan(0.25))), far=30.0)
    rng = np.random.default_rng(2)
    params, state = team(*((rng.uniform([-3, -3, 0.1], 3), rng.uniform(-3, 3, 3)) for _ in range(8)))
    scene = scattered(1, of_each=6)
    some, most = (render(scene, params, state, camera) for camera in (narrow, wide))
    assert len(np.unique(some.segmentation)) > 10
    np.testing.assert_allclose(some.depth, most.depth[:, 18:30, 24:40], rtol=1e-12)
    np.testing.assert_array_equal(some.segmentation, most.segmentation[:, 18:30, 24:40])


@pytest.mark.slow
def test_a_wall_is_at_its_distance_in_every_pixel():
    wall = Box(pos=(4.0, 0.0, 2.0), size=(1.0, 100.0, 100.0))
    images = render(Scene.of(wall, ground=False), *team(([0, 0, 1], [0, 0, 0])), Camera(resolution=(9, 7)))
    np.testing.assert_allclose(images.depth, 3.5, rtol=1e-12)
    np.testing.assert_array_equal(images.segmentation, 2)  # 0 ground, 1 drone, 2 wall


@pytest.mark.slow
def test_labels_are_ground_drones_obstacles_and_nothing():
    scene = Scene.of(Sphere(pos=(0.0, 0.0, 1.0), radius=0.3), Box(pos=(2.0, 3.0, 1.0), size=(1.0, 1.0, 1.0)))
    params, state = team(([-2, 0, 1], [0, 0, 0]), ([-1.5, 0.3, 0.9], [0, 0, 0]))
    labels = render(scene, params, state, CAMERA).segmentation[0]
    assert set(np.unique(labels)) == {-1, 0, 2, 3, 4}  # of drones only the other one; boxes come before spheres
    assert labels[0, 0] == -1 and labels[-1, 0] == 0 and labels[12, 16] == 4


@pytest.mark.slow
def test_a_drone_sees_itself_only_if_asked():
    params, state = team(([0, 0, 1], [0, 0, 0]))
    above = dict(offset=(-0.3, 0.0, 0.0), resolution=(24, 24))
    assert not (render(Scene(), params, state, Camera(**above)).segmentation == 1).any()
    assert (render(Scene(), params, state, Camera(**above, sees_self=True)).segmentation == 1).any()


@pytest.mark.slow
def test_a_leveled_camera_ignores_roll_and_a_fixed_one_turns():
    scene, level, rolled = scattered(0), team(([-5, 0, 1.5], [0, 0, 0])), team(([-5, 0, 1.5], [0.5, 0, 0]))
    for leveled in True, False:
        camera = Camera(resolution=(16, 12), leveled=leveled)
        same = jnp.allclose(render(scene, *level, camera).depth, render(scene, *rolled, camera).depth)
        assert same == leveled


def test_a_leveled_camera_looks_ahead_with_the_left_and_the_world_above_where_they_are_in_the_image():
    params, state = jax.tree.map(lambda x: x[0], team(([0, 0, 1], [0.5, -0.3, 2])))
    eye, (forward, left, up) = jit_unoptimized(Camera(leveled=True, offset=(0.1, 0, 0.2)).pose)(params, state)
    np.testing.assert_allclose(forward, rotation.axes(state.quat)[0], atol=1e-12)
    np.testing.assert_allclose(left, [-np.sin(2), np.cos(2), 0], atol=1e-12)
    np.testing.assert_allclose(up, np.cross(forward, left), atol=1e-12)
    np.testing.assert_allclose(eye, [0.1, 0, 1.2], atol=1e-12)
    assert up[2] > 0.9


def test_the_principal_point_is_the_pixel_of_the_viewing_direction_to_the_right_of_and_below_the_center():
    camera = Camera(resolution=(40, 20), principal_point=(3.5, 1.5))
    view = view_of(camera, *jax.tree.map(lambda x: x[0], team(([0, 0, 1], [0, 0, 0]))))
    assert view.u[0, 23] == view.v[11, 0] == 0 and np.all(np.diff(view.u[0]) < 0) and np.all(np.diff(view.v[:, 0]) < 0)


@pytest.mark.parametrize("edge", [0.3, 1.1])  # m, of pixels on tiles of 0.5 m
def test_a_pixel_has_the_mean_of_the_tiles_in_it(edge):
    """Of the checkered ground far below, by many samples over the edge of a pixel."""
    down = team(([0.1, 0.2, 100.0], [0, np.pi / 2, 0]))
    fine, few = 20, 12

    def tiles(pixels, slope):
        camera = Camera(resolution=(pixels, pixels), field_of_view=2 * np.degrees(np.arctan(slope)))
        view = view_of(camera, *jax.tree.map(lambda x: x[0], down))
        height = np.full((view.v + view.u).shape, 100.0)
        ground = [Ground.of(float)], jnp.zeros((1, 3)), 0, height.astype(int) * 0, height
        return np.asarray(jit_unoptimized(shade, static_argnums=3)(view, *ground)[..., 0], float)

    slope = few * edge / 2 / 100
    many = tiles(few * fine, slope).reshape(few, fine, few, fine).mean(axis=(1, 3))
    np.testing.assert_allclose(
        tiles(few, slope).reshape(few, few), many, atol=3
    )  # of about 60 levels between dark and bright


@pytest.mark.slow
def test_an_orientation_turns_the_camera():
    scene = scattered(0)
    left = Camera(resolution=(16, 12), orientation=(0.0, 0.0, np.sin(np.pi / 4), np.cos(np.pi / 4)))
    turned, fixed = team(([-5, 0, 1.5], [0, 0, 0])), team(([-5, 0, 1.5], [0, 0, -np.pi / 2]))
    ahead = render(scene, *turned, Camera(resolution=(16, 12))).depth
    np.testing.assert_allclose(render(scene, *fixed, left).depth, ahead, rtol=1e-9)


@pytest.mark.slow
def test_what_is_too_near_is_seen_at_the_nearest_depth_and_what_is_too_far_not_at_all():
    around = Sphere(pos=(0.0, 0.0, 1.0), radius=0.5)
    inside = render(Scene.of(around), *team(([0, 0, 1], [0, 0, 0])), CAMERA)
    np.testing.assert_array_equal(inside.depth, CAMERA.near)
    wall = Box(pos=(40.0, 0.0, 0.0), size=(1.0, 1000.0, 1000.0))
    beyond = render(Scene.of(wall, ground=False), *team(([0, 0, 1], [0, 0, 0])), CAMERA)
    np.testing.assert_array_equal(beyond.depth, CAMERA.far)
    np.testing.assert_array_equal(beyond.segmentation, -1)


@pytest.mark.slow
def test_the_gradient_of_depth_is_that_of_the_visible_surface():
    scene, (params, state) = scattered(1), WATCHING
    moving = dict(pos=state.pos, quat=state.quat)

    def depth(moving, scene):
        return render(scene, params, state.replace(**moving), CAMERA).depth

    rng = np.random.default_rng(2)
    labels = np.asarray(render(scene, params, state, CAMERA).segmentation)
    assert len(set(np.unique(labels)) & set(range(4, 4 + 12))) > 8  # of 12 obstacles
    inside = np.stack([interior(image) for image in labels])
    direction = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), (moving, scene))
    weights = jnp.asarray(rng.normal(size=labels.shape))
    tangent_of = jit_unoptimized(lambda direction: jax.jvp(depth, (moving, scene), direction)[1])
    gradient = jit_unoptimized(jax.grad(lambda *x: jnp.sum(weights * depth(*x)), (0, 1)))(moving, scene)
    for part in range(2):  # the drones, then the obstacles
        along = tuple(x if i == part else jax.tree.map(jnp.zeros_like, x) for i, x in enumerate(direction))
        tangent = tangent_of(along)
        ahead, behind = (
            depth(*jax.tree.map(lambda x, d, sign=sign: x + sign * 1e-5 * d, (moving, scene), along))
            for sign in (1, -1)
        )
        differences = np.asarray(ahead - behind) / 2e-5
        np.testing.assert_allclose(np.asarray(tangent)[inside], differences[inside], rtol=1e-4, atol=1e-5)
        product = sum(jnp.sum(g * d) for g, d in zip(*map(jax.tree.leaves, (gradient, along)), strict=True))
        np.testing.assert_allclose(product, jnp.sum(weights * tangent), rtol=1e-9)


@pytest.mark.slow
def test_gradients_are_finite_along_faces_and_axes_in_single_precision():
    scene = Scene.of(
        Box(pos=(3.0, 0.0, 1.0), size=(1.0, 1.0, 1.0)),
        Cylinder(pos=(4.0, 1.0, 1.0), radius=0.4, height=2.0),
        Sphere(pos=(3.0, -1.0, 1.0), radius=0.3),
    )
    params, state = team(([0, 0, 1.0], [0, 0, 0]))
    params, state, scene = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (params, state, scene))
    camera = Camera(resolution=(17, 13))  # the middle pixel looks along an axis of the box

    @jit_unoptimized
    @functools.partial(jax.value_and_grad, argnums=(0, 1))
    def nearness(state, scene):
        return jnp.sum(1 / render(scene, params, state, camera).depth)

    value, gradient = nearness(state, scene)
    assert value.dtype == jnp.float32
    assert all(jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))


@pytest.mark.slow
def test_the_image_is_that_of_one_world_in_every_one_of_many():
    params, state = WATCHING
    scenes = jax.tree.map(lambda *x: jnp.stack(x), *(scattered(seed) for seed in range(3)))
    many = jax.vmap(lambda scene: render(scene, params, state, CAMERA))(scenes)
    for seed in range(3):
        alone = render(scattered(seed), params, state, CAMERA)
        np.testing.assert_allclose(many.depth[seed], alone.depth, rtol=1e-12)
        np.testing.assert_array_equal(many.segmentation[seed], alone.segmentation)
        np.testing.assert_array_equal(many.rgb[seed], alone.rgb)


@pytest.mark.slow
def test_colors_are_those_of_what_is_seen():
    red = Box(pos=(3.0, 0.0, 1.0), size=(1.0, 1.0, 1.0), color=(1.0, 0.0, 0.0, 1.0))
    params, state = team(([0, 0, 1], [0, 0, 0]))
    rgb = np.asarray(render(Scene.of(red), params, state, CAMERA).rgb[0], float)
    assert rgb.shape == (24, 32, 4) and (rgb[..., 3] == 255).all()
    r, g, b = rgb[12, 16, :3]
    assert r > 80 and g == b == 0
    sky_r, _, sky_b = rgb[0, 0, :3]
    assert sky_b > sky_r
    down = Camera(resolution=(32, 24), orientation=(0.0, np.sin(np.pi / 4), 0.0, np.cos(np.pi / 4)))
    tiles = np.asarray(render(Scene(), params, state, down).rgb[0, ..., 0], float)
    assert tiles.max() - tiles.min() > 30


BALL = Sphere(pos=(1.3, 0.5, 1.2), radius=0.7, color=(1.0, 1.0, 1.0, 1.0))


@functools.cache
def ball_from_a_tilted_camera():
    """Of the pixels that see it: (1, u, v), rays, normals, depths and their derivatives by eye and axes, redness."""
    camera = Camera(resolution=(8, 6), field_of_view=70, far=30.0)
    view = view_of(camera, *jax.tree.map(lambda x: x[0], team(([0, 0, 1.0], [0.2, -0.1, 0.3]))))
    solids, active = Scene.of(BALL).shapes(float), [jnp.ones(1, bool)]

    @jit_unoptimized
    def look(eye, axes):
        def and_itself(eye, axes):
            found = depth(view.replace(eye=eye, axes=axes), solids, active)
            return found, found

        slopes, found = jax.jacfwd(and_itself, (0, 1), has_aux=True)(eye, axes)
        index = (found == view.far).astype(int)
        return found, slopes, shade(view, solids, jnp.ones((1, 3)), None, index, found)[..., 0]

    found, (by_eye, by_axes), red = jax.tree.map(np.asarray, look(view.eye, view.axes))
    view = jax.tree.map(np.asarray, view)
    pixels = np.stack(np.broadcast_arrays(1.0, view.u, view.v), axis=-1)
    rays = pixels @ view.axes
    normals = (view.eye + found[..., None] * rays - np.asarray(BALL.pos)) / float(BALL.radius)
    hit = found < view.far
    assert 10 < hit.sum() < 40
    return [x[hit] for x in (pixels, rays, normals, found, by_eye, by_axes, red)]


def test_a_pixel_stays_on_the_surface_where_the_eye_moves_and_the_camera_turns():
    """The tangent plane at eye + depth * ray gives the derivatives; a step along a ray makes its depth as much less."""
    pixels, rays, normals, depths, by_eye, by_axes, _ = ball_from_a_tilted_camera()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-9)
    np.testing.assert_allclose(np.sum(rays * by_eye, axis=1), -1, rtol=1e-9)
    expected = -normals / np.sum(rays * normals, axis=1, keepdims=True)
    np.testing.assert_allclose(by_eye, expected, rtol=1e-7)
    turned = depths[:, None, None] * pixels[:, :, None] * expected[:, None, :]
    np.testing.assert_allclose(by_axes, turned, rtol=1e-7, atol=1e-9)


def test_what_is_turned_towards_the_sun_is_bright_by_lamberts_law_and_the_rest_in_shadow():
    _, _, normals, *_, red = ball_from_a_tilted_camera()
    cosine = normals @ np.array(SUN)
    assert np.sum(cosine > 0.2) > 3 and np.sum(cosine < -0.04) > 3
    shadow = int(red[cosine.argmin()])
    assert 0 < shadow < 200
    np.testing.assert_allclose(red, shadow + (255 - shadow) * np.maximum(cosine, 0), atol=1)


def test_the_sun_lights_the_ground_as_a_level_face():
    """Tiles and the top of a box in the color of the bright ones, from above."""
    above = team(([0, 0, 1.0], [0, np.pi / 2, 0]))
    look_down = view_of(Camera(resolution=(16, 16)), *jax.tree.map(lambda x: x[0], above))
    top = Scene.of(Box(pos=(0, 0, -1), size=(9, 9, 2)), ground=False).shapes(float)
    colors, far = jnp.array([shading._BRIGHT]), jnp.full_like(look_down.u + look_down.v, 1.0)
    index = far.astype(int) * 0
    tiles = jit_unoptimized(lambda: shade(look_down, [Ground.of(float)], colors, 0, index, far))()
    box = jit_unoptimized(lambda: shade(look_down, top, colors, None, index, far))()
    np.testing.assert_array_equal(np.max(tiles, axis=(0, 1)), np.max(box, axis=(0, 1)))


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ({"camera": "front"}, r"camera is 'front'; give for example jaxdrones.Camera"),
        ({"scene": Scene.of(Mesh(path=__file__, pos=(0, 0, 0)))}, "the scene has a Mesh, supported by Bullet only"),
        ({"scene": None}, "scene is None; give a jaxdrones.sensing.Scene"),
    ],
)
def test_nonsense_is_refused(arguments, error):
    params, state = team(([0, 0, 1], [0, 0, 0]))
    with pytest.raises(ValueError, match=error):
        render(**{"scene": Scene(), "params": params, "state": state, "camera": CAMERA} | arguments)


@pytest.mark.parametrize(
    ("option", "error"),
    [
        (dict(resolution=(0, 48)), "width of a camera is 0"),
        (dict(noise="strong"), r"noise of a camera is 'strong'; give jaxdrones.sensing.DepthNoise\(...\)"),
        (dict(resolution=64), r"resolution of a camera is 64; give \(width, height\)"),
        (dict(field_of_view=180), "field_of_view of a camera is 180"),
        (dict(orientation=(0, 0, 0, 0)), "orientation of a camera has length 0"),
        (dict(far=0.01), "far of a camera is 0.01"),
        (dict(offset=(0, 0)), r"offset of a camera is \(0, 0\); give 3 numbers"),
        (dict(rate=-1), "rate of a camera is -1"),
    ],
)
def test_a_camera_says_what_is_wrong_with_it(option, error):
    with pytest.raises(ValueError, match=error):
        Camera(**option)

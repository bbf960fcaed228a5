"""What the cameras see is what geometry says."""

import golden_data
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones
from jaxdrones import State, rotation
from jaxdrones.engine import bullet
from jaxdrones.sensing import Box, Camera, Cylinder, Scene, Sphere, Urdf, camera_2021, render

pytestmark = pytest.mark.needs("pybullet")

CRAZYFLIE = jaxdrones.repeat(jaxdrones.load_params("cf2x"), 1)
STOCK = pytest.importorskip("pybullet_data").getDataPath() + "/"


def at(pos, quat=(0.0, 0.0, 0.0, 1.0)) -> State:
    return State.at_rest(jnp.array([pos], float)).replace(quat=jnp.array([quat], float))


def pictures(step, state, camera=camera_2021, scene=None):
    """Color, depth and segmentation that the first drone sees."""
    images = step.camera(CRAZYFLIE, state, camera, scene)
    return images.rgb[0], images.depth[0], images.segmentation[0]


@pytest.mark.slow
def test_a_colored_box_in_front_is_seen_where_geometry_says():
    box = Box(pos=(2.0, 0.3, 1.0397), size=(0.4, 0.4, 0.4), color=(1.0, 0.0, 0.0, 1.0))
    with bullet.make_step(scene=Scene.of(box)) as step:
        rgb, depth, segmentation = pictures(step, at([0, 0, 1.0397]), Camera())
    seen = segmentation == 2  # background -1, ground 0, drone 1, box 2
    rows, columns = np.nonzero(seen)
    focal = 24 / np.tan(np.radians(30))  # pixels; 60 degrees over 48 rows
    # of the front face, 1.8 m ahead, the left edge; of the inner side, which is seen too, the far edge, 2.2 m ahead
    left, right = 32 - focal * 0.5 / 1.8, 32 - focal * 0.1 / 2.2
    assert abs(columns.min() - left) <= 1 and abs(columns.max() + 1 - right) <= 1
    half = focal * 0.2 / 1.8
    assert abs(rows.min() - (24 - half)) <= 1 and abs(rows.max() + 1 - (24 + half)) <= 1
    np.testing.assert_allclose(np.median(depth[seen]), 1.8, atol=0.01)  # most of what is seen is the front face
    red, green, blue = rgb[seen][:, :3].mean(0)
    assert red > 100 and green < 20 and blue < 20


@pytest.mark.slow
def test_the_camera_turns_with_the_drone():
    ball = Sphere(pos=(0.0, 2.0, 1.0), radius=0.3)
    with bullet.make_step(scene=Scene.of(ball)) as step:
        ahead = pictures(step, at([0, 0, 1.0]))[2]
        left = pictures(step, at([0, 0, 1.0], [0, 0, np.sin(np.pi / 4), np.cos(np.pi / 4)]))[2]
    assert not (ahead == 2).any() and (left == 2).sum() > 50


def test_a_team_sees_each_other_and_nobody_sees_itself():
    team = jaxdrones.repeat(jaxdrones.load_params("cf2x"), 2)
    facing = State.at_rest(jnp.array([[0.0, 0, 1], [0.5, 0, 1]]), yaw=jnp.array([0, jnp.pi]))
    with bullet.make_step() as step:
        images = step.camera(team, facing)
    rgb, depth, segmentation = images.rgb, images.depth, images.segmentation
    assert rgb.shape == (2, 48, 64, 4) and rgb.dtype == np.uint8
    assert depth.shape == segmentation.shape == (2, 48, 64)
    assert depth.dtype == facing.pos.dtype and segmentation.dtype == np.int32
    assert (segmentation[0] == 2).any() and (segmentation[1] == 1).any()
    assert not (segmentation[0] == 1).any() and not (segmentation[1] == 2).any()


def test_looking_changes_nothing_in_flight():
    state, rpm = at([0, 0, 0.3]), np.full((1, 4), 14000.0)
    with bullet.make_step() as step:
        first = step(CRAZYFLIE, state, rpm)
        step.camera(CRAZYFLIE, at([1, 1, 1]))
        step.photo(CRAZYFLIE, at([1, 1, 1]), (0, 0, 2), (1, 1, 1))
        again = step(CRAZYFLIE, state, rpm)
    np.testing.assert_array_equal(first.pos, again.pos)


def golden_scene(recorded: list) -> tuple[Scene, np.ndarray]:
    """The stock bodies of a recorded scene, where they were recorded, and the segmentation label of each.

    The list of what was recorded has (id, name, pose) of each.
    """
    names = [name for _, name, _ in recorded]
    if "block_2" not in names:
        files = ["samurai.urdf", "duck_vhacd.urdf", "cube_no_rotation.urdf", "sphere2.urdf"]
        places = [(0, 0, 0), (-0.5, -0.5, 0.05), (-0.5, -2.5, 0.5), (0, 2, 0.5)]
    else:
        files = ["block.urdf", "cube_small.urdf", "duck_vhacd.urdf", "teddy_vhacd.urdf"]
        places = [(1, 0, 0.1), (0, 1, 0.1), (-1, 0, 0.1), (0, -1, 0.1)]
    bodies = [Urdf(pos=place, path=STOCK + file) for file, place in zip(files, places, strict=True)]
    if "architrave" in names:
        bodies.append(Box(pos=(0, -1, 0.55), size=(0.8, 0.05, 0.05)))
        for i in range((len(names) - 7) // 2):
            bodies += [Urdf(pos=(x, -1, 0.02 + 0.05 * i), path=STOCK + "cube_small.urdf") for x in (-0.3, 0.3)]
    bodies = [Urdf(pos=(0, 0, 0), path=STOCK + "plane.urdf"), *bodies]
    numbers = np.argsort(np.argsort([isinstance(body, Urdf) for body in bodies], kind="stable"))  # boxes come first
    return Scene.of(*bodies, ground=False), 2 + numbers


@pytest.mark.parametrize("name", golden_data.names(kind="vision"))
def test_recorded_pictures_agree(name):
    case = golden_data.load(name)
    camera = camera_2021
    assert (camera.aspect, camera.far) == (case.about["aspect"], case.about["far"])
    near = float(CRAZYFLIE.arm[0])
    assert near == pytest.approx(case.about["near"])
    scene, label = golden_scene(case.about["bodies"])
    with bullet.make_step(scene=scene) as step:
        for pos, quat, raw, bodies in zip(*(case.arrays[key] for key in ("pos", "quat", "depth", "seg")), strict=True):
            _, depth, segmentation = pictures(step, at(pos, quat))
            recorded = bodies & ((1 << 24) - 1)
            others = recorded != 1  # the recorded camera sees its own drone, body 1
            # recorded: plane 0, drone 1, obstacles from 2; here: drone 1, obstacles from 2, the plane among them
            labels = np.where(bodies < 0, -1, label[np.maximum(recorded - 1, 0) % len(label)])
            same = (labels == segmentation) & others
            assert same.sum() >= 0.97 * others.sum()
            metres = camera.far * near / (camera.far - (camera.far - near) * raw)
            solid = same & (bodies >= 0)
            assert np.median(np.abs(depth / metres - 1)[solid]) < 1e-3
            assert np.mean(np.abs(depth / metres - 1)[solid] < 0.01) > 0.97


def test_an_eye_inside_a_solid_sees_that_solid_as_near_as_it_can():
    camera = Camera(resolution=(8, 6), near=0.02)
    with bullet.make_step(
        scene=Scene.of(Sphere(pos=(0, 0, 3), radius=0.1), Box(pos=(0, 0, 1), size=(1, 1, 1)))
    ) as step:
        for place, label in ([0, 0, 1.0], 2), ([3, 0, -1.0], 0):
            _, depth, segmentation = pictures(step, at(place), camera)
            assert np.all(depth == 0.02) and np.all(segmentation == label)
        assert not np.all(pictures(step, at([3, 0, 1.0]), camera)[1] == 0.02)


def test_what_is_no_camera_is_refused():
    with bullet.make_step() as step, pytest.raises(ValueError, match=r"camera is 3; give .*jaxdrones\.Camera"):
        step.camera(CRAZYFLIE, at([0, 0, 1.0]), 3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "camera",
    [
        camera_2021,
        Camera(),
        Camera(offset=(0.05, -0.02, 0.1), orientation=(0, np.sin(0.2), 0, np.cos(0.2)), principal_point=(3.0, -2.0)),
        Camera(leveled=True, field_of_view=90.0, resolution=(48, 48), offset=(0, 0, 0.2), far=5.0),
    ],
    ids=["2021", "body", "mounted", "leveled"],
)
def test_bullet_sees_what_the_explicit_renderer_sees(camera):
    scene = Scene.of(
        Box(pos=(2.0, 0.6, 1.0), size=(0.4, 0.4, 0.8), quat=rotation.from_rpy(jnp.array([0.3, 0.2, 0.9]))),
        Sphere(pos=(3.0, -0.5, 1.4), radius=0.4),
        Cylinder(pos=(4.0, 1.5, 1.0), radius=0.3, height=2.0),
    )
    state = at([0.1, 0.2, 1.1], rotation.from_rpy(jnp.array([0.4, -0.1, 0.2])))
    with bullet.make_step(scene=scene) as step:
        _, depth, segmentation = pictures(step, state, camera)
    expected = render(scene, CRAZYFLIE, state, camera)
    same = segmentation == expected.segmentation[0]
    assert same.mean() > 0.97
    assert np.mean(np.abs(depth / np.asarray(expected.depth[0]) - 1)[same] < 0.01) > 0.98


def test_the_eye_is_one_arm_above_the_drone_and_world_up_stays_up():
    tilted = rotation.from_rpy(jnp.array([0.5, 0.0, 0.0]))
    with bullet.make_step() as step:
        level, rolled = (pictures(step, at([0, 0, 1.0], q))[1] for q in ([0, 0, 0, 1.0], tilted))
    np.testing.assert_allclose(level, rolled, rtol=1e-5)  # a roll about the viewing axis does not turn the picture
    steep = np.tan(np.radians(30)) * 23.5 / 24  # of the lowest row of pixels, below the horizon
    np.testing.assert_allclose(level[-1, 32], (1 + float(CRAZYFLIE.arm[0])) / steep, rtol=0.03)


def test_an_eye_that_is_off_the_plane_of_a_face_by_rounding_sees_all_the_same():
    """TinyRenderer does not return from such a picture; the face is at x = 0."""
    box = Box(pos=(-0.5, -2.5, 0.5), size=(1, 1, 1))
    with bullet.make_step(scene=Scene.of(box)) as step:
        exact = pictures(step, at([0, 0, 0.1]))[1]
        for x in (1e-17, 1e-9):
            np.testing.assert_array_equal(pictures(step, at([x, 0, 0.1]))[1], exact)

"""What the cameras see is what geometry says."""

import golden_data
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones
from jaxdrones import State, rotation
from jaxdrones.engine import bullet
from jaxdrones.sensing import Box, Scene, Sphere, Urdf

pytestmark = pytest.mark.needs("pybullet")

CRAZYFLIE = jaxdrones.repeat(jaxdrones.load_params("cf2x"), 1)
STOCK = pytest.importorskip("pybullet_data").getDataPath() + "/"


def at(pos, quat=(0.0, 0.0, 0.0, 1.0)) -> State:
    return State.at_rest(jnp.array([pos], float)).replace(quat=jnp.array([quat], float))


def test_a_coloured_box_in_front_is_seen_where_geometry_says():
    box = Box(pos=(2.0, 0.3, 1.0397), size=(0.4, 0.4, 0.4), color=(1.0, 0.0, 0.0, 1.0))
    with bullet.make_step(scene=Scene.of(box)) as step:
        rgb, depth, segmentation = (x[0] for x in step.camera(CRAZYFLIE, at([0, 0, 1.0])))
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


def test_the_camera_turns_with_the_drone():
    ball = Sphere(pos=(0.0, 2.0, 1.0), radius=0.3)
    with bullet.make_step(scene=Scene.of(ball)) as step:
        ahead = step.camera(CRAZYFLIE, at([0, 0, 1.0]))[2]
        left = step.camera(CRAZYFLIE, at([0, 0, 1.0], [0, 0, np.sin(np.pi / 4), np.cos(np.pi / 4)]))[2]
    assert not (ahead == 2).any() and (left == 2).sum() > 50


def test_a_team_sees_each_other_and_nobody_sees_itself():
    team = jaxdrones.repeat(jaxdrones.load_params("cf2x"), 2)
    facing = State.at_rest(jnp.array([[0.0, 0, 1], [0.5, 0, 1]]), yaw=jnp.array([0, jnp.pi]))
    with bullet.make_step() as step:
        rgb, depth, segmentation = step.camera(team, facing)
    assert rgb.shape == (2, 48, 64, 4) and rgb.dtype == np.uint8
    assert depth.shape == segmentation.shape == (2, 48, 64)
    assert depth.dtype == np.float32 and segmentation.dtype == np.int32
    assert (segmentation[0] == 2).any() and (segmentation[1] == 1).any()
    assert not (segmentation[0] == 1).any() and not (segmentation[1] == 2).any()


def test_raw_depth_and_metres_are_the_same_buffer():
    with bullet.make_step() as step:
        state = at([0, 0, 1.0])
        metres, raw = step.camera(CRAZYFLIE, state)[1], step.camera(CRAZYFLIE, state, raw_depth=True)[1]
    near, far = float(CRAZYFLIE.arm[0]), 1000.0
    np.testing.assert_allclose(metres, far * near / (far - (far - near) * raw.astype(float)), rtol=1e-6)
    assert 0 <= raw.min() and raw.max() <= 1


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
    camera = bullet.Camera(aspect=case.about["aspect"], near=case.about["near"], far=case.about["far"])
    scene, label = golden_scene(case.about["bodies"])
    with bullet.make_step(scene=scene) as step:
        for pos, quat, raw, bodies in zip(*(case.arrays[key] for key in ("pos", "quat", "depth", "seg")), strict=True):
            _, depth, segmentation = (x[0] for x in step.camera(CRAZYFLIE, at(pos, quat), camera))
            recorded = bodies & ((1 << 24) - 1)
            others = recorded != 1  # the recorded camera sees its own drone, body 1
            # recorded: plane 0, drone 1, obstacles from 2; here: drone 1, obstacles from 2, the plane among them
            labels = np.where(bodies < 0, -1, label[np.maximum(recorded - 1, 0) % len(label)])
            same = (labels == segmentation) & others
            assert same.sum() >= 0.97 * others.sum()
            metres = camera.far * camera.near / (camera.far - (camera.far - camera.near) * raw)
            solid = same & (bodies >= 0)
            assert np.median(np.abs(depth / metres - 1)[solid]) < 1e-3
            assert np.mean(np.abs(depth / metres - 1)[solid] < 0.01) > 0.97


def test_an_eye_inside_a_body_is_refused():
    with bullet.make_step(scene=Scene.of(Box(pos=(0, 0, 1), size=(1, 1, 1)))) as step:
        with pytest.raises(ValueError, match=r"camera of drone 0 is inside obstacle 0.*move the drone"):
            step.camera(CRAZYFLIE, at([0, 0, 1.0]))
        with pytest.raises(ValueError, match="inside the ground"):
            step.camera(CRAZYFLIE, at([3, 0, -1.0]))
        step.camera(CRAZYFLIE, at([3, 0, 1.0]))


@pytest.mark.parametrize(
    ("options", "message"),
    [(dict(width=0), "width is 0"), (dict(fov=180), "fov is 180"), (dict(far=-1), "far is -1")],
)
def test_a_wrong_camera_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        bullet.Camera(**options)


def test_the_eye_is_one_arm_above_the_drone_and_world_up_stays_up():
    tilted = rotation.from_rpy(jnp.array([0.5, 0.0, 0.0]))
    with bullet.make_step() as step:
        level, rolled = (step.camera(CRAZYFLIE, at([0, 0, 1.0], q))[1][0] for q in ([0, 0, 0, 1.0], tilted))
    np.testing.assert_allclose(level, rolled, rtol=1e-5)  # a roll about the viewing axis does not turn the picture
    steep = np.tan(np.radians(30)) * 23.5 / 24  # of the lowest row of pixels, below the horizon
    np.testing.assert_allclose(level[-1, 32], (1 + float(CRAZYFLIE.arm[0])) / steep, rtol=0.03)


def test_an_eye_that_is_off_the_plane_of_a_face_by_rounding_sees_all_the_same():
    """TinyRenderer does not return from such a picture; the face is at x = 0."""
    box = Box(pos=(-0.5, -2.5, 0.5), size=(1, 1, 1))
    with bullet.make_step(scene=Scene.of(box)) as step:
        exact = step.camera(CRAZYFLIE, at([0, 0, 0.1]))[1]
        for x in (1e-17, 1e-9):
            np.testing.assert_array_equal(step.camera(CRAZYFLIE, at([x, 0, 0.1]))[1], exact)

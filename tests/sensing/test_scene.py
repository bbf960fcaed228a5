import numpy as np
import pytest

from jaxdrones.sensing import scene
from jaxdrones.sensing.scene import Box, Cylinder, Mesh, Scene, Sphere, Urdf

QUARTER_TURN = (0.0, 0.0, np.sin(np.pi / 4), np.cos(np.pi / 4))  # about z


def test_a_gate_leaves_its_opening_free_and_closes_the_rest():
    beams = scene.gate((1.0, 2.0, 1.5), yaw=np.pi / 2, opening=0.4, frame=0.16)
    center = np.array([1.0, 2.0, 1.5])

    def blocked(left, up):  # left of someone who crosses along y is -x
        return any(scene.contains(beam, center + np.array([-left, 0, up])) for beam in beams)

    for left, up in (0, 0), (0.19, 0.19), (-0.19, 0), (0, -0.19):
        assert not blocked(left, up)
    for left, up in (0.21, 0), (-0.35, 0.1), (0.35, 0.35), (0, 0.3), (-0.3, -0.3):
        assert blocked(left, up)
    assert not blocked(0.37, 0)


def test_inside_is_inside_whatever_way_an_obstacle_is_turned():
    box = Box(pos=(0, 0, 1), quat=QUARTER_TURN, size=(2.0, 0.2, 0.2))
    assert scene.contains(box, (0, 0.9, 1)) and not scene.contains(box, (0.9, 0, 1))
    pole = Cylinder(pos=(0, 0, 1), quat=(np.sin(np.pi / 4), 0, 0, np.cos(np.pi / 4)), radius=0.1, height=2.0)
    assert scene.contains(pole, (0, 0.9, 1)) and not scene.contains(pole, (0, 0, 1.5))
    ball = Sphere(pos=(1, 1, 1), radius=0.5)
    assert scene.contains(ball, (1, 1.4, 1.2)) and not scene.contains(ball, (1, 1.4, 1.4))


def test_the_papers_obstacles_leave_the_paper_flights_their_room():
    for obstacle in scene.paper_obstacles().obstacles:
        for angle in np.linspace(0, 2 * np.pi, 60):
            place = [0.3 * np.cos(angle), 0.3 * np.sin(angle) - 0.3, 0.1]
            assert not scene.contains(obstacle, place)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Sphere(pos=(0, 0, 0), radius=0.0), "radius of Sphere is 0"),
        (lambda: Box(pos=(0, 0, 0), size=(1, -1, 1)), "size of Box is -1"),
        (lambda: Box(pos=(0, 0), size=(1, 1, 1)), "pos of Box is .*3 numbers"),
        (lambda: Cylinder(pos=(0, 0, np.nan), radius=1, height=1), "pos of Cylinder.*is not finite"),
        (lambda: Mesh(pos=(0, 0, 0), path="missing.obj"), r"missing\.obj: there is no such file"),
        (lambda: Urdf(pos=(0, 0, 0), path="missing.urdf"), r"missing\.urdf: there is no such file"),
        (lambda: Scene(("box",)), "'box' is not an obstacle"),
    ],
)
def test_a_wrong_obstacle_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()

"""A scene is data: it is built from single obstacles, mapped, drawn and read back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdrones.sensing import (
    Box,
    Capsule,
    Cylinder,
    Mesh,
    Scene,
    Sphere,
    Urdf,
    from_urdf,
    gate,
    obstacles_2021,
)
from jaxdrones.sensing.shapes import Obstacle

QUARTER_TURN = (0.0, 0.0, np.sin(np.pi / 4), np.cos(np.pi / 4))  # about z
BALL = Sphere(pos=(1, 1, 1), radius=0.5)
is_inside = jax.jit(Scene.contains)


def test_a_gate_leaves_its_opening_free_and_closes_the_rest():
    scene = Scene.of(gate((1.0, 2.0, 1.5), yaw=np.pi / 2, opening=0.4, frame=0.16))
    center = np.array([1.0, 2.0, 1.5])

    def blocked(left, up):  # left of someone who crosses along y is -x
        return is_inside(scene, center + np.array([-left, 0, up]))

    for left, up in (0, 0), (0.19, 0.19), (-0.19, 0), (0, -0.19):
        assert not blocked(left, up)
    for left, up in (0.21, 0), (-0.35, 0.1), (0.35, 0.35), (0, 0.3), (-0.3, -0.3):
        assert blocked(left, up)
    assert not blocked(0.37, 0)


class Door(Box):
    """A class of a user."""


def test_obstacles_of_a_kind_have_one_class_which_may_be_that_of_a_user():
    door, box = (kind(pos=(1.0, 0, 1), size=(0.1, 1.0, 2.0)) for kind in (Door, Box))
    beside = (0.0, -0.4, 1.0)  # nearer to the door than to the ball
    np.testing.assert_allclose(Scene.of(door, door, BALL).distance(beside), Scene.of(box).distance(beside), rtol=1e-12)
    with pytest.raises(ValueError, match="the boxes are of the classes Door and Box; give Box for all of them"):
        Scene.of(door, BALL, box)


@pytest.mark.slow
def test_inside_is_inside_whatever_way_an_obstacle_is_turned():
    box = Scene.of(Box(pos=(0, 0, 1), quat=QUARTER_TURN, size=(2.0, 0.2, 0.2)))
    assert is_inside(box, (0, 0.9, 1)) and not is_inside(box, (0.9, 0, 1))
    lying = (np.sin(np.pi / 4), 0, 0, np.cos(np.pi / 4))
    pole = Scene.of(Cylinder(pos=(0, 0, 1), quat=lying, radius=0.1, height=2.0))
    assert is_inside(pole, (0, 0.9, 1)) and not is_inside(pole, (0, 0, 1.5)) and not is_inside(pole, (0, 1.05, 1))
    pill = Scene.of(Capsule(pos=(0, 0, 1), quat=lying, radius=0.1, height=2.0))
    assert is_inside(pill, (0, 1.05, 1)) and not is_inside(pill, (0, 1.11, 1))
    ball = Scene.of(BALL)
    assert is_inside(ball, (1, 1.4, 1.2)) and not is_inside(ball, (1, 1.4, 1.4))
    assert is_inside(ball, (5, 5, -0.1)) and not is_inside(Scene.of(BALL, ground=False), (5, 5, -0.1))


def test_the_obstacles_of_2021_leave_its_flights_their_room():
    scene = obstacles_2021()
    angle = np.linspace(0, 2 * np.pi, 60)
    places = np.stack([0.3 * np.cos(angle), 0.3 * np.sin(angle) - 0.3, 0 * angle + 0.1], axis=-1)
    assert not jax.jit(jax.vmap(Scene.contains, (None, 0)))(scene, places).any()


def test_obstacles_are_numbered_kind_by_kind_and_a_kind_without_any_is_nothing(tmp_path):
    file = tmp_path / "rock.obj"
    file.write_text("")
    rock, pole = Mesh(pos=np.zeros(3), path=file), Cylinder(pos=(3, 0, 0), radius=1, height=2)
    scene = Scene.of(rock, BALL, Box(pos=(1, 2, 3), size=(1, 1, 1)), pole, Box(pos=(4, 5, 6), size=(1, 1, 1)))
    kinds = [type(obstacle) for obstacle in scene.obstacles]
    assert kinds == [Box, Box, Sphere, Cylinder, Mesh]
    np.testing.assert_array_equal(scene.obstacles[1].pos, [4, 5, 6])
    assert scene.boxes.pos.shape == (2, 3) and scene.boxes.color.shape == (2, 4) and scene.spheres.radius.shape == (1,)
    assert scene.capsules is None and scene.has_obstacles and Scene.of(rock).has_obstacles
    assert not Scene().has_obstacles and jax.tree.leaves(Scene()) == [] and Scene().obstacles == ()
    assert hash(jax.tree.structure(scene)) == hash(jax.tree.structure(scene))  # as jax.jit asks of static data


def test_many_obstacles_in_one_share_what_has_no_leading_axis():
    poles = np.array([[0, 0, 1], [1, 0, 1], [2, 0, 1.0]])
    together = Scene.of(Cylinder(pos=poles, radius=[0.1, 0.2, 0.3], height=2.0, color=(1, 0, 0, 1)), gate((5, 5, 1)))
    singles = [
        Cylinder(pos=p, radius=r, height=2.0, color=(1, 0, 0, 1)) for p, r in zip(poles, (0.1, 0.2, 0.3), strict=True)
    ]
    apart = Scene.of(gate((5, 5, 1)), *singles)
    jax.tree.map(np.testing.assert_array_equal, together, apart)
    assert len(together.obstacles) == 7
    assert not Scene.of(Sphere(pos=jnp.zeros((0, 3)), radius=1)).has_obstacles


@pytest.mark.slow
def test_a_scene_is_drawn_in_a_compiled_program_and_mapped():
    def drawn(key):
        pos = jax.random.uniform(key, (5, 3), minval=1.0, maxval=2.0)
        return Scene.of(jax.vmap(gate)(pos + 5.0, pos[:, 0]), Sphere(pos=pos, radius=0.1), ground=False)

    keys = jax.random.split(jax.random.key(0), 4)
    scenes, found = jax.jit(jax.vmap(lambda key: (drawn(key), drawn(key).distance(jnp.zeros(3)))))(keys)
    assert scenes.boxes.pos.shape == (4, 20, 3) and scenes.spheres.radius.shape == (4, 5)
    nearest = np.min(np.linalg.norm(scenes.spheres.pos, axis=2), axis=1) - 0.1  # the gates are farther away
    np.testing.assert_allclose(found, nearest, rtol=1e-12)
    np.testing.assert_allclose(jax.jit(jax.vmap(Scene.distance, (0, None)))(scenes, jnp.zeros(3)), nearest, rtol=1e-12)


@pytest.mark.slow
def test_worlds_with_different_numbers_of_obstacles_are_stacked_and_mapped():
    ball, box = BALL.replace(pos=(0.0, 0.0, 1.0)), Box(pos=(3, 0, 1), size=(1, 1, 1))
    scenes = [Scene.of(ground=False), Scene.of(ball, ground=False), Scene.of(box, ball, BALL, ground=False)]
    together = jax.tree.map(lambda *x: jnp.stack(x), *(scene.padded(boxes=1, spheres=3) for scene in scenes))
    for point in (0, 0, 1), (3, 0, 2):
        expected = [scene.distance(point) for scene in scenes]
        np.testing.assert_array_equal(jax.vmap(Scene.distance, (0, None))(together, jnp.array(point)), expected)
    assert together.spheres.active.tolist() == [[False] * 3, [True, False, False], [True, True, False]]


def test_what_a_single_obstacle_holds_as_numbers_is_mapped_as_an_array():
    boxes = jax.vmap(lambda x: Box(pos=(x, 2 * x, 0.5), size=(1.0, 2.0, 3.0)))(jnp.arange(3.0))
    assert boxes.size.shape == boxes.pos.shape == (3, 3) and boxes.quat.shape == (3, 4)
    np.testing.assert_array_equal(boxes.size[1], [1, 2, 3])
    np.testing.assert_array_equal(boxes.pos[1], [1, 2, 0.5])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Scene.of(Sphere(pos=(0, 0, 0), radius=0.0)), "radius of Sphere is 0"),
        (lambda: Scene.of(Box(pos=(0, 0, 0), size=(1, -1, 1))), r"size of Box is \[1.0, -1.0, 1.0\]; give positive"),
        (lambda: Scene.of(Box(pos=(0, 0), size=(1, 1, 1))), "pos of Box is .*3 numbers"),
        (lambda: Scene.of(Cylinder(pos=(0, 0, np.nan), radius=1, height=1)), "pos of Cylinder.*is not finite"),
        (lambda: Scene.of(Sphere(pos=(0, 0, 0), quat=(0, 0, 0, 2), radius=1)), "quat of Sphere has length 2"),
        (lambda: Scene.of(Sphere(pos=np.zeros((3, 3)), radius=[1, 2])), r"do not fit together: pos \(3, 3\)"),
        (lambda: Mesh(pos=(0, 0, 0), path="missing.obj"), r"missing\.obj: there is no such file"),
        (lambda: Urdf(pos=(0, 0, 0), path="missing.urdf"), r"missing\.urdf: there is no such file"),
        (lambda: Urdf(pos=(0, 0), path="missing.urdf"), r"pos of Urdf has shape \(2,\); expected \(3,\)"),
        (lambda: Scene.of(Sphere(pos=(0, 0, 0), quat=(0, 0, 0, 0), radius=1)), "quat of Sphere has length 0"),
        (lambda: Scene.of(BALL.replace(active=0.5)), "active of Sphere is 0.5; give True or False"),
        (lambda: Scene.of(BALL, BALL).padded(spheres=1), "has 2 spheres and the array holds 1; give spheres=2 or more"),
        (lambda: Scene.of(BALL).padded(balls=1), "unknown kind of obstacles 'balls'"),
        (lambda: Scene.of("box"), "'box' is not an obstacle"),
        (
            lambda: Scene.of(Obstacle(pos=(0, 0, 0))),
            "Obstacle.* is not an obstacle of a known kind; give .*: Box, Sphere",
        ),
        (lambda: Scene.of((BALL, BALL)), "give each as its own argument"),
        (lambda: Scene.of(BALL, ground=3), "ground is 3; give True or False"),
        (lambda: gate((0, 0, 1), opening=-1), "opening of a gate is -1; give a positive number"),
        (lambda: gate(np.zeros((2, 3))), r"pos of a gate has shape \(2, 3\).*jax\.vmap"),
    ],
)
def test_a_wrong_obstacle_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


CUBE = "v -1 -2 0\nv 1 2 3\nf 1 2 1\n"


def test_the_bounding_box_of_a_mesh_holds_its_points_whatever_way_it_is_turned(tmp_path):
    obj, text, binary = tmp_path / "a.obj", tmp_path / "b.stl", tmp_path / "c.STL"
    obj.write_text(CUBE)
    text.write_text("solid\nouter loop\n vertex -1 -2 0\n vertex 1 2 3\n vertex 0 0 0\nendloop\n")
    corners = np.array([0, 0, 1, -1, -2, 0, 1, 2, 3, 0, 0, 0], "<f4")
    binary.write_bytes(bytes(80) + (1).to_bytes(4, "little") + corners.tobytes() + bytes(2))
    for file in obj, text, binary:
        box = Mesh(path=file, pos=(1, 0, 0), quat=QUARTER_TURN, scale=0.5).bounding_box()
        np.testing.assert_allclose(box.size, [1, 2, 1.5])
        np.testing.assert_allclose(box.pos, [1, 0, 0.75], atol=1e-12)
        scene = Scene.of(box)
        assert is_inside(scene, (1.9, 0.4, 1.4)) and not is_inside(scene, (1.4, 0.9, 1.4))
    empty, other = tmp_path / "d.obj", tmp_path / "e.dae"
    for file, message in (empty, "holds no points"), (other, r"\.dae file is not known; give an \.obj or \.stl"):
        file.write_text("")
        with pytest.raises(ValueError, match=message):
            Mesh(path=file, pos=(0, 0, 0)).bounding_box()
    with pytest.raises(ValueError, match=r"the scene has a Mesh, .* mesh\.bounding_box\(\) in its place"):
        Scene.of(Mesh(path=obj, pos=(0, 0, 0))).distance((0, 0, 1))


ARM = """<robot name="arm">
  <material name="red"><color rgba="1 0 0 1"/></material>
  <link name="base"><visual><material name="red"/></visual>
    <collision><origin xyz="0 0 0.5"/><geometry><box size="1 1 1"/></geometry></collision></link>
  <link name="tip">
    <collision><origin xyz="0 0 1" rpy="1.5707963 0 0"/>
      <geometry><cylinder radius="0.1" length="2"/></geometry></collision>
    <collision><origin xyz="0.5 0 0"/><geometry><sphere radius="0.2"/></geometry></collision>
    <collision><geometry><capsule radius="0.1" length="1"/></geometry></collision>
    <collision><geometry><mesh filename="a.obj" scale="2 2 2"/></geometry></collision></link>
  <joint name="j" type="revolute"><parent link="base"/><child link="tip"/>
    <origin xyz="0 0 1" rpy="0 0 1.5707963"/></joint>
</robot>"""


def test_links_with_colors_of_their_own_have_these(tmp_path):
    """Materials without a name, and one whose name has another color elsewhere in the file."""
    materials = ['<material><color rgba="1 0 0 1"/></material>', '<material><color rgba="0 1 0 1"/></material>']
    materials += [f'<material name="paint"><color rgba="{x} 0 1 1"/></material>' for x in (0.5, 0.25)]
    shape = '<collision><geometry><sphere radius="1"/></geometry></collision>'
    links = [f'<link name="{i}"><visual>{x}</visual>{shape}</link>' for i, x in enumerate(materials)]
    joints = [f'<joint name="j{i}"><parent link="0"/><child link="{i}"/></joint>' for i in range(1, len(links))]
    (tmp_path / "a.urdf").write_text(f'<robot name="a">{"".join(links + joints)}</robot>')
    colors = np.asarray(from_urdf(tmp_path / "a.urdf").spheres.color)
    np.testing.assert_array_equal(colors, [[1, 0, 0, 1], [0, 1, 0, 1], [0.5, 0, 1, 1], [0.25, 0, 1, 1]])


def test_a_scene_from_a_urdf_has_its_shapes_where_its_links_are(tmp_path):
    (tmp_path / "a.obj").write_text(CUBE)
    file = tmp_path / "arm.urdf"
    file.write_text(ARM)
    scene = from_urdf(file, pos=(5, 0, 0), ground=False)
    assert [type(solid) for solid in scene.obstacles] == [Box, Sphere, Cylinder, Capsule, Mesh]
    assert scene.boxes.color[0].tolist() == [1, 0, 0, 1]
    np.testing.assert_allclose(scene.boxes.pos[0], [5, 0, 0.5])
    np.testing.assert_allclose(scene.cylinders.pos[0], [5, 0, 2], atol=1e-6)
    np.testing.assert_allclose(scene.spheres.pos[0], [5, 0.5, 1], atol=1e-6)
    without = scene.replace(meshes=())
    assert is_inside(without, (5.9, 0, 2)) and not is_inside(without, (5, 0.9, 2))  # the cylinder lies along x
    assert scene.meshes[0].scale == 2 and scene.meshes[0].pos == pytest.approx((5, 0, 1))
    turned = from_urdf(file, quat=QUARTER_TURN).replace(meshes=())
    np.testing.assert_allclose(turned.spheres.pos[0], [-0.5, 0, 1], atol=1e-6)
    assert turned.ground and is_inside(turned, (0, 0.9, 2)) and not is_inside(turned, (0.9, 0, 2))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("sphere", "torus", "a collision has the shape <torus>; give box"),
        ('size="1 1 1"', 'size="1 1"', r"size of <box> is '1 1'; give 3 numbers"),
        ('radius="0.2"', 'radius="-1"', "radius of Sphere is -1"),
        ('scale="2 2 2"', 'scale="2 2 1"', "give the same number along each axis"),
        ('child link="tip"', 'child link="nose"', "joint 'j' connects .*nose"),
        ('parent link="base"', 'parent link="tip"', "circle of tip"),
        ("</robot>", "", "it is not XML"),
        ("a.obj", "b.obj", r"b\.obj: there is no such file"),
    ],
)
def test_a_wrong_urdf_is_refused(tmp_path, old, new, message):
    (tmp_path / "a.obj").write_text(CUBE)
    file = tmp_path / "arm.urdf"
    file.write_text(ARM.replace(old, new))
    with pytest.raises(ValueError, match=message):
        from_urdf(file)


def test_a_scene_can_be_rebuilt_with_anything_in_place_of_its_arrays():
    """As JAX and its libraries do: of shapes and types, of placeholders, of nothing."""
    scene = Scene.of(Box(pos=(0.0, 0.0, 1.0), size=(1.0, 1.0, 1.0)), Sphere(pos=(0.0, 1.0, 1.0), radius=0.5))
    described = jax.tree.map(lambda x: (x.shape, x.dtype), scene)
    assert described.boxes.pos == ((1, 3), scene.boxes.pos.dtype)
    assert described == jax.tree.map(lambda x: (x.shape, x.dtype), scene)
    nothing = jax.tree.map(lambda x: None, scene)
    assert nothing.boxes.pos is None and nothing.spheres.radius is None

"""Bundled vehicles against the constants recorded from gym-pybullet-drones, and files that are wrong."""

import re

import golden_data
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import VEHICLES, assert_close, assert_finite

import jaxdrones
from jaxdrones import assets
from jaxdrones.urdf_writer import to_urdf

RTOL = 1e-12

# The paper's cf2x is a mirror image of today's, and only the paper has an hb.
RECORDED = golden_data.names(variant="main", vehicle=VEHICLES, vehicle_constants=bool)
RECORDED_HB = golden_data.names(variant="paper", vehicle="hb", vehicle_constants=bool)


@pytest.mark.parametrize("name", [*RECORDED, *RECORDED_HB])
def test_constants_are_the_recorded_ones(name):
    case = golden_data.load(name)
    vehicle, recorded = case.about["vehicle"], case.constants
    params = jaxdrones.load_params(vehicle)
    pairs = {
        "m": params.mass,
        "J_urdf": params.inertia,
        "kf": params.kf,
        "km": params.km,
        "g": params.gravity,
        "hover_rpm": params.hover_rpm,
        "max_rpm": params.max_rpm,
        "max_thrust": params.max_thrust,
        "max_z_torque": params.max_z_torque,
        "gnd_eff_coeff": params.ground_effect_coeff,
        "drag_coeff": params.drag_coeff,
        "dw_coeff": params.downwash_coeff,
        "max_speed_kmh": params.max_speed * 3.6,
        "collision_r": params.collision_radius,
        "collision_h": params.collision_height,
        "collision_z_offset": params.collision_offset,
    }
    if vehicle != "hb":  # gym-pybullet-drones gives its hb propellers no size
        # Of the racer the diameter is recorded as the radius.
        pairs["prop_radius"] = params.prop_radius * (2 if vehicle == "racer" else 1)
    for key, value in pairs.items():
        np.testing.assert_allclose(value, recorded[key], rtol=RTOL, err_msg=key)


@pytest.mark.parametrize("name", [*RECORDED, *RECORDED_HB])
def test_rotors_are_where_gym_pybullet_drones_has_them(name):
    """To 0.3 %: gym-pybullet-drones rounds those of the cf2x to millimetres. The racer has an arm of its own."""
    case = golden_data.load(name)
    rotor_pos = jaxdrones.load_params(case.about["vehicle"]).rotor_pos
    np.testing.assert_allclose(rotor_pos, case.constants["rotor_positions"], rtol=0.003, atol=0)
    if case.about["vehicle"] != "racer":
        np.testing.assert_allclose(np.linalg.norm(rotor_pos, axis=1), case.constants["arm"], rtol=1e-9)


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_neighboring_rotors_turn_opposite_ways(vehicle):
    params = jaxdrones.load_params(vehicle)
    around = np.argsort(np.arctan2(*np.asarray(params.rotor_pos)[:, :2].T))
    spin = np.asarray(params.rotor_spin)[around]
    np.testing.assert_array_equal(spin, -np.roll(spin, 1))


def test_a_path_and_a_name_load_the_same():
    assert_close(jaxdrones.load_params(assets.folder() / "racer.urdf"), jaxdrones.load_params("racer"), atol=0)


@pytest.mark.float32
def test_constants_have_the_default_precision():
    assert {leaf.dtype for leaf in jax.tree.leaves(jaxdrones.load_params("cf2x"))} == {np.dtype("float32")}


def test_an_unknown_vehicle_lists_the_known_ones():
    with pytest.raises(
        ValueError, match=r"unknown vehicle 'cf3x'; did you mean 'cf2x'.*cf2p, cf2x, hb, hummingbird, racer"
    ):
        jaxdrones.load_params("cf3x")


def test_a_folder_of_a_fit_names_the_vehicle_in_it(tmp_path, monkeypatch):
    for folder in "fit", "cf2x":
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "vehicle.urdf").write_text("")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"vehicle is the folder 'fit'; give the file, 'fit/vehicle\.urdf'"):
        jaxdrones.load_params("fit")
    assert jaxdrones.load_params("cf2x")  # a name of a bundled vehicle comes first


def test_a_team_is_no_vehicle_to_write():
    with pytest.raises(ValueError, match=r"params.mass has shape \(2,\); expected \(\): to_urdf writes a single drone"):
        to_urdf(jaxdrones.repeat(jaxdrones.load_params("cf2x"), 2), "team")


def test_a_missing_file_says_what_to_give(tmp_path):
    with pytest.raises(ValueError, match=r"nowhere\.urdf.*cannot be read.*path of a URDF"):
        jaxdrones.load_params(tmp_path / "nowhere.urdf")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</robot>", "", r"broken\.urdf: is not well-formed XML"),
        ("<properties", "<other", r"<properties> lacks 'kf' \(thrust coefficient.*tag is missing"),
        ('kf="3.16e-10"', "", r"<properties> lacks 'kf' \(thrust coefficient, N/RPM\^2\); found km,"),
        (
            'kf="3.16e-10"\n    km="7.94e-12"',
            "",
            r"lacks 'kf' \(thrust.*, 'km' \(torque coefficient, N m/RPM\^2\); found ",
        ),
        ('kf="3.16e-10"', 'kf="much"', r'kf="much".*not a list of numbers; give 1'),
        ('kf="3.16e-10"', 'kf="-1e-10"', r'kf="-1e-10".*should be positive'),
        ('kf="3.16e-10"', 'kf="nan"', r'kf="nan".*1 finite number'),
        ('rotor_spin="-1 1 -1 1"', 'rotor_spin="-1 1 -1"', r'rotor_spin="-1 1 -1".*4 finite number'),
        ('rotor_spin="-1 1 -1 1"', 'rotor_spin="-1 1 -1 0"', r"rotor_spin.*\+1 or -1 each"),
        ('<mass value="0.027"/>', "", r"inertial/mass> lacks 'value' \(mass, kg\); the tag is missing"),
        ('value="0.027"', 'value="0"', r'value="0" \(mass, kg\) should be positive'),
        ('ixx="1.4e-5"', "", r"lacks 'ixx' \(moment of inertia"),
        ('ixy="0"', 'ixy="1e-6"', r"ixy is not zero; turn the body axes"),
        ('name="rotor2"', 'name="tail"', r"rotor2.*lacks 'xyz' \(position of rotor 2, m\)"),
        ('name="base_link"', 'name="body"', r"base_link.*lacks 'value' \(mass"),
        ('kf="3.16e-10"', 'kf="1e-50"', r'kf="1e-50".*should be 1e-20 to 1'),
        ('kf="3.16e-10"', 'kf="1e50"', r'kf="1e50".*should be 1e-20 to 1'),
        ('kf="3.16e-10"', 'kf="1e-19"', r"highest rotor speed of 1.22e\+09 RPM; expected 10 to 1e\+06"),
        (
            'kf="3.16e-10"',
            'kf="2.88e-8"',
            r"coefficient of 18.5 and a hover at 1516 RPM; .* N/RPM\^2, which is 0.010966 times that in",
        ),
        ('prop_radius="0.0231348"', 'prop_radius="2.3"', r"kf and prop_radius make .*; give prop_radius in m"),
        ('km="7.94e-12"', 'km="1_0"', r'km="1_0".*is not a list of numbers'),
        ('kf="3.16e-10"', f'kf="{"9" * 999}"', r"kf=\"9{100,}\.*.* should be 1 finite"),
        ('thrust2weight="2.25"', 'thrust2weight="0.9"', r"thrust2weight is 0.9, with which a drone cannot hover; give"),
        ('thrust2weight="2.25"', 'thrust2weight="1"', r"thrust2weight is 1, with which a drone cannot hover"),
        ('rotor_fall_time="0.249"', 'rotor_fall_time="1e-4"', r"rotor_fall_time.* should be 0.0025 to 10"),
        ('drag_coeff="9.1785e-7', 'drag_coeff="-9.1785e-7', r"drag_coeff.* should be 0 to 1"),
        (
            'drag_coeff="9.1785e-7',
            'drag_coeff="0.01',
            r"drag takes 3.37e\+03 of the speed per second; expected at most",
        ),
        ('rotor_spin="-1 1 -1 1"', 'rotor_spin="1 1 1 1"', r"spin in hover; give two rotors each direction"),
        ('rotor_spin="-1 1 -1 1"', 'rotor_spin="1 1 -1 1"', r'rotor_spin="1 1 -1 1" makes the drone spin'),
        ('rotor_spin="-1 1 -1 1"', 'rotor_spin="1 1 -1 -1"', r"cannot rotate the drone about every axis; place them"),
        (
            'izz="2.17e-5"',
            'izz="2.9e-5"',
            r"moments of inertia \[1.4e-05, .* are impossible for a rigid body; give moments of at most",
        ),
        ('ixx="1.4e-5"', 'ixx="1.4e-8"', r"are impossible for a rigid body"),
        (
            'ixx="1.4e-5" ixy="0" ixz="0" iyy="1.4e-5" iyz="0" izz="2.17e-5"',
            'ixx="9" iyy="9" izz="9"',
            r"in roll by up to",
        ),
        ('xyz="0.028072139213105935 -', 'xyz="0.09 -', r"centered on \(0.0155, 0\) m and tumble it by .* center them"),
        ('length="0.025"/></geometry> <!--', 'length="-1"/></geometry> <!--', r'length="-1".*should be positive'),
        ('name="rotor2"', 'name="rotor1"', r"<joint\[@name='rotor1'\]> of .* occurs 2 times; leave one"),
        ("  <properties", "  <properties/><properties", r"<properties> of <properties> occurs 2 times; leave one"),
        ("  <inertial>", "<inertial/><inertial>", r"<inertial> of .* occurs 2 times; leave one"),
        ('  <link name="prop0"/>', '<link name="base_link"/>', r"<link\[@name='base_link'\]> of .* occurs 2 times"),
        ('  <link name="prop0"/>', '<joint name="rotor4"/>', r"has a joint 'rotor4'; give only the rotors"),
        (
            '<link name="prop0"/>',
            '<link name="prop0"><inertial><mass value="0.001"/></inertial></link>',
            r"the link 'prop0' has a mass, 0.001 kg; add it",
        ),
        (
            '<child link="prop0"/>\n    <origin',
            '<origin rpy="0.1 0 0"',
            r"rpy is \[0.1, 0.0, 0.0\]; rotors push along body z",
        ),
        (
            '<parent link="base_link"/>\n    <child link="prop0"',
            '<parent link="arm"/><child link="prop0"',
            r"is attached to 'arm'",
        ),
        (
            '<inertial>\n      <origin xyz="0 0 0"/>',
            '<inertial><origin xyz="0 0 1"/>',
            r"xyz is .*; put the origin of base_link",
        ),
        (
            '<inertial>\n      <origin xyz="0 0 0"/>',
            '<inertial><origin rpy="0 1 0"/>',
            r"rpy is .*; turn the body axes",
        ),
        (
            '<collision>\n      <origin xyz="0 0 0"/>',
            '<collision><origin xyz="1 0 0"/>',
            r"xyz is .*; center the cylinder",
        ),
        (
            '<collision>\n      <origin xyz="0 0 0"/>',
            '<collision><origin rpy="1 0 0"/>',
            r"rpy is .*; the cylinder must be",
        ),
        ('robot name="cf2x"', 'sdf name="cf2x"', r"is not well-formed XML"),
        ("kf=", "&lots;kf=", r"is not well-formed XML"),
        ('"30"', '"&lots;"', r"is not well-formed XML \(undefined entity"),
    ],
    ids=str,
)
def test_a_wrong_urdf_says_where_and_what(tmp_path, old, new, message):
    text = (assets.folder() / "cf2x.urdf").read_text()
    assert old in text
    path = tmp_path / "broken.urdf"
    path.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=f"(?s){message}") as error:
        jaxdrones.load_params(path)
    assert "broken.urdf" in str(error.value)


ENTITIES = "".join(f'<!ENTITY a{i + 1} "{f"&a{i};" * 10}">' for i in range(12))
BOMB = f'<!DOCTYPE r [<!ENTITY a0 "lots">{ENTITIES}]><robot name="&a12;"/>'


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is not well-formed XML"),
        (bytes(range(256)) * 40, "is not well-formed XML"),
        (b"\x89PNG\r\n\x1a\n" + bytes(1000), "is not well-formed XML"),
        ("<robot name='é'/>".encode("latin-1"), "is not well-formed XML"),
        (
            b'<?xml version="1.0" encoding="foo"?><robot/>',
            r"cannot be read \(unknown encoding: foo\); save it as UTF-8",
        ),
        (b'<?xml version="1.0" encoding="utf-7"?><robot/>', "cannot be read .*save it as UTF-8|not well-formed"),
        (b'<?xml version="1.0" encoding="big5"?><robot/>', "cannot be read .*save it as UTF-8"),
        (b"<sdf/>", r"is not a URDF, its root is <sdf>; give a file with <robot>"),
        (b'<!DOCTYPE r [<!ENTITY a SYSTEM "file:///etc/passwd">]><robot>&a;</robot>', "undefined entity"),
        (BOMB.encode(), "is not well-formed XML"),
    ],
    ids=range(10),
)
def test_a_file_that_is_no_urdf_is_named(tmp_path, content, message):
    path = tmp_path / "broken.urdf"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"broken\.urdf: .*{message}"):
        jaxdrones.load_params(path)


def test_a_folder_and_a_name_that_no_file_has_are_named(tmp_path):
    (tmp_path / "folder.urdf").mkdir()
    for path in (tmp_path / "folder.urdf", "a\0b.urdf", "x" * 5000 + ".urdf"):
        with pytest.raises(ValueError, match=r"cannot be read"):
            jaxdrones.load_params(path)


NUMBER = re.compile(r'(?<=[" ])-?\d+\.?\d*(?:e-?\d+)?(?=[" ])')
VALUES = ("0", "-1", "1", "1e-50", "1e50", "1e-5", "1e5", "nan", "-inf", "", "abc", "1 2", "0.05", "3")


def mutations(text):
    """Every number replaced by others, every line left out or doubled, bytes that flip, and ends that are missing."""
    for match in NUMBER.finditer(text):
        yield from (text[: match.start()] + value + text[match.end() :] for value in VALUES)
    lines = text.split("\n")
    for i in range(len(lines)):
        yield "\n".join(lines[:i] + lines[i + 1 :])
        yield "\n".join([*lines[: i + 1], *lines[i:]])
    rng = np.random.default_rng(0)
    for _ in range(100):
        flipped = np.frombuffer(text.encode(), np.uint8).copy()
        flipped[rng.integers(len(flipped), size=2)] = rng.integers(256, size=2)
        yield flipped.tobytes()
        yield text[: rng.integers(len(text))]


@jax.jit
def hovered(params):
    """A team after a second at hover speed, and one that starts with its rotors at rest."""
    team = jaxdrones.repeat(params, 1)
    rpm = jnp.broadcast_to(team.hover_rpm[:, None], (1, 4))
    start = jaxdrones.State.at_rest([[0.0, 0, 1]])
    step = jaxdrones.make_step((jaxdrones.drag, jaxdrones.ground_effect), rotors=jaxdrones.lagging_rotors)
    fly = jax.vmap(
        lambda rpms: jaxdrones.rollout(step, lambda *_: (None, rpm), team, start.replace(rpm=rpms), None, 240)[0]
    )
    return fly(jnp.stack([rpm, 0 * rpm]))


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.parametrize("vehicle", ["cf2x", "racer"])
def test_whatever_is_changed_in_a_urdf_it_flies_or_one_line_says_why_not(tmp_path, vehicle):
    path, flown = tmp_path / "changed.urdf", 0
    for changed in mutations((assets.folder() / f"{vehicle}.urdf").read_text()):
        path.write_bytes(changed if isinstance(changed, bytes) else changed.encode())
        try:
            params = jaxdrones.load_params(path)
        except ValueError as error:
            assert "changed.urdf" in str(error) and "\n" not in str(error) and len(str(error)) < 700
        else:
            assert_finite(hovered(params))
            flown += 1
    assert flown > 100

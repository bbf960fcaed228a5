"""Bundled vehicles against the constants recorded from the reference, and files that are wrong."""

import golden_data
import numpy as np
import pytest
from helpers import VEHICLES, assert_close

import jaxdrones
from jaxdrones import assets

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
    if vehicle != "hb":  # the reference gives its hb propellers no size
        pairs["prop_radius"] = params.prop_radius
    for key, value in pairs.items():
        np.testing.assert_allclose(value, recorded[key], rtol=RTOL, err_msg=key)


@pytest.mark.parametrize("name", [*RECORDED, *RECORDED_HB])
def test_rotors_are_where_the_reference_has_them(name):
    """To 0.3 %: the reference rounds the rotor positions of the cf2x to millimetres. The racer's arm is another's."""
    case = golden_data.load(name)
    rotor_pos = jaxdrones.load_params(case.about["vehicle"]).rotor_pos
    np.testing.assert_allclose(rotor_pos, case.constants["rotor_positions"], rtol=0.003, atol=0)
    if case.about["vehicle"] != "racer":
        np.testing.assert_allclose(np.linalg.norm(rotor_pos, axis=1), case.constants["arm"], rtol=1e-9)


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_neighbouring_rotors_turn_opposite_ways(vehicle):
    params = jaxdrones.load_params(vehicle)
    around = np.argsort(np.arctan2(*np.asarray(params.rotor_pos)[:, :2].T))
    spin = np.asarray(params.rotor_spin)[around]
    np.testing.assert_array_equal(spin, -np.roll(spin, 1))


def test_a_path_and_a_name_load_the_same():
    assert_close(jaxdrones.load_params(assets.folder() / "racer.urdf"), jaxdrones.load_params("racer"), atol=0)


@pytest.mark.float32
def test_constants_have_the_default_precision():
    assert {leaf.dtype for leaf in vars(jaxdrones.load_params("cf2x")).values()} == {np.dtype("float32")}


def test_an_unknown_vehicle_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"unknown vehicle 'cf3x'; did you mean 'cf2x'.*cf2p, cf2x, hb, racer"):
        jaxdrones.load_params("cf3x")


def test_a_missing_file_says_what_to_give(tmp_path):
    with pytest.raises(ValueError, match=r"nowhere\.urdf.*cannot be read.*path of a URDF"):
        jaxdrones.load_params(tmp_path / "nowhere.urdf")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</robot>", "", r"broken\.urdf: is not well-formed XML"),
        ("<properties", "<other", r"<properties> lacks 'kf' \(thrust coefficient.*tag is missing"),
        ('kf="3.16e-10"', "", r"<properties> lacks 'kf' \(thrust coefficient, N/RPM\^2\); found km,"),
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
    ],
)
def test_a_wrong_urdf_says_where_and_what(tmp_path, old, new, message):
    text = (assets.folder() / "cf2x.urdf").read_text()
    assert old in text
    path = tmp_path / "broken.urdf"
    path.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=f"(?s){message}") as error:
        jaxdrones.load_params(path)
    assert "broken.urdf" in str(error.value)

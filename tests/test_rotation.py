"""Quaternions against scipy, against recorded conversions, and smooth where formulas tend to break."""

import re

import golden_data
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_optimized, jit_unoptimized, name_of
from scipy.spatial.transform import Rotation

import jaxdrones as jd
from jaxdrones import rotation, vector

ROUND_OFF = 1e-14  # a dozen float64 operations on numbers of order one

quats = Rotation.random(50, rng=0).as_quat()
others = Rotation.random(50, rng=1).as_quat()
vectors = np.random.default_rng(2).normal(size=(50, 3))


def each(function, *arrays):
    return np.asarray(jax.jit(jax.vmap(function))(*map(jnp.asarray, arrays)))


def up_to_sign(quat):
    return quat * np.sign(quat[:, 3:])


def test_rotate_turns_body_vectors_into_the_world():
    expected = Rotation.from_quat(quats).apply(vectors)
    np.testing.assert_allclose(each(rotation.rotate, quats, vectors), expected, atol=ROUND_OFF)


def test_rotate_inverse_undoes_rotate():
    turned = each(rotation.rotate, quats, vectors)
    np.testing.assert_allclose(each(rotation.rotate_inverse, quats, turned), vectors, atol=ROUND_OFF)


def test_a_product_rotates_by_its_right_factor_first():
    expected = (Rotation.from_quat(quats) * Rotation.from_quat(others)).apply(vectors)
    product = each(rotation.multiply, quats, others)
    np.testing.assert_allclose(each(rotation.rotate, product, vectors), expected, atol=ROUND_OFF)


def test_the_matrix_is_the_rotation():
    np.testing.assert_allclose(each(rotation.to_matrix, quats), Rotation.from_quat(quats).as_matrix(), atol=ROUND_OFF)


def test_the_z_axis_is_the_last_column_of_the_matrix():
    columns = Rotation.from_quat(quats).as_matrix()[:, :, 2]
    np.testing.assert_allclose(each(rotation.z_axis, quats), columns, atol=ROUND_OFF)


def test_cross_is_the_vector_product():
    a, b = vectors[:25], vectors[25:]
    np.testing.assert_allclose(each(vector.cross, a, b), np.cross(a, b), atol=ROUND_OFF)


@pytest.mark.parametrize("name", ["conjugate", "normalize", "log", "z_axis", "to_matrix", "to_rpy", "exp", "from_rpy"])
def test_a_batch_is_an_error_also_where_its_rows_could_pass_for_components(name):
    batch = jnp.array(vectors[:3] if name in ("exp", "from_rpy") else quats[:4])
    with pytest.raises(ValueError, match=re.escape(f"shape {batch.shape}; expected ({len(batch)},); use jax.vmap")):
        getattr(rotation, name)(batch)


def test_normalize_gives_unit_length_and_keeps_the_direction():
    np.testing.assert_allclose(each(rotation.normalize, 3 * quats), quats, atol=ROUND_OFF)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.1, 2.0, np.pi, 3.2, 2 * np.pi, 9.0, 15.7, 30.0])
def test_exp_is_the_rotation_by_the_length_of_a_vector_about_it(angle):
    axes = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    expected = np.hstack([axes * np.sin(angle / 2), np.full((len(axes), 1), np.cos(angle / 2))])
    np.testing.assert_allclose(each(rotation.exp, angle * axes), expected, rtol=0, atol=1e-15 * max(1, angle))
    if angle <= np.pi:
        np.testing.assert_allclose(each(rotation.exp_half_turn, angle * axes), expected, rtol=0, atol=1e-15)


@pytest.mark.float32
@pytest.mark.parametrize("exp", [rotation.exp, rotation.exp_half_turn], ids=name_of)
def test_exp_is_exact_in_float32(exp):
    angles = np.linspace(0, np.pi, 1000)[:, None].astype(np.float32)
    turned = jax.jit(jax.vmap(exp))(jnp.pad(angles, ((0, 0), (0, 2))))
    assert turned.dtype == jnp.float32
    half = angles.astype(float) / 2
    expected = np.hstack([np.sin(half), 0 * half, 0 * half, np.cos(half)])
    np.testing.assert_allclose(turned, expected, rtol=0, atol=2e-7)


def test_exp_is_smooth_at_zero():
    rate = np.vstack([np.eye(3) / 2, np.zeros(3)])
    np.testing.assert_array_equal(jax.jit(jax.jacobian(rotation.exp))(jnp.zeros(3)), rate)
    curvature = jax.jit(jax.hessian(rotation.exp))(jnp.zeros(3))  # cos(|v|/2) = 1 - |v|^2/8, the rest is odd
    np.testing.assert_allclose(curvature, np.concatenate([np.zeros((3, 3, 3)), -np.eye(3)[None] / 4]), rtol=3e-16)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 2e-3, 0.1, 2.0, 3.1])
def test_log_is_the_inverse_of_exp(angle):
    turns = angle * vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    quat = each(rotation.exp, turns)
    for sign in 1, -1:
        np.testing.assert_allclose(each(rotation.log, sign * quat), turns, rtol=0, atol=2e-14)


def test_log_is_smooth_at_zero():
    through = jax.jit(jax.jacobian(lambda turn: rotation.log(rotation.exp(turn))))
    for angle in 0.0, 1e-4, 1e-2:
        np.testing.assert_allclose(through(jnp.array([angle, 0, 0])), np.eye(3), atol=1e-12)


def test_roll_pitch_yaw_come_back():
    rpy = np.random.default_rng(3).uniform([-3.1, -1.5, -3.1], [3.1, 1.5, 3.1], (50, 3))
    np.testing.assert_allclose(each(rotation.to_rpy, each(rotation.from_rpy, rpy)), rpy, atol=1e-12)


@pytest.mark.parametrize("name", golden_data.names("euler_intrinsic_xyz"))
def test_conversions_agree_with_recorded_ones(name):
    recorded = golden_data.load(name).arrays
    np.testing.assert_allclose(each(rotation.to_matrix, recorded["quat"]), recorded["rot"], atol=ROUND_OFF)
    np.testing.assert_allclose(
        up_to_sign(each(rotation.from_rpy, recorded["rpy_in"])), up_to_sign(recorded["quat_out"]), atol=ROUND_OFF
    )
    difference = each(rotation.to_rpy, recorded["quat"]) - recorded["rpy"]
    # asin(s) loses half the digits as s nears 0.99999: 1e-16 / sqrt(1 - s^2) = 2e-14.
    np.testing.assert_allclose((difference + np.pi) % (2 * np.pi) - np.pi, 0, atol=1e-12)


def attitudes(count, near):
    """Single-precision quaternions: random ones, some near the poles, and `near` about every multiple of 7.5 degrees.

    Each of roll, pitch and yaw goes through all its multiples, while the other two are random multiples.
    """
    rng = np.random.default_rng(4)
    steps = np.array([24, 12, 24])
    multiples = [rng.integers(-steps, steps + 1, (near * (2 * n + 1), 3)) for n in steps]
    for axis, (n, some) in enumerate(zip(steps, multiples, strict=True)):
        some[:, axis] = np.repeat(np.arange(-n, n + 1), near)
    rpy = np.radians(7.5 * np.concatenate(multiples))
    quat = Rotation.from_euler("xyz", rpy + rng.uniform(-1e-6, 1e-6, rpy.shape)).as_quat()
    half = (np.pi / 2 - rng.uniform(-0.008, 0.008, count // 100)) * rng.choice([-1, 1], count // 100)
    polar = np.column_stack([rng.uniform(-3, 3, len(half)), half, rng.uniform(-3, 3, len(half))])
    polar = Rotation.from_euler("xyz", polar).as_quat()
    quats = np.concatenate([Rotation.random(count, rng=5).as_quat(), quat, polar])
    return (quats * rng.choice([-1, 1], (len(quats), 1))).astype(np.float32)


def check_angles(quats, rpy):
    """Away from the poles the angles are those of the matrix. At the poles roll is zero and the attitude is right."""
    x, y, z, w = np.asarray(quats, float).T
    rpy = np.asarray(rpy, float)
    up, down = np.maximum(abs(w - y), abs(x + z)), np.maximum(abs(w + y), abs(x - z))
    pole = np.minimum(up, down) <= 3 / 1024
    roll, yaw = np.arctan2(y * z + w * x, 0.5 - x * x - y * y), np.arctan2(x * y + w * z, 0.5 - y * y - z * z)
    exact = np.column_stack([roll, np.arcsin(np.clip(2 * (w * y - x * z), -1, 1)), yaw])
    difference = (rpy - exact)[~pole]
    assert np.max(np.abs((difference + np.pi) % (2 * np.pi) - np.pi)) < 2e-3
    assert np.all(rpy[pole, 0] == 0)
    turned = Rotation.from_euler("xyz", rpy[pole]).inv() * Rotation.from_quat(np.asarray(quats, float)[pole])
    assert np.all(turned.magnitude() <= 3 / 512 * np.sqrt(2) + 1e-6)  # rad, at the corners of what counts as a pole


def in_worlds(quats):
    def in_a_loop(quat):
        return jax.lax.scan(lambda quat, _: (quat, rotation.to_rpy(quat)), quat, length=2)[1]

    return jd.over_worlds(in_a_loop)(quats)[:, 1]


@pytest.mark.float32
@pytest.mark.parametrize(
    ("count", "near"), [(100_000, 100), pytest.param(1_000_000, 10_000, marks=pytest.mark.slow)], ids=["quick", "slow"]
)
def test_angles_in_single_precision_are_right_however_they_are_compiled(count, near):
    quats = attitudes(count, near)
    for compiled in jit_optimized, jit_unoptimized:
        check_angles(quats, compiled(in_worlds)(quats))
        check_angles(quats, compiled(jax.vmap(rotation.to_rpy))(quats))
    check_angles(quats, jax.vmap(rotation.to_rpy)(quats))  # eager
    check_angles(quats[-5:], list(map(jit_optimized(rotation.to_rpy), quats[-5:])))


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.needs("pybullet")
def test_angles_of_states_of_both_backends_are_right():
    quats = attitudes(100, 1)
    n = len(quats)
    params = jd.repeat(jd.load_params("cf2x"), n)
    start = jd.State.at_rest(np.arange(3 * n).reshape(n, 3)).replace(quat=jnp.asarray(quats))
    flown = jax.jit(lambda state: jax.vmap(rotation.to_rpy)(state.quat))
    from jaxdrones.engine import bullet

    with bullet.make_step() as in_bullet:
        for step in jd.make_step(), in_bullet:
            state = step(params, start, jnp.zeros((n, 4)))
            check_angles(state.quat, flown(state))


@pytest.mark.needs("casadi")
def test_angles_of_the_symbolic_twin_are_right():
    import casadi

    from jaxdrones.optimal.interpreter import on_symbols

    (q,), rpy = on_symbols(rotation.to_rpy, q=jnp.zeros(4))
    quats = attitudes(10_000, 100)
    twin = casadi.Function("rpy", [q], [rpy]).map(len(quats))
    check_angles(quats, np.asarray(twin(quats.T.astype(float))).T)


def test_roll_pitch_yaw_have_finite_gradients_also_at_the_poles():
    pitch = np.array([0.0, np.pi / 2, -np.pi / 2, np.pi / 2 - 0.004])
    quat = each(rotation.from_rpy, np.column_stack([0 * pitch, pitch, 0 * pitch + 0.3]))
    assert np.all(np.isfinite(each(jax.jacobian(rotation.to_rpy), quat)))


def test_roll_pitch_yaw_are_continuous_where_the_pole_begins():
    """Just outside the band roll and yaw are nearly undetermined, but they still describe the same attitude."""
    pitch = np.arcsin(0.99999) + np.array([-1e-7, 1e-7])
    quat = each(rotation.from_rpy, np.column_stack([0 * pitch, pitch, 0 * pitch + 0.7]))
    again = each(rotation.from_rpy, each(rotation.to_rpy, quat))
    # Inside the band pitch becomes 90 degrees: off by acos(0.99999) = 0.0045 rad, half of it in the quaternion.
    assert np.all(np.abs(np.sum(quat * again, axis=1)) >= np.cos(0.0045 / 2) - 1e-9)


def test_the_yaw_of_python_numbers_is_that_of_an_array():
    quats = np.random.default_rng(3).normal(size=(100, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    expected = jax.jit(jax.vmap(rotation.to_rpy))(quats)[:, 2]
    np.testing.assert_allclose([rotation.yaw_of(*q.tolist()) for q in quats], expected, rtol=0, atol=1e-9)

"""The Riccati equation, the linearizations and the regulator."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from closed_loop import hovering, make_step, one, team_of
from helpers import VEHICLES, flying, jit_unoptimized

import jaxdrones as jd
from jaxdrones import optimal
from jaxdrones.control import Setpoint
from jaxdrones.dynamics.model import PointMass
from jaxdrones.optimal import lqr
from jaxdrones.optimal.coordinates import displaced, feedback_error, tracking_error
from jaxdrones.optimal.problem import hover, posed
from jaxdrones.status import PlanningError, Status

DT = 1 / 100


def some_state(vehicle="cf2x"):
    team = team_of(vehicle)
    return one(team), one(flying(team))


@pytest.mark.slow
def test_the_riccati_solution_is_that_of_scipy():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(6, 6)), rng.normal(size=(6, 2))
    q, r = np.diag(rng.uniform(0, 1, 6)), np.diag(rng.uniform(1, 2, 2))
    value = lqr.riccati(*map(jnp.asarray, (a, b, q, r)))
    np.testing.assert_allclose(value, scipy.linalg.solve_discrete_are(a, b, q, r), rtol=1e-9)


def test_a_displacement_is_the_inverse_of_a_difference_whatever_the_sign_of_the_quaternion():
    params, state = some_state()
    z = 1e-4 * jnp.asarray(np.random.default_rng(1).normal(size=16))

    @jax.jit
    def found(z, sign):
        return optimal.difference(params, displaced(params, state.replace(quat=sign * state.quat), z), state)

    for sign in 1, -1:
        np.testing.assert_allclose(
            found(z, sign), z, rtol=0, atol=1e-12
        )  # the rotation errs by the third power of 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("rotors", [jd.instant_rotors, jd.lagging_rotors])
def test_a_short_step_moves_as_the_continuous_linearization_says(rotors):
    """A of the step is 1 + dt A of the derivative, up to dt^2; so is B, where the rotors have a lag."""
    params, state = some_state()
    rpm = jnp.array([14000.0, 15000, 14500, 14200])
    state = state.replace(rpm=rpm)
    a, b = optimal.linearize(optimal.single(jd.make_derivative([jd.drag], rotors=rotors)), params, state, rpm)
    dt = 1e-5
    step = optimal.single(jd.make_step([jd.drag], rotors=rotors, integrator=jd.rk4, dt=dt))
    a_step, b_step = optimal.linearize_step(step, params, state, rpm)
    moving = slice(None) if rotors is jd.lagging_rotors else slice(12)  # instant rotors jump
    np.testing.assert_allclose(((a_step - np.eye(16)) / dt)[moving, :12], a[moving, :12], rtol=2e-2, atol=2e-2)
    if rotors is jd.lagging_rotors:
        np.testing.assert_allclose(b_step / dt, b, rtol=1e-2, atol=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", VEHICLES)
def test_hover_can_be_controlled_and_the_regulator_makes_it_stable(vehicle):
    params = one(team_of(vehicle))
    step = jd.make_step([jd.drag], rotors=jd.lagging_rotors, dt=DT)
    at_rest = hover(params, one(hovering(team_of(vehicle))))
    settings = lqr.settings(step)
    memory = jax.jit(lqr.init)(settings, params, at_rest)
    linearize = jax.jit(optimal.linearize_step, static_argnums=0)
    a, b = linearize(optimal.single(step), params, at_rest, at_rest.rpm)
    assert np.max(np.abs(np.linalg.eigvals(a - b @ memory.gain))) < 1 - 1e-3
    expected = scipy.linalg.solve_discrete_are(
        a, b, settings.weights.state_matrix(16), settings.weights.command_matrix()
    )
    np.testing.assert_allclose(memory.value, expected, rtol=1e-6, atol=1e-6 * np.max(expected))


@pytest.mark.slow
def test_the_command_does_not_depend_on_the_heading():
    """The world, turned about the vertical, with target and drone."""
    params, state = some_state()
    state = state.replace(quat=jd.rotation.exp(jnp.array([0.1, -0.2, 0.3])))
    settings = lqr.settings(make_step(dt=DT))
    memory = lqr.init(settings, params, state)
    acc = jnp.array([[0.3, -0.2, 0.1], [0.4, -0.2, 0.1], [0.5, -0.1, 0.2]])
    target = Setpoint.at(state.pos[None] + 0.1 * acc, vel=acc, acc=acc, yaw=jnp.full(3, 0.2))
    _, rpm = lqr.control(settings, params, memory, state, target, dt=DT)
    turn = jd.rotation.exp(jnp.array([0.0, 0.0, 1.1]))

    def rotate(v):
        return jnp.apply_along_axis(lambda v: jd.rotation.rotate(turn, v), -1, v)

    turned = state.replace(pos=rotate(state.pos), vel=rotate(state.vel), quat=jd.rotation.multiply(turn, state.quat))
    target = Setpoint.at(rotate(target.pos), rotate(target.vel), rotate(target.acc), target.yaw + 1.1)
    _, again = lqr.control(settings, params, memory, turned, target, dt=DT)
    np.testing.assert_allclose(again, rpm, rtol=1e-9)


def test_the_error_of_a_drone_with_a_load_depends_neither_on_the_place_nor_on_the_heading():
    """The load moves and turns with target and drone; in hover at the origin it is as far from the drone as now."""
    team = jd.with_payload(team_of("cf2x"), mass=0.005, length=0.3)
    settings, params = lqr.settings(make_step((jd.drag, jd.cable), models=(jd.payload(),), dt=DT)), one(team)

    @jit_unoptimized
    def error(place, angle):
        turn = jd.rotation.exp(jnp.array([0.0, 0.0, 1.0]) * angle)
        ahead, swing, moving = (
            jd.rotation.rotate(turn, jnp.array(v)) for v in ([0.2, 0.1, 0.0], [0.03, -0.02, -0.3], [0.1, 0.2, 0.0])
        )
        load = PointMass(place + swing, moving)
        state = one(hovering(team)).replace(pos=place, quat=turn, aux={"payload": load})
        target = Setpoint.at(jnp.tile(place + ahead, (3, 1)), yaw=jnp.full(3, angle))
        _, _, motion = posed(settings, params, None, state, target, DT, "hold")
        at_rest = hover(params, state).aux["payload"].pos
        return tracking_error(params, state, one(motion.state)), jd.rotation.rotate_inverse(turn, at_rest)

    (there, hanging), (here, swing) = error(jnp.array([1.0, -2.0, 3.0]), 1.1), error(jnp.zeros(3), 0.0)
    np.testing.assert_allclose(there, here, rtol=0, atol=1e-12)
    np.testing.assert_allclose(hanging, swing, rtol=0, atol=1e-12)
    np.testing.assert_allclose(here[16:], [-0.2, -0.1, 0, 0.1, 0.2, 0], rtol=0, atol=1e-12)


def test_the_error_of_the_feedback_is_the_tracking_error_to_first_order():
    params, state = some_state()
    reference = state.replace(quat=jd.rotation.exp(jnp.array([0.1, -0.2, 0.9])))

    def near(error):
        return jax.jacfwd(lambda z: error(params, displaced(params, reference, z), reference))(jnp.zeros(16))

    expected, matrix = jit_unoptimized(lambda: (near(tracking_error), near(feedback_error)))()
    np.testing.assert_allclose(matrix, expected, rtol=0, atol=1e-12)


def test_position_and_tilt_enter_the_feedback_alike_whatever_the_heading_of_the_drone():
    """Thrust acts along the tilt of the body: a drone of another heading sees its own error turned and corrects it."""
    params, state = some_state()
    reference, tilt = hover(params, state), jd.rotation.exp(jnp.array([0.2, -0.1, 0.0]))

    @jit_unoptimized
    def error(angle):
        turn = jd.rotation.exp(jnp.array([0.0, 0.0, 1.0]) * angle)
        pos, vel = (jd.rotation.rotate(turn, jnp.array(v)) for v in ([0.2, 0.1, 0.3], [0.5, -0.4, 0.1]))
        there = state.replace(pos=pos, vel=vel, quat=jd.rotation.multiply(turn, tilt))
        return feedback_error(params, there, reference)

    expected = error(0.0)
    for angle in (0.7, 2.3, -3.0, 3.5):
        z = error(angle)
        np.testing.assert_allclose(np.delete(z, 5), np.delete(expected, 5), rtol=0, atol=1e-12)
        np.testing.assert_allclose(z[5], 2 * np.sin((angle + np.pi) % (2 * np.pi) / 2 - np.pi / 2), atol=1e-12)


def test_beyond_a_tilt_of_90_degrees_the_feedback_has_the_tracking_error():
    """A heading means little there: with its own a tumbling drone recovers less often."""
    params, state = some_state()
    reference = hover(params, state)

    @jit_unoptimized
    def errors(degrees):
        tilt, turn = (
            jd.rotation.exp(jnp.radians(v)) for v in (degrees * jnp.array([0.6, 0.8, 0]), jnp.array([0, 0, 100.0]))
        )
        there = state.replace(quat=jd.rotation.multiply(turn, tilt))
        return feedback_error(params, there, reference), tracking_error(params, there, reference)

    for degrees, same in (89.0, False), (91.0, True), (179.0, True), (181.0, True):
        found, expected = errors(degrees)
        assert np.allclose(found, expected, rtol=0, atol=1e-12) == same


@functools.cache
def regulator():
    """Parameters and reference of a hover, and the gain of its regulator, of rotors with a lag."""
    params, state = some_state()
    settings = lqr.settings(make_step(rotors=jd.lagging_rotors, dt=DT))
    return params, hover(params, state), jit_unoptimized(lambda: lqr.init(settings, params, state).gain)()


feedback = jit_unoptimized(lambda params, gain, there, to: lqr.feedback(params, gain, there, to, to.rpm))


def test_the_feedback_is_linear_near_the_reference():
    params, reference, gain = regulator()
    off = 0.02 * np.random.default_rng(3).uniform(-1, 1, 16)

    @jit_unoptimized
    def commands(off):
        there = displaced(params, reference, off)
        linear = reference.rpm - params.hover_rpm * (gain @ feedback_error(params, there, reference))
        return lqr.feedback(params, gain, there, reference, reference.rpm), linear

    np.testing.assert_allclose(*commands(off), rtol=1e-12)


def test_from_afar_a_drone_approaches_at_the_speed_from_which_it_stops_at_the_target():
    """At sqrt(2 a s) with s the distance, less what the linear feedback near the target adds to it."""
    params, reference, gain = regulator()
    level, upright = np.array([0.6, -0.8, 0.0]), np.array([0.0, 0.0, 1.0])
    for distance in (5.0, 50.0):
        for direction, limit, axes in ((level, 0.6 / 2, slice(2)), (-upright, 0.3, slice(2, 3))):
            acc = limit * float(params.gravity)
            rate = np.linalg.norm(gain[:, axes]) / np.linalg.norm(gain[:, 6:9][:, axes])
            speed = np.sqrt(2 * acc * distance - (acc / rate) ** 2)
            there = reference.replace(pos=jnp.array(distance * direction), vel=jnp.array(-speed * direction))
            np.testing.assert_allclose(feedback(params, gain, there, reference), reference.rpm, rtol=1e-9)


def test_a_far_target_is_moved_towards_the_drone_together_with_its_load():
    params, reference, gain = regulator()
    target = reference.replace(aux={"load": PointMass(jnp.array([0, 0, -0.5]), jnp.zeros(3))})
    moved = lqr._on_the_way(params, gain, target.replace(pos=jnp.array([9.0, -2, 1])), target)
    assert np.linalg.norm(moved.pos) > 1
    np.testing.assert_allclose(moved.aux["load"].pos, moved.pos - jnp.array([0, 0, 0.5]))


@pytest.mark.parametrize("side", [-1, 1])
def test_a_target_far_above_or_below_asks_for_thirty_percent_of_the_rotor_speed(side):
    """Rotors with a lag that have reached it keep it, although their speeds are fed back."""
    params, reference, gain = regulator()
    rpm = (1 + 0.3 * side) * reference.rpm
    below = reference.replace(pos=jnp.array([0.0, 0.0, -100.0 * side]), rpm=rpm)
    np.testing.assert_allclose(feedback(params, gain, below, reference), rpm, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.parametrize("rotors", [jd.instant_rotors, jd.lagging_rotors])
def test_the_regulator_recovers_from_large_errors(rotors):
    """Of the heading, the position and the velocity, and of all of them."""
    team = team_of("cf2x")
    params, step = one(team), make_step(rotors=rotors, dt=1 / 400, substeps=4)
    settings = lqr.settings(step)

    @jax.jit
    @jax.vmap
    def end(start):
        pos, degrees, speed = start[:3], start[3], start[4:]
        attitude = jd.rotation.exp(jnp.array([0.0, 0.0, 1.0]) * jnp.radians(degrees))
        start = one(hovering(team)).replace(pos=pos, quat=attitude, vel=speed)

        def advance(carry, _):
            memory, state = carry
            memory, rpm = lqr.control(settings, params, memory, state, Setpoint.at(jnp.zeros((3, 3))), dt=DT)
            return (memory, one(step(team, jax.tree.map(lambda x: x[None], state), rpm[None]))), None

        start = start.replace(rpm=jnp.broadcast_to(params.hover_rpm, (4,)))
        (_, state), _ = jax.lax.scan(advance, (lqr.init(settings, params, start), start), length=2000)
        return jnp.linalg.norm(state.pos)

    turned = [(0.3, 0, 0, degrees, 0, 0, 0) for degrees in (0, 90, 130, 150, 179, -130)]
    away = [(x, y, z, 0, 0, 0, 0) for x, y, z in ((1, 0, 0), (0, -5, 0), (0, 0, 20), (0, 0, -20), (30, -30, 20))]
    fast = [(0, 0, 0, 0, 8, 0, 0), (0, 0, 0, 0, 0, -5, 5), (-3, 4, 2, 120, 4, 4, -4)]
    assert np.all(end(jnp.array([*turned, *away, *fast], float)) < 0.01)


@pytest.mark.float32
def test_a_reference_of_any_acceleration_has_a_command_within_limits_or_a_status():
    params, state = some_state()
    state = hover(params, state)
    settings = lqr.settings(jd.make_step(dt=DT))
    gain = 0.1 * jnp.asarray(np.random.default_rng(0).normal(size=(4, 16)), jnp.float32)
    memory = lqr.Memory(gain.at[:, 12:].set(0), jnp.zeros((16, 16)), jnp.full(4, 123.0), jnp.zeros((), jnp.int32))

    @jit_unoptimized
    @jax.vmap
    def control(acc):
        return lqr.control(settings, params, memory, state, Setpoint.at(jnp.zeros((3, 3)), acc=acc), dt=DT)

    powers = 10.0 ** np.arange(3, 39)
    for direction in ([0, 0, 1], [1, 0, 0], [-1, 0, 0], [0.3, -0.2, 0.1]):
        acc = powers[:, None, None] * np.array(direction) * np.ones((3, 1))
        after, rpm = jax.device_get(control(jnp.asarray(acc, jnp.float32)))
        in_range = powers < 1e20  # the square of its force has a float32
        assert np.all(after.status[in_range] == Status.OK) and np.all(after.status[powers > 1e22] != Status.OK)
        assert np.all((rpm >= 0) & (rpm <= params.max_rpm)) and np.array_equal(after.rpm, rpm)
        np.testing.assert_allclose(rpm[in_range], np.broadcast_to(rpm[2], rpm[in_range].shape), rtol=0, atol=100)
        assert np.all(rpm[powers > 1e22] == 123)
        assert direction != [0, 0, 1] or np.all(rpm[in_range] > 0.9999 * params.max_rpm)


@pytest.mark.slow
@pytest.mark.float32
def test_a_state_that_is_not_finite_has_the_last_safe_command_and_a_status_or_an_error():
    params, state = some_state()
    settings = lqr.settings(jd.make_step(dt=DT))
    memory = jit_unoptimized(lqr.init)(settings, params, state)
    near = Setpoint.at(jnp.zeros((3, 3)))
    before, safe = lqr.control(settings, params, memory, state, near, dt=DT)
    lost = state.replace(omega=state.omega.at[1].set(jnp.nan))
    for unlucky, target in (lost, near), (state, near.replace(yaw=jnp.full(3, jnp.inf))):
        after, rpm = lqr.control(settings, params, before, unlucky, target, dt=DT)
        assert after.status == Status.INVALID_STATE and np.array_equal(rpm, safe)
        assert lqr.control(settings, params, after, state, near, dt=DT)[0].status == Status.OK
    with pytest.raises(PlanningError, match="lqr: The state or a set-point is not finite"):
        lqr.control(settings, params, before, lost, near, dt=DT, on_failure="raise")


@pytest.mark.slow
def test_what_cannot_be_controlled_so_is_refused():
    params, state = some_state()
    settings = lqr.settings(jd.make_step(dt=DT))
    memory = lqr.init(settings, params, state)
    target = Setpoint.at(jnp.zeros((3, 3)))
    with pytest.raises(ValueError, match=r"dt is 0.02 s and the step takes 0.01 s"):
        lqr.control(settings, params, memory, state, target, dt=0.02)
    with pytest.raises(ValueError, match=r"gravity is 0.*positive gravity"):
        lqr.init(settings, params.replace(gravity=jnp.zeros(())), state)
    with pytest.raises(ValueError, match=r"use jax.vmap for a team"):
        lqr.init(settings, team_of("cf2x", "cf2x"), state)

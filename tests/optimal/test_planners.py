"""iLQR and MPPI: bounds, improvement, and flights closer to the target than PID's."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_loop import distance, hovering, one, team_of
from helpers import jit_unoptimized, mostly_slow

import jaxdrones as jd
from jaxdrones import optimal, rotation
from jaxdrones.control import Setpoint, for_team, pid
from jaxdrones.control.allocation import mixer
from jaxdrones.dynamics.model import PointMass
from jaxdrones.dynamics.rotors import rotor_wrench
from jaxdrones.optimal import ilqr, lqr, mppi
from jaxdrones.optimal.ilqr import box_qp
from jaxdrones.optimal.mppi import importance
from jaxdrones.optimal.problem import Reference
from jaxdrones.status import PlanningError, Status
from jaxdrones.tasks.curves import SHAPES, setpoint_on

DT = 1 / 100
HORIZON = 8


def test_a_box_constrained_program_has_the_cost_of_the_best_of_all_active_sets():
    rng = np.random.default_rng(0)
    for _ in range(20):
        root = rng.normal(size=(4, 4))
        hessian, gradient = root @ root.T + 0.1 * np.eye(4), 3 * rng.normal(size=4)
        low, high = -rng.uniform(0, 1, 4), rng.uniform(0, 1, 4)
        x, free = _box_qp(hessian, gradient, low, high)
        best = min(
            (c @ hessian @ c / 2 + gradient @ c for c in _candidates(hessian, gradient, low, high)), default=np.inf
        )
        np.testing.assert_allclose(x @ hessian @ x / 2 + gradient @ x, best, rtol=0, atol=1e-9)
        assert np.all((x >= low) & (x <= high)) and np.array_equal(free, (x > low) & (x < high))


def test_a_backward_pass_over_a_linear_model_has_the_best_commands_and_keeps_within_their_bounds():
    rng = np.random.default_rng(0)
    a, b, root, slopes = (jnp.asarray(rng.normal(size=size)) for size in ((3, 2, 2), (3, 2, 4), (3, 2, 2), (3, 2)))
    curvatures, commands = root @ jnp.swapaxes(root, 1, 2), jnp.full((3, 4), 10.0)
    nominal = commands + jnp.asarray(rng.normal(size=(3, 4)))

    def cost(change):
        z, total = jnp.zeros(2), jnp.sum((commands + change - nominal) ** 2) / 2
        for k in range(3):
            z = a[k] @ z + b[k] @ change[k]
            total += slopes[k] @ z + z @ curvatures[k] @ z / 2
        return total

    @jit_unoptimized
    def found(high):
        models = (a, b, slopes, curvatures, commands, nominal)
        changes, gains = ilqr._backward(models, jnp.eye(4), high, jnp.zeros(()))
        z, flown = jnp.zeros(2), []
        for k in range(3):
            flown.append(changes[k] + gains[k] @ z)
            z = a[k] @ z + b[k] @ flown[-1]
        return changes, jax.grad(cost)(jnp.stack(flown))

    np.testing.assert_allclose(found(100.0)[1], 0, atol=1e-9)
    limited = commands + found(10.2)[0]
    assert np.all(limited <= 10.2) and np.any(limited == 10.2)


_box_qp = jax.jit(box_qp)


def _candidates(hessian, gradient, low, high):
    """Feasible points at which the free components are stationary and the other ones on a bound."""
    for sides in itertools.product((None, low, high), repeat=4):
        x = np.array([0.0 if side is None else side[i] for i, side in enumerate(sides)])
        free = [i for i, side in enumerate(sides) if side is None]
        held = [i for i in range(4) if i not in free]
        if free:
            right = -gradient[free] - hessian[np.ix_(free, held)] @ x[held]
            x[free] = np.linalg.solve(hessian[np.ix_(free, free)], right)
        if np.all((x >= low - 1e-12) & (x <= high + 1e-12)):
            yield x


def test_importance_prefers_what_costs_less_and_leaves_out_what_is_not_finite():
    weights = np.asarray(jax.jit(importance)(jnp.array([3.0, 1.0, jnp.inf, 2.0, jnp.nan]), 0.5))
    assert weights[1] > weights[3] > weights[0] > 0 and weights[2] == weights[4] == 0
    np.testing.assert_allclose(np.sum(weights), 1, rtol=1e-12)
    above = np.array([2.0, 0, 1])  # the lowest cost
    law = np.exp(-above / (0.5 * np.sqrt(np.mean(above**2))))
    np.testing.assert_allclose(weights[[0, 1, 3]], law / np.sum(law), rtol=1e-12)
    np.testing.assert_allclose(jax.jit(importance)(jnp.ones(4), 0.5), 0.25, rtol=1e-12)


def test_noise_is_held_and_is_collective_roll_pitch_and_yaw_of_the_rotors():
    params, settings = jd.load_params("cf2x"), mppi.settings(None, horizon=8, samples=2000, hold=3)
    noise = np.asarray(mppi._noise(jax.random.key(0), settings, params, jnp.zeros((8, 4))))
    for first, last in (0, 3), (3, 6), (6, 8):
        np.testing.assert_array_equal(
            noise[:, first:last], np.repeat(noise[:, first : first + 1], last - first, axis=1)
        )
    assert noise.shape == (2000, 8, 4) and np.all(noise[:, 0] != noise[:, 3])
    shares = np.linalg.inv(np.concatenate([np.ones((4, 1)), mixer(params)], axis=1))
    np.testing.assert_allclose(np.std(noise[:, 0] @ shares.T, axis=0), [0.05, 0.02, 0.02, 0.02], rtol=0.05)


def test_the_cost_of_a_plan_is_half_of_the_weighted_squares_of_errors_commands_and_end():
    """Of a drone that stays 0.1 m beside its target, without feedback."""
    params, at_rest = one(team_of("cf2x")), one(hovering(team_of("cf2x")))
    target = jax.tree.map(lambda x: jnp.tile(x[None], (4, *[1] * x.ndim)), Reference(at_rest, at_rest.rpm))
    regulator = lqr.Memory(jnp.zeros((4, 16)), 7 * jnp.eye(16), at_rest.rpm, jnp.zeros(()))
    plan = 0.01 * jnp.arange(12.0).reshape(3, 4)
    beside, settings = at_rest.replace(pos=at_rest.pos.at[0].add(0.1)), mppi.settings(lambda team, state, rpm: state)
    cost = jit_unoptimized(functools.partial(mppi.cost, settings))(params, beside, target, plan, regulator)
    np.testing.assert_allclose(cost, (3 * 1000 * 0.1**2 + 10 * np.sum(plan**2) + 7 * 0.1**2) / 2, rtol=1e-9)


@functools.cache
def _step():
    return jd.make_step([jd.drag], dt=DT)


@functools.cache
def _plan(iterations):
    settings = ilqr.settings(_step(), horizon=HORIZON, iterations=iterations)

    @jax.jit
    def plan(params, state, setpoints):
        target = optimal.reference(params, setpoints, {}, DT)
        value = ilqr.init(settings, params, state).lqr.value
        return ilqr.solve(settings, params, state, target, target.rpm[:-1], value)

    return plan


@pytest.mark.slow
def test_an_iteration_never_costs_more_and_a_plan_within_reach_is_optimal():
    """Far off, commands are at their limits; near by, no small change of the plan costs less."""
    team = team_of("cf2x")
    params, state = one(team), one(hovering(team))
    plan = _plan(6)
    far = plan(params, state, Setpoint.at(jnp.broadcast_to(jnp.array([2.0, 0, 3]), (HORIZON + 1, 3))))
    assert np.all(np.diff(far.costs) <= 0) and far.costs[-1] < far.costs[0]
    assert np.all((far.rpm >= 0) & (far.rpm <= params.max_rpm))
    assert np.any(far.rpm >= params.max_rpm * (1 - 1e-12))
    near = plan(params, state, Setpoint.at(jnp.broadcast_to(jnp.array([0.02, 0.01, 1.01]), (HORIZON + 1, 3))))
    assert np.diff(near.costs)[-1] > -1e-9 * near.cost
    assert np.all((near.rpm > 0) & (near.rpm < params.max_rpm))


@pytest.mark.slow
def test_near_hover_the_plan_is_that_of_the_regulator():
    """A quadratic problem with the regulator's value at its end: the first command is the regulator's."""
    team = team_of("cf2x")
    params, state = one(team), one(hovering(team))
    state = state.replace(pos=state.pos + jnp.array([1e-4, -2e-4, 1e-4]))
    setpoints = Setpoint.at(jnp.broadcast_to(jnp.array([0, 0, 1.0]), (HORIZON + 1, 3)))
    plan = _plan(6)(params, state, setpoints)
    settings = lqr.settings(_step())
    memory = lqr.init(settings, params, state)
    _, rpm = lqr.control(settings, params, memory, state, jax.tree.map(lambda x: x[:3], setpoints), dt=DT)
    change = np.asarray(rpm - params.hover_rpm)
    np.testing.assert_allclose(plan.rpm[0] - params.hover_rpm, change, rtol=0, atol=1e-2 * np.max(np.abs(change)))


@pytest.mark.parametrize(
    ("module", "option", "least"),
    [
        *((module, "horizon", 2) for module in (ilqr, mppi)),
        *((ilqr, "iterations", 1), (mppi, "samples", 1), (mppi, "hold", 1), (mppi, "temperature", 0)),
    ],
)
def test_settings_that_make_no_sense_are_refused(module, option, least):
    for value in (least - 1, np.nan, np.inf, True, "a", None):
        with pytest.raises(ValueError, match=rf"^{option} is .*; give a .*number of at least {least}"):
            module.settings(_step(), **{option: value})
    assert getattr(module.settings(_step(), **{option: least}), option) == least


@pytest.mark.parametrize("rotors", [jd.pwm_rotors, jd.failing(jd.pwm_rotors)])
def test_a_step_that_takes_pwm_is_refused(rotors):
    """The planners' commands are RPM."""
    step = jd.make_step(rotors=rotors, dt=DT)
    for module in (lqr, ilqr, mppi):
        with pytest.raises(ValueError, match=r"step takes the PWM .*; give a model with rotors=jaxdrones.lagging"):
            module.settings(step)


@pytest.mark.slow
def test_setpoints_that_do_not_fit_the_horizon_are_refused():
    team = team_of("cf2x")
    params, state, short = one(team), one(hovering(team)), Setpoint.at(jnp.zeros((3, 3)))
    for module, keys in (ilqr, ()), (mppi, (jax.random.key(0),)):
        settings = module.settings(_step(), horizon=HORIZON)
        memory = jax.eval_shape(functools.partial(module.init, settings), params, state, *keys)
        with pytest.raises(ValueError, match=r"setpoints.pos has shape \(3, 3\); expected \(9, 3\)"):
            module.control(settings, params, memory, state, short, dt=DT)
    settings = lqr.settings(_step())
    memory = jax.eval_shape(functools.partial(lqr.init, settings), params, state)
    with pytest.raises(ValueError, match=r"setpoints.pos has shape \(2, 3\); expected \(3, 3\)"):
        lqr.control(settings, params, memory, state, Setpoint.at(jnp.zeros((2, 3))), dt=DT)


@functools.cache
def _control(module):
    settings = module.settings(jd.make_step(dt=DT), horizon=2, **({"samples": 8} if module is mppi else {}))
    return settings, jax.jit(functools.partial(module.control, settings, dt=DT))


def _blank(module, settings, params, state):
    """Memory without a regulator, as the time of a test is that of its linearization."""
    keys = (jax.random.key(0),) if module is mppi else ()
    shapes = jax.eval_shape(functools.partial(module.init, settings), params, state, *keys)
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes.replace(key=None) if keys else shapes)
    return blank.replace(rpm=jnp.full(4, 12345.0), **({"key": keys[0]} if keys else {}))


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.parametrize("module", mostly_slow([mppi, ilqr], [mppi]), ids=["mppi", "ilqr"])
def test_a_planner_moves_its_plan_on_by_a_step_or_drops_it_and_holds_its_command(module):
    """MPPI without noise and with equal weights plans the mean of its samples: the last plan, but one is zero."""
    team = team_of("cf2x")
    params, state = one(team), one(hovering(team))
    options = dict(samples=8, temperature=1e9) if module is mppi else dict(iterations=1)
    settings = module.settings(jd.make_step(dt=DT), horizon=2, **options)
    settings = settings.replace(noise=jnp.zeros(4)) if module is mppi else settings
    memory = _blank(module, settings, params, state).replace(correction=0.01 * jnp.arange(8.0).reshape(2, 4))
    memory = memory if module is mppi else memory.replace(started=jnp.ones((), bool))
    control = jit_unoptimized(functools.partial(module.control, settings, dt=DT))
    stay = Setpoint.at(jnp.broadcast_to(state.pos, (3, 3)))
    after, rpm = control(params, memory, state, stay)
    assert after.status == Status.OK and np.array_equal(rpm, after.rpm) and np.all(rpm != 12345)
    lost, held = control(params, memory, state.replace(vel=state.vel * jnp.nan), stay)
    assert lost.status == Status.INVALID_STATE and np.all(held == 12345) and np.all(lost.rpm == 12345)
    assert not np.any(lost.correction)
    if module is ilqr:
        assert after.started and not lost.started
    else:
        np.testing.assert_allclose(after.correction, memory.correction[jnp.array([1, 1])] * 7 / 8, rtol=1e-4)
        assert not np.array_equal(jax.random.key_data(after.key), jax.random.key_data(memory.key))


def test_a_reference_turns_as_fast_as_its_heading_also_by_a_radian_in_a_step_and_its_load_hangs_below():
    params, dt, rate = jd.load_params("cf2x"), 0.1, -10.0  # s, rad/s
    places = jnp.arange(18.0).reshape(6, 3)
    setpoints = Setpoint.at(places, vel=places[::-1], yaw=3 + rate * dt * jnp.arange(6))
    load = PointMass(jnp.array([0, 0, -0.5]), jnp.zeros(3))
    state = jit_unoptimized(lambda: optimal.reference(params, setpoints, {"load": load}, dt).state)()
    np.testing.assert_allclose(state.omega, np.tile([0, 0, rate], (6, 1)), atol=1e-12)
    np.testing.assert_array_equal(state.aux["load"].pos, places - jnp.array([[0, 0, 0.5]]))
    np.testing.assert_array_equal(state.aux["load"].vel, setpoints.vel)


def test_the_rotor_speeds_of_a_reference_obey_eulers_equation():
    """Torque = I dw/dt + w x I w, for a drone that turns about its yaw axis and tilts on a circle."""
    params = jd.load_params("hb")
    params = params.replace(inertia=params.inertia * jnp.array([0.02, 0.03, 0.08]))
    dt = 1e-3

    def along(t):
        place = lambda t: 0.1 * jnp.stack([jnp.cos(6 * t), jnp.sin(6 * t), 0 * t])  # noqa: E731
        return setpoint_on(place, t).replace(yaw=8 * t)

    @jit_unoptimized
    def planned():
        reference = optimal.reference(params, jax.vmap(along)(dt * jnp.arange(6)), {}, dt)
        torque = jax.vmap(lambda state: rotor_wrench(params, state).torque)(reference.state)
        return torque, reference.state.omega

    torque, omega = map(np.asarray, planned())
    momentum = np.asarray(params.inertia) * omega
    for k, first in (1, 1), (4, 3), (5, 3):  # the last difference is also that of the last two rows
        turning = np.cross(omega[k], momentum[k])
        expected = (momentum[first + 1] - momentum[first]) / dt + turning
        assert np.linalg.norm(turning) > 0.1 * np.linalg.norm(expected)
        np.testing.assert_allclose(torque[k], expected, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.parametrize("module", [mppi, ilqr], ids=["mppi", "ilqr"])
def test_after_a_state_that_is_not_finite_or_cannot_be_planned_for_the_next_one_is_planned_as_if_it_were_the_first(
    module,
):
    """The command between is the last safe one, and its status says what happened; an error where one is asked for."""
    team = team_of("cf2x")
    params, state = one(team), one(hovering(team))
    near = Setpoint.at(jnp.broadcast_to(jnp.array([0.1, 0.2, 1.3]), (3, 3)))
    settings, control = _control(module)
    keys = (jax.random.key(0),) if module is mppi else ()
    memory = module.init(settings, params, state, *keys)
    before, safe = control(params, memory, state, near)
    assert before.status == Status.OK and np.max(np.abs(safe - params.hover_rpm)) > 10
    bad = [
        (state.replace(pos=state.pos.at[0].set(jnp.nan)), near, Status.INVALID_STATE),
        (state.replace(omega=state.omega.at[2].set(jnp.inf)), near, Status.INVALID_STATE),
        (state, near.replace(vel=near.vel.at[2, 1].set(jnp.nan)), Status.INVALID_STATE),
        (state.replace(vel=jnp.full(3, 1e30)), near, Status.NOT_CONVERGED),  # its cost is beyond float32
    ]
    for unlucky, target, status in bad:
        after, held = control(params, before, unlucky, target)
        assert after.status == status and np.array_equal(held, safe)
        fresh = memory.replace(key=after.key) if module is mppi else memory
        found, rpm = control(params, after, state, near)
        expected = control(params, fresh, state, near)[1]
        assert found.status == Status.OK and np.array_equal(rpm, expected)
    first, hover = control(params, memory, bad[0][0], near)
    np.testing.assert_allclose(hover, params.hover_rpm, rtol=1e-6)  # without a command before it
    assert first.status == Status.INVALID_STATE
    with pytest.raises(ValueError, match="on_failure is 'raise' inside"):
        jax.eval_shape(
            functools.partial(module.control, settings, dt=DT, on_failure="raise"), params, memory, state, near
        )
    with pytest.raises(ValueError, match="unknown on_failure 'stop'"):
        module.control(settings, params, memory, state, near, dt=DT, on_failure="stop")


@pytest.mark.slow
@pytest.mark.parametrize("module", [mppi, ilqr], ids=["mppi", "ilqr"])
def test_one_state_that_is_not_finite_does_not_end_a_flight(module):
    """Of 200 steps the 100th is measured as NaN; all others are planned, and the target is reached."""
    team = team_of("cf2x")
    params, start = one(team), one(hovering(team))
    settings = module.settings(_step(), horizon=HORIZON)
    keys = (jax.random.key(0),) if module is mppi else ()
    near = Setpoint.at(jnp.broadcast_to(jnp.array([0.1, 0.2, 1.3]), (HORIZON + 1, 3)))

    @jax.jit
    def fly(memory):
        def advance(carry, k):
            state, memory = carry
            seen = state.replace(pos=jnp.where(k == 100, jnp.nan, state.pos))
            memory, rpm = module.control(settings, params, memory, seen, near, dt=DT)
            return (optimal.single(_step())(params, state, rpm), memory), (memory.status, rpm, state.pos)

        return jax.lax.scan(advance, (start, memory), jnp.arange(200))[1]

    status, rpm, pos = fly(module.init(settings, params, start, *keys))
    assert np.flatnonzero(status).tolist() == [100] and status[100] == Status.INVALID_STATE
    assert np.all(np.isfinite(rpm) & (rpm >= 0) & (rpm <= params.max_rpm)) and np.array_equal(rpm[100], rpm[99])
    assert np.linalg.norm(pos[-1] - near.pos[0]) < 0.05
    with pytest.raises(PlanningError, match=f"{'mppi' if keys else 'ilqr'}: The state or a set-point is not finite"):
        memory = module.init(settings, params, start, *keys)
        lost = start.replace(pos=jnp.full(3, jnp.nan))
        module.control(settings, params, memory, lost, near, dt=DT, on_failure="raise")


ROWS = [("figure-eight", 5.0), ("figure-eight", 3.0), ("circle", 5.0), ("lissajous", 10.0), ("polynomial", 10.0)]


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.parametrize("module", [lqr, ilqr, mppi], ids=lambda module: module.__name__.rpartition(".")[2])
def test_every_curve_is_tracked_closer_than_by_pid(module):
    """All curves at once, one world each; root mean square of the error after the first second."""
    worlds = len(ROWS)
    step = jd.make_step([jd.drag], dt=1 / 300, substeps=3)
    team = jd.repeat(jd.load_params("cf2x"), worlds)
    random = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, 27), jnp.float32)

    def target(t):
        def on(name, period):
            return setpoint_on(lambda t: jnp.array([0, 0, 2.0]) + SHAPES[name](random, t / period), t)

        return jax.tree.map(lambda *x: jnp.stack(x), *(on(*row) for row in ROWS))

    start = target(jnp.zeros(()))
    state = hovering(team).replace(pos=start.pos, vel=start.vel)

    def flown(init, control):
        fly = jax.jit(lambda memory: jd.rollout(step, control, team, state, memory, 400)[1])
        times = DT * jnp.arange(1, 401)
        error = distance(fly(init), jax.vmap(target)(times).pos)[100:]
        return np.sqrt(np.mean(error**2, axis=0))

    def by_pid(params, memory, state, k):
        control = functools.partial(pid.control, pid.gains("cf2x"), dt=DT)
        return jax.vmap(control)(params, memory, state, target(k * DT))

    settings = module.settings(step)

    def planned(params, memory, state, k):
        setpoints = jax.vmap(target, out_axes=1)((k + jnp.arange(settings.horizon + 1)) * DT)
        control = functools.partial(module.control, settings, dt=DT)
        return jax.vmap(control)(params, memory, state, setpoints)

    keys = (jax.random.split(jax.random.key(0), worlds),) if module is mppi else ()
    memory = jax.vmap(functools.partial(module.init, settings))(team, state, *keys)
    found = flown(memory, planned)
    assert np.all(found < 0.5 * flown(for_team(pid.init(), worlds), by_pid)), found
    assert np.all(found < 0.015)


@pytest.mark.parametrize("module", [lqr, ilqr, mppi])
def test_weights_that_have_no_best_command_are_refused(module):
    """Commands that cost nothing had gains of NaN, and weights of a wrong length were those of another error."""
    known = optimal.weights()
    for name, value, said in (
        ("command", jnp.zeros(4), r"weights.command is .*; give positive, finite"),
        ("vel", jnp.array([1.0, jnp.nan, 1.0]), r"weights.vel is .*; give finite numbers of at least 0"),
        ("omega", -known.omega, r"weights.omega is .*; give finite numbers of at least 0"),
        ("pos", jnp.ones(2), r"weights.pos has shape \(2,\); expected \(3,\)"),
    ):
        with pytest.raises(ValueError, match=said):
            module.settings(_step(), known.replace(**{name: value}))
    assert module.settings(_step(), known.replace(pos=jnp.zeros(3))).weights.pos[0] == 0


def test_a_reference_in_free_fall_is_level_and_along_the_heading_it_is_the_limit():
    """Without a direction of the thrust the attitude was one upside down, and planners turned the drone over."""
    params, yaw = one(team_of("cf2x")), 0.5
    ahead, fall = np.array([np.cos(yaw), np.sin(yaw), 0]), np.array([0, 0, -float(params.gravity)])
    acc = jnp.asarray([fall, fall * (1 + 1e-9), fall + 5 * ahead, fall - 5 * ahead, fall + 5 * ahead + [0, 0, 0.02]])

    def referred(acc):
        rest = Setpoint.at(jnp.zeros((3, 3)))
        found = optimal.reference(params, rest.replace(acc=jnp.tile(acc, (3, 1)), yaw=jnp.full(3, yaw)), {}, DT)
        return rotation.axes(found.state.quat[0]), found.rpm

    (x, y, z), rpm = jit_unoptimized(jax.vmap(referred))(acc)
    left = [-ahead[1], ahead[0], 0]
    np.testing.assert_allclose(rpm[:2], 0, atol=1)
    np.testing.assert_allclose(z, [[0, 0, 1], [0, 0, 1], ahead, -ahead, ahead], atol=1e-2)
    np.testing.assert_allclose(x, [ahead, ahead, [0, 0, -1], [0, 0, 1], [0, 0, -1]], atol=1e-2)
    np.testing.assert_allclose(y, [left] * 5, atol=1e-2)

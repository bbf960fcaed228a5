"""What holds for all controllers, on every vehicle that they fit."""

import re
from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_loop import always, at, control_team, fly, hovering, one, team_of
from helpers import VEHICLES, assert_close, assert_finite, flying, jit_unoptimized, mostly_slow
from jax.flatten_util import ravel_pytree

from jaxdrones import rotation
from jaxdrones.accelerate.fitting import can_be_a_kernel
from jaxdrones.control import firmware_pid, for_team, geometric, mellinger, mrac, pid, rates, simple_pid, velocity
from jaxdrones.control.setpoint import Setpoint

DT = 1 / 240
N = 20  # drones in a batch; the same everywhere, so that each controller is compiled once
WEIGHTS = np.array([1.0, 2.0, 3.0, 4.0])


class Loop(NamedTuple):
    control: Callable
    gains: Callable[[], Any]
    init: Callable[[int], Any]
    vehicle: str

    def __repr__(self):
        return f"{self.control.__module__.split('.')[-1]}-{self.vehicle}"


def loops(module, *vehicles):
    return [Loop(module.control, module.gains, module.init, vehicle) for vehicle in vehicles]


PID = loops(pid, "cf2x", "cf2p")
VELOCITY = [Loop(velocity.control, pid.gains, pid.init, vehicle) for vehicle in pid.VEHICLES]
SIMPLE_PID = loops(simple_pid, "hb")
GEOMETRIC = loops(geometric, *VEHICLES)
RATES = loops(rates, *VEHICLES)
FIRMWARE = loops(firmware_pid, "cf2x")
MELLINGER = loops(mellinger, "cf2x")
MRAC = loops(mrac, "cf2x")
EVERY_PAIR = [*PID, *VELOCITY, *SIMPLE_PID, *GEOMETRIC, *RATES]
EVERY_CONTROLLER = [PID[0], VELOCITY[0], SIMPLE_PID[0], GEOMETRIC[0], RATES[0], *FIRMWARE, *MELLINGER, *MRAC]

each_pair = pytest.mark.parametrize("loop", EVERY_PAIR, ids=repr)
each_controller = pytest.mark.parametrize("loop", EVERY_CONTROLLER, ids=repr)


@pytest.mark.slow
@each_pair
def test_a_drone_where_it_should_be_gets_hover_speed(loop):
    team = team_of(*N * [loop.vehicle])
    _, rpm = call(loop.control, loop.gains(), team, for_team(loop.init(), N), hovering(team), stay(loop, team))
    np.testing.assert_allclose(rpm, np.broadcast_to(team.hover_rpm[:, None], (N, 4)), rtol=1e-12)


@pytest.mark.parametrize(
    "loop",
    mostly_slow(EVERY_CONTROLLER, [PID[0], SIMPLE_PID[0], GEOMETRIC[0], *MELLINGER, *MRAC]),
    ids=repr,
)
def test_rotor_speeds_are_within_what_the_motors_can_in_any_state(loop):
    """Of every vehicle, also one that is too heavy to fly, in gentle states and in wild ones."""
    team = team_of(*5 * VEHICLES)
    team = team.replace(mass=team.mass * jnp.repeat(jnp.array([1.0, 1, 1, 1, 20]), 4))
    rng = np.random.default_rng(9)
    for size in (0.01, 1, 100, 1e4):
        state = flying(team, seed=int(100 * size))
        state = state.replace(vel=size * state.vel, omega=size * state.omega)
        offset = [jnp.array(size * x) for x in rng.normal(size=(4, N, 3))]
        target = Setpoint(state.pos + offset[0], offset[1], offset[2], offset[3][:, 0], offset[3])
        target = jnp.column_stack([offset[0], offset[1][:, 0]]) if loop in VELOCITY else target
        memory = jax.tree.map(
            lambda x, size=size: jnp.asarray(size * rng.normal(size=x.shape)), for_team(loop.init(), N)
        )
        _, rpm = call(loop.control, loop.gains(), team, memory, state, target)
        assert jnp.all((rpm >= 0) & (rpm <= team.max_rpm[:, None]))


@pytest.mark.slow
@each_controller
def test_a_compiled_batch_equals_a_loop_over_drones(loop):
    team, memory, state, target = in_flight(loop)
    batch = call_optimized(loop.control, loop.gains(), team, memory, state, target)
    for i in range(3):
        alone = loop.control(loop.gains(), *(one(x, i) for x in (team, memory, state, target)), dt=DT)
        # RPM; the compiler may reorder sums, and a difference over dt multiplies their roundings by 1e7 PWM
        assert_close(one(batch, i), alone, atol=1e-6)


@pytest.mark.parametrize("loop", [PID[0], VELOCITY[0], GEOMETRIC[0], RATES[0]], ids=repr)
def test_turning_the_world_about_the_vertical_changes_no_rotor_speed(loop):
    """Of all but the simple PID, which heads north."""
    team, memory, state, target = in_flight(loop, size=gentle(loop))
    turned, turned_target, turned_memory = turn_world(1.2, state, target, memory)
    _, rpm = call(loop.control, loop.gains(), team, memory, state, target)
    _, again = call(loop.control, loop.gains(), team, turned_memory, turned, turned_target)
    assert jnp.min(jnp.std(rpm, axis=0)) > 1, "the cases should differ"
    np.testing.assert_allclose(again, rpm, rtol=0, atol=1e-5)  # RPM; as above


@pytest.mark.slow
@each_controller
def test_values_and_gradients_are_finite_where_directions_are_lost(loop):
    """No force, no velocity asked for, a target straight below; upside down, nose up or down: poles of roll and yaw."""
    half = 0.5**0.5
    below = jnp.array([0, 0, -10.0])
    level, over, up, down, aside = (
        jnp.array(q)
        for q in ([0.0, 0, 0, 1], [1.0, 0, 0, 0], [0, half, 0, half], [0, -half, 0, half], [half, 0, 0, half])
    )
    cases = product((0.0, 9.8), (0 * below, below), (level, over, up, down, aside))
    gravity, pos, quat = zip(*cases, strict=True)
    team = team_of(*N * [loop.vehicle]).replace(gravity=jnp.array(gravity))
    state = hovering(team, (0.0, 0.0, 0.0)).replace(quat=jnp.stack(quat))
    action = jnp.column_stack([jnp.stack(pos), jnp.ones(N)])
    target = action if loop in VELOCITY else Setpoint.at(jnp.stack(pos))
    gradients, rpm = differentiate(loop.control, (loop.gains(), team, state, target), for_team(loop.init(), N))
    assert_finite(rpm)
    assert_finite(gradients)


@pytest.mark.slow
@pytest.mark.parametrize("loop", [loop for loop in EVERY_CONTROLLER if loop not in MRAC], ids=repr)
def test_a_call_and_its_gradient_can_be_a_single_kernel(loop):
    """Without one, `over_worlds` takes many times as long. The matrices of `mrac` are too large."""
    params, memory, state, target = map(one, in_flight(loop))

    def squares(params, state, target):
        return jnp.sum(loop.control(loop.gains(), params, memory, state, target, dt=DT)[1] ** 2)

    for function in squares, jax.grad(squares, (0, 1, 2)):
        assert can_be_a_kernel(jax.make_jaxpr(function)(params, state, target).jaxpr)


@pytest.mark.slow
@each_controller
def test_gradients_of_a_call_agree_with_differences(loop):
    """In gains, parameters, state and target at once, along random directions."""
    team, memory, state, target = in_flight(loop, size=gentle(loop))
    inputs = (loop.gains(), team, state, target)
    gradients, rpm = differentiate(loop.control, inputs, memory)
    # Where a rotor starts to turn or reaches its limit there is no derivative, and few are there.
    assert jnp.mean(jnp.all((rpm > 0) & (rpm < team.max_rpm[:, None]), axis=1)) > 0.5, "most should be free"

    def cost(inputs):
        gains, team, state, target = inputs
        return jnp.sum(call(loop.control, gains, team, memory, state, target)[1] @ WEIGHTS)

    rng = np.random.default_rng(8)
    h = 1e-7  # relative to the largest number of each array
    for _ in range(5):
        step = jax.tree.map(lambda x: h * np.max(np.abs(x)) * rng.normal(size=x.shape), inputs)
        there, back = (jax.tree.map(lambda x, dx, s=sign: x + s * dx, inputs, step) for sign in (1, -1))
        derivative = sum(jax.tree.leaves(jax.tree.map(lambda g, dx: np.sum(g * dx), gradients, step)))
        difference = (cost(there) - cost(back)) / 2
        # Rounding is 1e-16 of 3e6 over 0.02, curvature 4e-7 where a rotor of the simple PID hardly turns.
        np.testing.assert_allclose(derivative, difference, rtol=2e-6)


@pytest.mark.parametrize("loop", [loop for loop in EVERY_CONTROLLER if loop not in RATES], ids=repr)
def test_a_time_between_calls_that_is_not_positive_is_refused(loop):
    """Of all but that of body rates, which does not use it."""
    team, memory, state, target = in_flight(loop)
    arguments = (one(x, 0) for x in (team, memory, state, target))
    with pytest.raises(ValueError, match=r"^dt is 0; give a number above 0 and at most 1 \(s\)$"):
        loop.control(loop.gains(), *arguments, dt=0)


@each_controller
def test_gains_that_are_not_finite_are_refused_and_infinite_limits_are_not(loop):
    team, memory, state, target = in_flight(loop)
    arguments = [one(x, 0) for x in (team, memory, state, target)]
    gains = loop.gains()
    for path, _ in jax.tree_util.tree_leaves_with_path(gains):
        name = jax.tree_util.keystr(path)
        for number in (jnp.nan, jnp.inf, -jnp.inf):
            if not (name.startswith(".max_") and number == jnp.inf):
                with pytest.raises(
                    ValueError, match=rf"^gains{re.escape(name)} is not finite: .*; give finite numbers$"
                ):
                    loop.control(with_last(gains, name, number), *arguments, dt=DT)
    unlimited = with_last(gains, ".max_", jnp.inf)
    jax.eval_shape(partial(loop.control, unlimited, dt=DT), *arguments)  # checks the gains, which `call` does not see
    assert_finite(call(loop.control, unlimited, team, memory, state, target))


def with_last(gains, name, number):
    """Gains with this last number where the name begins so."""
    return jax.tree_util.tree_map_with_path(
        lambda path, x: x.at[(-1,) * x.ndim].set(number) if jax.tree_util.keystr(path).startswith(name) else x, gains
    )


def test_the_inner_loop_refuses_gains_that_are_not_finite():
    team, _, state, _ = in_flight(RATES[0])
    gains = rates.gains().replace(rate=jnp.array([40, 40, jnp.inf]))
    with pytest.raises(ValueError, match=r"^gains\.rate is not finite"):
        rates.follow(gains, one(team, 0), one(state, 0), jnp.array(9.8), jnp.zeros(3))
    with pytest.raises(ValueError, match=r"^gains\.rate is not finite"):
        jax.vmap(partial(rates.follow, gains))(team, state, jnp.full(N, 9.8), jnp.zeros((N, 3)))


@each_controller
def test_without_weight_and_error_there_is_nothing_to_do(loop):
    """No rotor turns, but for the idle speed of the PID's motors and what the firmware takes for the weight."""
    team = team_of(*N * [loop.vehicle]).replace(gravity=jnp.zeros(N))
    _, rpm = call(loop.control, loop.gains(), team, for_team(loop.init(), N), hovering(team), stay(loop, team))
    believed = 36000 if loop in FIRMWARE else 132000 * 0.029 * 9.81 if loop in MELLINGER else 0
    idle = 9440.3 if loop in (*PID, *VELOCITY, *MRAC) else 0
    expected = idle + jnp.sqrt(believed / 65535 * 0.12 / team.kf[0])
    np.testing.assert_allclose(rpm, expected, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("loop", [PID[0], GEOMETRIC[0]], ids=repr)
def test_gradients_of_a_closed_loop_in_the_gains_agree_with_differences(loop):
    """A quarter of a second from 1 cm off, per relative change of each gain."""
    team = team_of(loop.vehicle)
    start = hovering(team, (0.01, -0.02, 1.01)).replace(vel=jnp.array([[0.02, 0.01, -0.03]]))
    targets = jax.tree.map(jnp.asarray, always(stay(loop, team), 60))
    gains, unravel = ravel_pytree(loop.gains())

    @jax.jit
    @jax.value_and_grad
    def cost(change):
        flown = fly.__wrapped__(
            loop.control, unravel(gains * (1 + change)), team, start, for_team(loop.init(), 1), targets, control_hz=240
        )
        off = flown.pos - jnp.array([[[0, 0, 1.0]]])
        return 1e4 * jnp.mean(jnp.sum(off**2 + 0.1 * flown.vel**2, axis=-1))

    n, h = len(gains), 1e-4
    differences = np.array([cost(h * change)[0] - cost(-h * change)[0] for change in np.eye(n)]) / (2 * h)
    assert np.sum(np.abs(differences) > 1e-4) >= n / 3
    # Central differences err by h^2 = 1e-8 relative and by rounding, 1e-16 * cost / h.
    np.testing.assert_allclose(cost(np.zeros(n))[1], differences, rtol=1e-5, atol=1e-7)


@pytest.mark.slow
@pytest.mark.float32
@each_pair
def test_float32_agrees_with_float64(loop):
    def rounded(x):
        return np.asarray(x, np.float32)

    situation = jax.tree.map(rounded, in_flight(loop, size=gentle(loop)))
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda x: jnp.asarray(x, float), situation)
        _, expected = call_optimized(loop.control, loop.gains(), *wide)
    _, rpm = call_optimized(loop.control, loop.gains(), *jax.tree.map(jnp.asarray, situation))
    assert rpm.dtype == jnp.float32 and expected.dtype == jnp.float64
    rpm, expected = np.asarray(rpm), np.asarray(expected)
    # Thrusts are sums and differences of terms as large as the largest, so it is squares that agree: to a few roundings
    # of 6e-8, of which the simple PID has more, as it divides differences of errors by 1/240 s. Measured: 4e-7, 5e-6.
    highest = np.max(expected**2, axis=1, keepdims=True)
    tolerance = 2e-5 if loop in SIMPLE_PID else 2e-6
    np.testing.assert_allclose(rpm**2 / highest, expected**2 / highest, rtol=0, atol=tolerance)


@each_controller
def test_arrays_of_a_team_are_refused(loop):
    arguments = dict(zip(("params", "memory", "state", "target"), in_flight(loop), strict=True))
    one_drone = {name: one(value) for name, value in arguments.items()}
    for name, of_a_team in arguments.items():
        if name != "memory":
            with pytest.raises(ValueError, match=rf"has shape \({N},.*expected .*one drone"):
                loop.control(loop.gains(), *(one_drone | {name: of_a_team}).values(), dt=DT)


@pytest.mark.parametrize("loop", [loop for loop in EVERY_CONTROLLER if loop not in VELOCITY], ids=repr)
def test_set_points_whose_squares_may_exceed_float32_are_refused(loop):
    """Their directions would be zero without a word, and the memory of an adaptive controller NaN for good."""
    team, memory, state, target = (one(x, 0) for x in in_flight(loop))
    for field, number in (("pos", -1e20), ("vel", jnp.nan), ("acc", jnp.inf), ("yaw", 1e15), ("omega", 1e10)):
        wrong = target.replace(**{field: jnp.full_like(getattr(target, field), number)})
        with pytest.raises(ValueError, match=rf"^setpoint\.{field} is .*; give finite numbers of at most 1e\+09"):
            loop.control(loop.gains(), team, memory, state, wrong, dt=DT)


def once(control, gains, team, memory, state, target):
    return control_team(control, gains, team, memory, state, target, dt=DT)


call = jit_unoptimized(once, static_argnums=0)
call_optimized = jax.jit(once, static_argnums=0)


@partial(jit_unoptimized, static_argnums=0)
def differentiate(control, inputs, memory):
    """Gradients of a weighted sum of rotor speeds in gains, team, state and target; and the speeds."""

    def weighted(inputs):
        gains, team, state, target = inputs
        rpm = control_team(control, gains, team, memory, state, target, dt=DT)[1]
        return jnp.sum(rpm @ WEIGHTS), rpm

    return jax.grad(weighted, has_aux=True)(inputs)


to_rpy = jit_unoptimized(jax.vmap(rotation.to_rpy))


def stay(loop, team):
    """Be at (0, 0, 1), or do not move."""
    n = len(team.mass)
    return jnp.zeros((n, 4)) if loop in VELOCITY else at(n, (0, 0, 1))


def gentle(loop):
    """A size of `in_flight` with which torques and rotor speeds seldom saturate."""
    return 0.1 if loop in (*GEOMETRIC, *RATES) else 0.01


def in_flight(loop, size=1.0):
    """Team, memory, state and target near each other; tilts of about `size` / 3 rad."""
    rng = np.random.default_rng(7)
    team = team_of(*N * [loop.vehicle])
    wild, calm = flying(team, tilt=0.1 * size), hovering(team)
    state = wild.replace(vel=size * wild.vel, omega=size * wild.omega, pos=calm.pos + size * (wild.pos - calm.pos))
    offset = [jnp.array(size * x) for x in rng.normal(size=(4, N, 3))]
    rpy = to_rpy(state.quat)
    if loop in VELOCITY:
        target = jnp.asarray(size * rng.normal(size=(N, 4)))
    else:
        target = Setpoint(
            pos=state.pos + offset[0], vel=offset[1], acc=offset[2], yaw=rpy[:, 2] + offset[3][:, 0], omega=offset[3]
        )
    memory = for_team(loop.init(), N)
    if loop in (*PID, *VELOCITY):
        memory = memory.replace(rpy=rpy - DT * state.omega)
    if loop in SIMPLE_PID:
        memory = memory.replace(pos_error=offset[0] + DT * state.vel, rpy_error=-rpy)
    return team, memory, state, target


@jit_unoptimized
def turn_world(yaw, state, target, memory):
    turn = rotation.exp(jnp.array([0, 0, yaw]))
    rotate = jax.vmap(partial(rotation.rotate, turn))
    turned = state.replace(
        pos=rotate(state.pos), vel=rotate(state.vel), quat=jax.vmap(partial(rotation.multiply, turn))(state.quat)
    )
    if isinstance(target, Setpoint):
        target = target.replace(
            pos=rotate(target.pos), vel=rotate(target.vel), acc=rotate(target.acc), yaw=target.yaw + yaw
        )
    else:
        target = jnp.column_stack([rotate(target[:, :3]), target[:, 3]])
    if memory is not None:
        memory = memory.replace(rpy=memory.rpy.at[:, 2].add(yaw))
    return turned, target, memory

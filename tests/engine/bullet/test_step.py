"""The Bullet step: equal to the explicit one in free flight, pure everywhere."""

import gc

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, assert_finite, assert_same_motion, flying, mostly_slow, tape

import jaxdrones
from jaxdrones import State
from jaxdrones.engine import bullet
from jaxdrones.sensing import Box, Scene

pytestmark = pytest.mark.needs("pybullet")

ROTORS = [jaxdrones.instant_rotors, jaxdrones.lagging_rotors]

EVERYTHING = dict(effects=(jaxdrones.drag, jaxdrones.ground_effect), pairs=(jaxdrones.downwash,))
LEVEL = [0.0, 0.0, 0.0, 1.0]


@pytest.fixture(scope="module")
def step():
    with bullet.make_step(**EVERYTHING) as step:
        yield step


@pytest.fixture(scope="module")
def team():
    return jaxdrones.stack([jaxdrones.load_params(vehicle) for vehicle in ("cf2x", "cf2p", "hb", "racer")])


def apart(state: State) -> State:
    """The same team, its drones metres apart and high up, so that nothing touches."""
    n = len(state.pos)
    return state.replace(pos=state.pos + jnp.stack([2.0 * jnp.arange(n), jnp.zeros(n), 3.0 + jnp.arange(n)], axis=-1))


@pytest.mark.parametrize("rotors", mostly_slow(ROTORS, [jaxdrones.lagging_rotors]))
def test_free_flight_equals_the_explicit_backend(team, rotors):
    """Also what the inertia of the rotors does."""
    team = team.replace(rotor_inertia=2e-3 * team.inertia[:, 2])
    start, commands = apart(flying(team, tilt=0.2)), np.asarray(tape(team, 120))
    explicit = jaxdrones.make_step(**EVERYTHING, rotors=rotors)
    with bullet.make_step(**EVERYTHING, rotors=rotors) as step:
        ours = theirs = start
        for command in commands:  # half a second
            ours, theirs = explicit(team, ours, command), step(team, theirs, command)
    assert_same_motion(theirs, ours, 1e-9)  # both integrate the same equations in float64 (measured: 1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("rotors", mostly_slow(ROTORS, [jaxdrones.lagging_rotors]))
def test_motors_are_limited_as_on_the_explicit_backend(team, rotors):
    """Commands of twice the highest speed and of -1,000 RPM, and a start out of range, fly as the nearest limits."""
    top = np.broadcast_to(np.asarray(team.max_rpm)[:, None], (4, 4))
    out = np.where(np.arange(4) % 2, 2 * top, -1000.0)
    starts = [apart(flying(team)).replace(rpm=jnp.asarray(rpm)) for rpm in (out, np.clip(out, 0, top))]
    with bullet.make_step(rotors=rotors) as step:
        ends = [step(team, step(team, start, out), out) for start in starts]
        assert_close(ends[1], step(team, step(team, starts[1], starts[1].rpm), starts[1].rpm), 0)
        unlimited = step(team.replace(max_rpm=jnp.full(4, jnp.inf)), starts[1], 2 * top)
    assert_close(*ends, 0)
    explicit = jaxdrones.make_step(rotors=rotors)
    assert_same_motion(ends[0], explicit(team, explicit(team, starts[0], out), out), 1e-9)
    assert_finite(unlimited)
    assert np.all(unlimited.rpm > ends[0].rpm)


@pytest.mark.slow
def test_substeps_are_repeated_steps(team, step):
    start, (command,) = apart(flying(team)), np.asarray(tape(team, 1))
    with bullet.make_step(**EVERYTHING, substeps=3) as three:
        once, compiled = three(team, start, command), jax.jit(three)(team, start, command)
    state = start
    for _ in range(3):
        state = step(team, state, command)
    assert_same_motion(once, state, 1e-12)
    assert_same_motion(compiled, state, 1e-12)


@pytest.mark.slow
def test_compiled_and_not_and_mapped_are_the_same(team, step):
    starts = [apart(flying(team, seed)) for seed in range(3)]
    (command,) = np.asarray(tape(team, 1))
    loop = [step(team, start, command) for start in starts]
    compiled = jax.jit(step)
    for start, expected in zip(starts, loop, strict=True):
        assert_same_motion(compiled(team, start, command), expected, 1e-12)
    worlds = jax.tree.map(lambda *leaves: jnp.stack(leaves), *starts)
    mapped = jax.jit(jax.vmap(step, in_axes=(None, 0, None)))(team, worlds, command)
    assert_close(mapped, jax.tree.map(lambda *leaves: np.stack(leaves), *loop), 1e-12)


@pytest.mark.slow
def test_worlds_may_differ_in_their_vehicles(step):
    masses = jnp.array([0.025, 0.03])
    start = State.at_rest(jnp.array([[0.0, 0.0, 1.0]]))
    crazyflie = jaxdrones.load_params("cf2x")

    def fall(mass):
        params = jaxdrones.repeat(crazyflie.replace(mass=mass), 1)
        return step(params, start, jnp.full((1, 4), 15000.0))

    mapped = jax.vmap(fall)(masses)
    for i, mass in enumerate(masses):
        assert_close(fall(mass).vel, mapped.vel[i], 1e-12)
    assert abs(float(mapped.vel[0, 0, 2] - mapped.vel[1, 0, 2])) > 1e-3


def falling(pos, quat=LEVEL, vel=(0.0, 0.0, 0.0)) -> State:
    return State(*(jnp.array([x], float) for x in (pos, quat, vel, [0, 0, 0], [0, 0, 0, 0])))


@pytest.mark.parametrize("place", [[0, 0, 1.0], [0, 0, 0.012], [0.05, 0.1, 0.011]])
@pytest.mark.slow
def test_the_same_input_gives_the_same_output_whatever_was_called_between(step, place):
    params = jaxdrones.repeat(jaxdrones.load_params("cf2x"), 1)
    state, still = falling(place, vel=(0.1, 0.0, -0.2)), np.zeros((1, 4))
    first = step(params, state, still)
    for pos, vel in (([3, 0, 0.012], (0, 0, -1.0)), ([0.01, 0, 0.01], (1.0, 0, 0)), ([0, 0, 5], (0, 0, 0))):
        step(params, falling(pos, vel=vel), still)
    step(
        jaxdrones.repeat(jaxdrones.load_params("racer"), 2),
        State.at_rest([[0, 0, 0.01], [0, 0, 0.02]]),
        np.zeros((2, 4)),
    )
    assert_close(step(params, state, still), first, 0.0)


@pytest.mark.slow
def test_a_rollout_is_the_same_in_a_loop_and_compiled(step):
    params, start = jaxdrones.repeat(jaxdrones.load_params("cf2x"), 1), falling([0, 0, 0.05], vel=(0.3, 0, 0))

    def fly(params, start):
        return jaxdrones.rollout(step, lambda p, memory, s, k: (memory, jnp.zeros((1, 4))), params, start, None, 40)

    final, trajectory = fly(params, start)
    assert trajectory.pos.shape == (40, 1, 3)
    assert_close(jax.jit(fly)(params, start)[1].pos, trajectory.pos, 1e-9)
    assert_close(final.pos, trajectory.pos[-1], 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", ["cf2x", "cf2p", "hb", "racer"])
def test_a_drone_at_rest_stays_at_rest(step, vehicle):
    params = jaxdrones.load_params(vehicle)
    height = float(params.collision_height / 2 - params.collision_offset)
    state = falling([0, 0, height])
    for _ in range(480):
        state = step(jaxdrones.repeat(params, 1), state, np.zeros((1, 4)))
    assert abs(state.pos[0, 2] - height) < 1e-3
    assert np.linalg.norm(state.pos[0, :2]) < 2e-3
    assert np.abs(state.omega).max() < 0.02 and np.abs(state.vel).max() < 2e-3


def test_an_obstacle_carries_a_drone():
    scene = Scene.of(Box(pos=(0, 0, 0.5), size=(0.4, 0.4, 0.2)))
    params, state = jaxdrones.repeat(jaxdrones.load_params("cf2x"), 1), falling([0, 0, 0.65])
    with bullet.make_step(scene=scene) as step:
        for _ in range(240):
            state = step(params, state, np.zeros((1, 4)))
    assert abs(state.pos[0, 2] - 0.6125) < 2e-3


@pytest.mark.slow
def test_float32_comes_back_as_float32(step):
    with jax.enable_x64(False):
        params = jaxdrones.repeat(jaxdrones.load_params("cf2x"), 1)
        state = step(params, State.at_rest([[0, 0, 1.0]]), np.full((1, 4), 14000.0))
        assert all(leaf.dtype == np.float32 for leaf in jax.tree.leaves(state))


@pytest.mark.slow
def test_ten_thousand_steps_leak_nothing(step):
    import resource

    params, still = jaxdrones.repeat(jaxdrones.load_params("cf2x"), 1), np.zeros((1, 4))

    def run(steps):
        state = falling([0, 0, 0.02])
        for _ in range(steps):
            state = step(params, state, still)
        gc.collect()
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # KiB

    before = run(1000)
    assert run(10_000) - before < 4096


# What goes wrong


def test_a_gradient_is_refused_and_the_explicit_backend_named(team, step):
    start, (command,) = apart(flying(team)), tape(team, 1)
    with pytest.raises(TypeError, match=r"no gradient.*jaxdrones\.make_step"):
        jax.grad(lambda rpm: jnp.sum(step(team, start, rpm).pos))(command)


def test_a_closed_step_says_so(team):
    step = bullet.make_step()
    start, (command,) = apart(flying(team)), np.asarray(tape(team, 1))
    step.close()
    step.close()
    for call in (
        lambda: step(team, start, command),
        lambda: step.contacts(team, start),
        lambda: step.camera(team, start),
    ):
        with pytest.raises(ValueError, match=r"closed.*`with` block"):
            call()


def test_a_state_that_is_not_finite_is_refused(team, step):
    start, (command,) = apart(flying(team)), np.asarray(tape(team, 1))
    broken = start.replace(vel=start.vel.at[1, 2].set(jnp.nan))
    for call in (lambda: step(team, broken, command), lambda: step.contacts(team, broken)):
        with pytest.raises(ValueError, match=r"state\.vel is not finite"):
            call()
    with pytest.raises(ValueError, match="rpm is not finite"):
        step(team, start, command * np.inf)


def test_a_quaternion_that_is_no_attitude_and_constants_that_do_not_fly_are_refused(team, step):
    start, (command,) = apart(flying(team)), np.asarray(tape(team, 1))
    for quat in (jnp.zeros(4), jnp.array([0, 0, 0, 2.0])):
        broken = start.replace(quat=start.quat.at[1].set(quat))
        for call in (lambda b=broken: step(team, b, command), lambda b=broken: step.camera(team, b)):
            with pytest.raises(ValueError, match=r"state\.quat has length .*give a unit quaternion"):
                call()
    with pytest.raises(ValueError, match=r"params\.mass is \[.*give positive numbers"):
        step(team.replace(mass=-team.mass), start, command)


def test_a_wrong_shape_is_refused(team, step):
    start, (command,) = apart(flying(team)), np.asarray(tape(team, 1))
    with pytest.raises(ValueError, match=r"rpm has shape \(3, 4\).*4 drones"):
        step(team, start, command[:3])
    with pytest.raises(ValueError, match=r"params\.mass has shape \(\).*repeat"):
        step(jaxdrones.load_params("cf2x"), start, command)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(dt=0), "dt is 0"),
        (dict(substeps=0), "substeps is 0"),
        (dict(damping=-1), "damping is -1"),
        (dict(collision="sphere"), "unknown collision shape 'sphere'.*balls, cylinder"),
        (dict(renderer="opengl"), "unknown renderer 'opengl'.*egl, tiny"),
        (dict(effects=("drag",)), "'drag' is not a function"),
    ],
)
def test_a_wrong_option_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        bullet.make_step(**options)


def test_without_pybullet_the_error_names_the_extra_and_the_python_limit(monkeypatch):
    import sys

    monkeypatch.delitem(sys.modules, "pybullet", raising=False)
    monkeypatch.setattr(sys, "path", [])
    monkeypatch.setattr(sys, "path_importer_cache", {})
    with pytest.raises(ImportError, match=r"pip install .*\[bullet\]\".*CPython 3\.11"):
        bullet.make_step()

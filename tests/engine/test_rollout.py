"""Many steps in one program."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import CONSTANTS, STATE, assert_close, flying, jit_unoptimized, tape

import jaxdrones
from jaxdrones import State, drag

team = jaxdrones.repeat(jaxdrones.load_params("cf2x"), 2)
step = jaxdrones.make_step((drag,))
start = flying(team)
commands = tape(team, 20)


def replay(params, memory, state, k):
    return memory, commands[k]


def damp_climb(params, memory, state, k):
    """A controller that keeps something: the summed climb rate."""
    memory = memory + state.vel[:, 2:]
    return memory, params.hover_rpm[:, None] - 100 * memory - 50 * jnp.ones((1, 4))


def test_a_rollout_is_a_loop_of_steps():
    final, trajectory = jaxdrones.rollout(step, replay, team, start, None, 5)
    state = start
    for k in range(5):
        state = step(team, state, commands[k])
        assert_close(
            jax.tree.map(lambda x, k=k: x[k], trajectory), state, 1e-12
        )  # the same operations, fused otherwise
    # XLA may compute the carry of a scan and its row apart, each with a rounding of its own (jax 0.12: 6e-17).
    assert_close(final, jax.tree.map(lambda x: x[-1], trajectory), 1e-15, rtol=1e-15)


@pytest.mark.slow
def test_two_halves_equal_one_rollout():
    """The count starts anew, so the second half reads its commands from where the first one stopped."""

    def replay_from_8(params, memory, state, k):
        return memory, commands[8 + k]

    final, whole = jaxdrones.rollout(step, replay, team, start, None, 20)
    middle, first = jaxdrones.rollout(step, replay, team, start, None, 8)
    end, second = jaxdrones.rollout(step, replay_from_8, team, middle, None, 12)
    assert_close(jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, second), whole, 1e-12)
    assert_close(end, final, 1e-12)


def test_the_controller_gets_its_memory_back():
    final, _ = jaxdrones.rollout(step, damp_climb, team, start, jnp.zeros((2, 1)), 10)
    state, memory = start, jnp.zeros((2, 1))
    for k in range(10):
        memory, rpm = damp_climb(team, memory, state, k)
        state = step(team, state, rpm)
    assert_close(final, state, 1e-10)  # feedback of 100 RPM per m/s


def test_memory_may_be_any_pytree():
    def count(params, memory, state, k):
        return {"calls": memory["calls"] + 1}, jnp.full((2, 4), 100.0) * memory["calls"]

    _, trajectory = jaxdrones.rollout(step, count, team, start, {"calls": 0}, 4)
    np.testing.assert_array_equal(trajectory.rpm[:, 0, 0], [0, 100, 200, 300])


@pytest.mark.slow
def test_rollouts_of_many_worlds_come_from_vmap():
    worlds = jax.tree.map(lambda x: jnp.stack([x, 0.9 * x]), start)
    worlds = worlds.replace(quat=jnp.stack([start.quat, start.quat[::-1]]))
    final, _ = jax.vmap(lambda s: jaxdrones.rollout(step, replay, team, s, None, 5))(worlds)
    for i in range(2):
        world = jax.tree.map(lambda x, i=i: x[i], worlds)
        alone, _ = jaxdrones.rollout(step, replay, team, world, None, 5)
        assert_close(jax.tree.map(lambda x, i=i: x[i], final), alone, 1e-12)


@pytest.mark.parametrize("length", [0, -3, 2.5, "ten"])
def test_the_length_is_a_whole_number_of_steps(length):
    with pytest.raises(ValueError, match=f"length is {length!r}.*at least 1"):
        jaxdrones.rollout(step, replay, team, start, None, length)


@pytest.mark.parametrize("name", STATE)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_start_that_is_not_finite_is_named(name, value):
    broken = start.replace(**{name: getattr(start, name).at[1, 0].set(value)})
    with pytest.raises(ValueError, match=rf"state\.{name} is not finite.*{value}"):
        jaxdrones.rollout(step, replay, team, broken, None, 1)


@pytest.mark.parametrize("name", CONSTANTS)
def test_constants_that_are_not_finite_are_named(name):
    broken = team.replace(**{name: jnp.full_like(getattr(team, name), np.nan)})
    with pytest.raises(ValueError, match=rf"params\.{name} is not finite.*nan"):
        jaxdrones.rollout(step, replay, broken, start, None, 1)


def test_a_highest_rotor_speed_below_zero_is_named():
    broken = team.replace(max_rpm=jnp.array([2e4, -1.0]))
    with pytest.raises(ValueError, match=r"params\.max_rpm is \[20000\.0, -1\.0\]; give positive numbers"):
        jaxdrones.rollout(step, replay, broken, start, None, 1)


def test_a_controller_of_one_drone_in_a_team_of_two_is_told_so():
    with pytest.raises(ValueError, match=r"rpm has shape \(4,\); expected \(2, 4\)"):
        jaxdrones.rollout(step, lambda params, memory, state, k: (memory, commands[0, 0]), team, start, None, 1)


def test_numbers_under_jit_cannot_be_looked_at_and_pass():
    broken = start.replace(vel=start.vel.at[0, 0].set(jnp.nan))
    fly = jit_unoptimized(lambda s: jaxdrones.rollout(step, replay, team, s, None, 1)[0])
    assert isinstance(fly(broken), State)


@pytest.mark.slow
def test_checkpoints_change_memory_and_neither_the_flight_nor_its_gradient():
    def miss(start, checkpoint=None, length=100):
        final, _ = jaxdrones.rollout(step, damp_climb, team, start, jnp.zeros((2, 1)), length, checkpoint)
        return jnp.sum(final.pos**2)

    flown = [jaxdrones.rollout(step, damp_climb, team, start, jnp.zeros((2, 1)), 20, every) for every in (None, 5)]
    assert_close(flown[1], flown[0], 1e-12)
    plain, kept = (
        jax.jit(jax.grad(lambda s, every=every: miss(s, every))).lower(start).compile() for every in (None, 10)
    )
    assert_close(kept(start), plain(start), 1e-12, 1e-10)
    memory = [program.memory_analysis().temp_size_in_bytes for program in (plain, kept)]
    assert memory[1] < memory[0] / 2


@pytest.mark.parametrize("every", [0, 7, 2.0])
def test_a_checkpoint_divides_the_flight(every):
    with pytest.raises(ValueError, match="checkpoint"):
        jaxdrones.rollout(step, replay, team, start, None, 20, every)


@pytest.mark.parametrize(
    ("control", "message"),
    [
        (lambda *_: commands[0], r"control returned an array of shape \(2, 4\); return \(memory, rpm\)"),
        (lambda *_: None, r"control returned None; return \(memory, rpm\)"),
        (lambda *_: (None, commands[0], 1), r"control returned \(None, .*; return \(memory, rpm\)"),
        (
            lambda *_: ({"a": 1}, commands[0]),
            r"control was given the memory .* and returned .*'a'.* of the same structure",
        ),
        (
            lambda params, memory, state: None,
            r"control: <lambda> takes .*; give a function of \(params, memory, state, k\)",
        ),
        ("replay", r"control: 'replay' is not a function; give for example lambda params, memory, state, k"),
    ],
)
def test_a_controller_that_answers_something_else_is_told_what_to_return(control, message):
    with pytest.raises(ValueError, match=message):
        jaxdrones.rollout(step, control, team, start, None, 2)

"""What counts as passing a gate, what as hitting it, and where a race starts."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized

from jaxdrones import load_params, repeat
from jaxdrones.envs import make
from jaxdrones.sensing import Scene, track
from jaxdrones.tasks import racetrack
from jaxdrones.tasks.gates import FRAME, GATES, OPENING, POLES, gates
from jaxdrones.tasks.racetrack import direction
from jaxdrones.tasks.starts import standing_height

ENV = functools.cache(lambda: make("gates"))
RADIUS = float(load_params("cf2x").collision_radius)
THROUGH, LEFT = np.array([0.1, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])


advance = jit_unoptimized(lambda world: ENV().task.advance(ENV().task, world))
start_of_race = functools.cache(lambda: jit_unoptimized(ENV().reset)(jax.random.key(0))[1])


def moved(start, end, index=0, steps=0):
    """The task's variables after a drone went from one place to another within a step."""
    world = start_of_race().replace(step=jnp.asarray(steps, jnp.int32))
    variables = world.variables | {"pos": jnp.array([start]), "index": jnp.array([index])}
    world = world.replace(drones=world.drones.replace(pos=jnp.array([end])), variables=variables)
    return advance(world)


def in_gate(offset, gate=GATES[0]):
    """A place given in the axes of a gate: through it, to its left, up."""
    cos, sin = np.cos(gate[3]), np.sin(gate[3])
    return gate[:3] + np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ offset


@pytest.mark.parametrize(
    ("aside", "passes", "hits"),
    [
        (0.0, 1, False),
        (OPENING / 2 - RADIUS - 0.01, 1, False),
        (OPENING / 2 - RADIUS + 0.01, 1, True),
        (-OPENING / 2 - FRAME / 2, 0, True),
        (OPENING / 2 + FRAME + RADIUS + 0.01, 0, False),
    ],
)
@pytest.mark.slow
def test_a_gate_is_passed_by_its_opening_hit_by_its_frame_and_missed_beside_it(aside, passes, hits):
    after = moved(in_gate(aside * LEFT - THROUGH), in_gate(aside * LEFT + 0.05 * THROUGH))
    assert after["index"][0] == passes and bool(after["hit"][0]) == hits


def test_the_time_penalty_costs_every_step_and_a_crash_sixty_of_them():
    """Until the drone has passed the last gate, in the step after which nothing is charged."""
    hurried, last = make("gates", time_penalty=0.5), len(GATES) - 1
    into = OPENING / 2 + FRAME / 2

    @jit_unoptimized
    def cost(world):
        return [sum(w * term(env.task, world) for w, term in env.task.rewards.values()) for env in (ENV(), hurried)]

    for aside, index, penalty in ((0.0, 0, 0.5), (0.0, last, 0.5), (0.0, last + 1, 0), (into, 0, 0.5 + 60 * 0.5)):
        gate = GATES[min(index, last)]
        after = moved(in_gate(aside * LEFT - THROUGH, gate), in_gate(aside * LEFT + 0.05 * THROUGH, gate), index)
        plain, less = cost(start_of_race().replace(variables=after))
        np.testing.assert_allclose(plain - less, penalty, rtol=1e-6)


def test_a_frame_between_the_places_of_two_control_steps_is_hit():
    beside = (OPENING / 2 + FRAME / 2) * LEFT
    assert moved(in_gate(beside - 5 * THROUGH), in_gate(beside + 5 * THROUGH))["hit"][0]


def test_other_gates_than_the_next_one_are_hit_too():
    assert moved(in_gate(-THROUGH, GATES[2]), in_gate((OPENING / 2) * LEFT, GATES[2]))["hit"][0]


def test_a_gate_counts_in_its_direction_and_in_its_turn():
    there, back = in_gate(-THROUGH), in_gate(THROUGH)
    assert moved(back, there)["index"][0] == 0
    assert moved(there, back, index=1)["index"][0] == 1


def test_after_the_last_gate_nothing_counts():
    after = moved(in_gate(-THROUGH, GATES[-1]), in_gate(0.5 * THROUGH, GATES[-1]), index=len(GATES))
    assert after["index"][0] == len(GATES) and after["progress"][0] == 0


def test_the_lap_time_runs_to_the_last_gate():
    there = jnp.array([5.0, 5.0, 1.0])
    racing, done = (moved(there, there, index, steps=120) for index in (0, len(GATES)))
    np.testing.assert_allclose(racing["lap_time"], 120 * ENV().dt)
    assert done["lap_time"].tolist() == start_of_race().variables["lap_time"].tolist() != racing["lap_time"].tolist()


def test_poles_are_hit_as_high_as_they_are():
    place = np.array([*POLES[0], 1.0])
    assert moved(place + 0.5, place)["hit"][0]
    assert not moved(place + 0.5, place + np.array([0, 0, 0.7]))["hit"][0]


def test_progress_is_the_distance_gained_on_the_next_gate():
    start, end = in_gate(-10 * THROUGH), in_gate(-3 * THROUGH)
    np.testing.assert_allclose(moved(start, end)["progress"], 0.7, rtol=1e-12)


def test_who_starts_in_the_air_starts_before_its_gate():
    task = gates(drones=2, random_start=True)
    begin = jax.vmap(lambda key: task.begin(key, repeat(load_params("cf2x"), 2), task.scene))
    state, variables = jit_unoptimized(begin)(jax.random.split(jax.random.key(0), 100))
    index = np.asarray(variables["index"])
    grounded = np.asarray(state.pos)[..., 2] < 0.1
    assert 0.1 < np.mean(grounded) < 0.3 and {*index[~grounded]} == {0, 1, 2, 3}
    before = np.sum((GATES[index][..., :3] - state.pos) * direction(jnp.asarray(GATES[index])), axis=-1)[~grounded]
    assert 0.25 < before.min() and before.max() < 1.15 and abs(before.mean() - 0.7) < 0.05


def test_a_team_has_finished_when_all_have_passed_all_gates():
    finished = gates(drones=2).terminations["finished"]
    for index, over in ((4, 3), False), ((4, 4), True):
        assert finished(None, SimpleNamespace(variables={"index": jnp.array(index)})).tolist() == [over] * 2


def test_a_drone_that_stands_has_not_crashed_and_one_below_the_ground_has():
    params = repeat(load_params("cf2x"), 3)
    pos = jnp.zeros((3, 3)).at[:, 2].set(standing_height(params) - jnp.array([0, 0.009, 0.011]))
    world = SimpleNamespace(params=params, drones=SimpleNamespace(pos=pos), variables={"hit": jnp.zeros(3, bool)})
    assert racetrack.crashed(None, world).tolist() == [False, False, True]


def test_a_random_track_is_counterclockwise_with_a_gate_in_every_quarter():
    for u in (0.0, 1.0):
        place = [[1.3, 0], [0, 0.9], [-1.3, 0], [0, -0.9]]
        expected = [
            [*xy, 0.95, heading] for xy, heading in zip(place, np.pi * np.array([0.5, 1, -0.5, 0]), strict=True)
        ]
        found = racetrack._random_track(jnp.full((4, 4), u))
        np.testing.assert_allclose(found, np.array(expected) + u * np.array([0.25, 0.25, 0.25, 0.6]), atol=1e-12)


def test_every_moment_of_inertia_has_a_random_factor_of_its_own():
    one = load_params("cf2x")
    factor = racetrack.randomization_of(1)[0](jax.random.key(0), one).inertia / one.inertia
    assert len(np.unique(factor)) == 3 and np.all(np.abs(factor - 1) <= 0.2)


@pytest.mark.slow
def test_who_starts_anywhere_starts_at_the_start_one_time_in_five_and_else_before_a_gate():
    env = make("gates", random_start=True, level=2)
    worlds = jit_unoptimized(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 2000))[1]
    z, index = worlds.drones.pos[:, 0, 2], worlds.variables["index"][:, 0]
    grounded = z < 0.1
    assert abs(jnp.mean(grounded) - 0.2) < 0.04  # 4 standard deviations
    assert jnp.all(index[grounded] == 0)
    np.testing.assert_allclose(np.bincount(index[~grounded]) / 1600, 0.25, atol=0.05)


def test_poles_are_seen_from_the_drone_as_far_as_sight_goes():
    env = make("gates", observation=("position", "poles"))
    obs = np.asarray(env.reset(jax.random.key(0))[0])
    np.testing.assert_allclose(obs[0, 3:].reshape(4, 2), np.clip(POLES - obs[0, :2], -3, 3), rtol=1e-12)


@pytest.mark.slow
def test_levels_move_gates_and_poles_within_their_ranges_and_keep_random_gates_apart():
    def drawn(level):
        env = make("gates", level=level)
        return jit_unoptimized(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), 200))[1].variables

    for level in (0, 1):
        np.testing.assert_allclose(drawn(level)["gates"], np.broadcast_to(GATES, (200, 4, 4)), atol=1e-12)
    off = np.abs((np.asarray(drawn(2)["gates"]) - GATES + np.pi) % (2 * np.pi) - np.pi)  # headings are a circle
    assert np.all(off <= [0.15, 0.15, 0.1, 0.2]) and np.all(off.max((0, 1)) > [0.14, 0.14, 0.09, 0.19])
    assert np.max(np.abs(np.asarray(drawn(2)["poles"]) - POLES)) <= 0.15
    centers = np.asarray(drawn(3)["gates"])[..., :3]
    apart = np.linalg.norm(centers[:, :, None] - centers[:, None], axis=-1) + 10 * np.eye(4)
    assert apart.min() > OPENING + 2 * FRAME


def test_a_track_of_ones_own_is_flown_and_a_scene_without_gates_says_what_to_give():
    own = np.array([(0.0, 0.5 * i, 1.0, 0.3) for i in range(4)])
    variables = jit_unoptimized(make("gates", scene=track(own)).reset)(jax.random.key(0))[1].variables
    np.testing.assert_allclose(variables["gates"], own, atol=1e-12)
    with pytest.raises(ValueError, match=r"whose first 16 boxes .* has 0 boxes; give one of jaxdrones.sensing.track"):
        make("gates", scene=Scene())

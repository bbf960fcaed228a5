"""The leaderboard scores all pilots on the same starts, on which none was tuned or trained."""

import argparse
import dataclasses
import json

import jax
import numpy as np
import pytest
from helpers import jit_unoptimized

from benchmarks import leaderboard, tables
from benchmarks.leaderboard_pilots import PILOTS, Controller, controller
from benchmarks.leaderboard_scenarios import SCENARIOS, SCORED, TRAINING, TUNING, broken_rotor, vehicle
from jaxdrones.control import geometric

SETTINGS = ["--quick", "--pilot", "nothing", "geometric", "--scenario", "hover"]


def starts(pilot: str, seed: int, count: int = 8) -> np.ndarray:
    env = PILOTS[pilot].env(SCENARIOS["hover"])
    keys = jax.random.split(jax.random.key(seed), count)
    drones = jit_unoptimized(jax.vmap(lambda key: env.reset(jax.random.split(key)[0])[1].drones))(keys)
    return np.concatenate([np.asarray(x).reshape(count, -1) for x in (drones.pos, drones.quat, drones.vel)], axis=1)


@pytest.fixture(scope="module")
def rows():
    flown = []
    for name in ("nothing", "geometric"):
        pilot = dataclasses.replace(PILOTS[name], candidates=16, tuning_starts=4)
        flown += leaderboard.fly(name, pilot, ["hover"], 4)
    return flown


@pytest.mark.slow
def test_all_pilots_have_the_same_starts_and_few_starts_are_the_first_of_many():
    for pilot in ("firmware-pid", "lqr", "mpc", "bptt", "raptor"):
        np.testing.assert_array_equal(starts(pilot, SCORED), starts("pid", SCORED))
    np.testing.assert_array_equal(starts("pid", SCORED, 16)[:8], starts("pid", SCORED))


def test_scored_starts_are_others_than_those_of_tuning_and_training():
    assert len({SCORED, TUNING, TRAINING}) == 3
    scored, tuning = starts("pid", SCORED, 64), starts("pid", TUNING, 64)
    assert np.min(np.linalg.norm(scored[:, None] - tuning[None], axis=-1)) > 1e-3


@pytest.mark.slow
def test_a_pilot_that_does_nothing_never_succeeds(rows):
    assert rows[0]["pilot"] == "nothing" and rows[0]["success"] == 0
    assert rows[1]["success"] > 0 and rows[1]["distinct"] == 4


@pytest.mark.slow
def test_a_row_reports_success_error_effort_and_costs(rows):
    for row in rows:
        low, high = row["interval"]
        assert 0 <= low <= row["success"] <= high + 1e-12 and high <= 1
        assert row["error p99"] >= row["error p50"] > 0 and row["seconds a command"] > 0
    assert rows[0]["flown"] == 0 and rows[1]["flown"] == pytest.approx(16 * 4 * 5.0)


@pytest.mark.slow
def test_the_page_is_written_from_the_results(rows, tmp_path):
    page = tmp_path / "page.md"
    page.write_text("Table:\n\n<!-- measured: leaderboard -->\n<!-- end -->\n")
    leaderboard.write(rows, tmp_path / "rows.json", page, tmp_path / "figure.png")
    result = json.loads((tmp_path / "rows.json").read_text())
    assert tables.rewritten(page.read_text(), {"leaderboard": result}) == page.read_text()
    assert "geometric" in page.read_text() and result["about"]["commit"] in page.read_text()
    assert (tmp_path / "figure.png").is_file()


def test_a_share_is_never_rounded_up():
    assert leaderboard.percent(0.9996) == "99.9" and leaderboard.percent(0.999) == "99.9"
    assert leaderboard.percent(1.0) == "100.0"


@pytest.mark.slow
def test_a_controller_commands_the_rotor_speeds_that_its_module_computes():
    env = PILOTS["geometric"].env(SCENARIOS["hover"])
    obs, world = env.reset(jax.random.key(0))
    policy = controller(geometric, env)(np.ones(4))
    assert isinstance(policy, Controller)
    action = policy.act(policy.initial_hidden_state((1,)), obs)[1]
    one = jax.tree.map(lambda x: x[0], (world.drones, env.task.target_now(world)))
    rpm = policy.module.control(policy.gains, policy.params, None, *one, dt=env.dt)[1]
    commanded = env.action.rpm(policy.params, None, None, action[0], None, env.dt)[1]
    np.testing.assert_allclose(commanded, rpm, rtol=1e-5, atol=0.1)  # RPM


def test_a_broken_rotor_has_seven_tenths_of_its_thrust():
    health = broken_rotor(jax.random.key(0), vehicle()).aux["rotor_health"]
    np.testing.assert_allclose(np.sort(health**2), [0.7, 1, 1, 1], rtol=1e-6)


@pytest.mark.slow
def test_the_command_makes_one_row_a_pilot():
    parser = argparse.ArgumentParser()
    leaderboard.add_arguments(parser)
    parser.add_argument("--quick", action="store_true")
    result, printed = leaderboard.main(parser.parse_args(SETTINGS))
    assert [row["pilot"] for row in result["rows"]] == ["nothing", "geometric"]
    assert printed[0].startswith("success, %") and printed[1].startswith("nothing")

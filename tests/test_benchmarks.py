"""The benchmarks run and say what they measured."""

import ast
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones as jd
from benchmarks import accelerator, lap, published, transfer
from benchmarks.__main__ import NAMES
from benchmarks.common import success_rate
from jaxdrones.visualization.browser import find_browser

ROOT = Path(__file__).parent.parent
SECTIONS = {"tests", "plant", "cameras", "envs", "swarm", "learning"}


def benchmark(name: str, *options: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "benchmarks", name, *options]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)


def quick(name: str, *options: str) -> dict:
    return json.loads(benchmark(name, "--quick", "--json", *options).stdout)


@pytest.mark.slow
def test_throughput_reports_what_a_step_is_and_every_rate():
    result = quick("throughput")
    assert {"dt", "substeps", "integrator", "effects", "dtype", "many worlds"} <= set(result["about"])
    assert {"commit", "jax", "device", "cores"} <= set(result["about"])
    assert [row["worlds"] for row in result["rows"]] == [1, 32]
    for row in result["rows"]:
        assert row["forward"] > 0 and row["with backward"] > 0 and row["time over forward"] > 0


@pytest.mark.slow
def test_swarm_and_scaling_report_every_way_to_fly():
    alone, crowd = quick("swarm")["rows"]
    assert "cells" not in alone and min(crowd[way] for way in ("all pairs", "cells", "gym-pybullet-drones")) > 0
    for row in quick("scaling")["rows"]:
        assert {"held", "controlled"} <= set(row["rates"]) and min(row["rates"].values()) > 0
        assert set(row["memory"]) == set(row["compile"]) == set(row["rates"])


@pytest.mark.slow
def test_power_reports_every_case_both_ways():
    rows = quick("power")["rows"]
    assert len(rows) == 18 and all(row["ratio"] > 0 for row in rows)


@pytest.mark.slow
def test_battery_finds_the_resistance_that_a_flight_was_made_with(tmp_path):
    """The voltage of a flight by the model itself: 2 s at rest, 3 s with the motors on."""
    params = jd.load_params("cf2x").replace(
        aux={"battery": jd.lithium_polymer(resistance=0.37), "motors": jd.crazyflie_motors()}
    )
    step = jd.make_step(rotors=jd.pwm_rotors, models=(jd.battery(),), dt=0.005, substeps=2)
    time = np.arange(500) / 100
    pwm = jnp.asarray(np.where(time < 2, 0.0, 50e3)[:, None] * np.ones(4))
    team = jd.repeat(params, 1)
    start = jd.State.at_rest(np.zeros((1, 3)))
    states = jd.rollout(step, lambda p, m, s, k: (m, pwm[k][None]), team, start, None, len(pwm))[1]
    volts = jax.vmap(jax.vmap(jd.battery_voltage), (None, 0))(team, states)[:, 0]
    np.savez(tmp_path / "flight.npz", t=time, pwm=pwm, vbat=volts)
    (row,) = quick("battery", str(tmp_path / "flight.npz"), "--seconds", "2")["rows"]
    assert abs(row["resistance"] - 0.37) < 0.005 and row["rms"] < 0.005


@pytest.mark.slow
def test_startup_loads_nothing_optional():
    result = quick("startup")
    assert result["loaded"] == [] and len(result["seconds"]) == 3


@pytest.mark.slow
@pytest.mark.needs("pybullet")
def test_bullet_reports_four_rates():
    rates = quick("bullet")["rates"]
    assert len(rates) == 4 and min(rates.values()) > 0


@pytest.mark.slow
def test_cameras_report_both_scenes_in_every_way():
    rows = quick("cameras")["rows"]
    assert {row["scene"] for row in rows} == {"A", "B"}
    for row in rows:
        assert len(row["rates"]) == 5 and min(row["rates"].values()) > 0


@pytest.mark.slow
def test_optimal_reports_error_and_time_of_every_controller():
    rows = quick("optimal")["rows"]
    assert {"pid", "geometric", "lqr", "ilqr", "mppi"} <= {row["controller"] for row in rows}
    assert all(0 < row["rms"] < 0.2 and row["ms"] > 0 for row in rows)


@pytest.mark.slow
def test_firmware_reports_agreement_and_cost():
    result = quick("firmware")
    (row,) = result["rows"]
    assert max(row["roll"], row["pitch"]) < 0.3 and abs(row["pwm_ratio"] - 1) < 0.01
    assert min(cost["seconds"] for cost in result["costs"].values()) > 0


@pytest.mark.slow
def test_tuning_reports_errors_before_and_after():
    (row,) = quick("tuning")["rows"]
    assert row["controller"] == "geometric" and row["seconds"] > 0
    assert row["after"][0] < row["before"][0] < 0.1


@pytest.mark.slow
def test_envs_reports_a_rate_of_every_environment():
    result = quick("envs")
    assert len(result["rates"]) == 8 and min(result["rates"].values()) > 0


@pytest.mark.slow
@pytest.mark.skipif(find_browser() is None, reason="there is no Chromium")
def test_viewer_reports_frames_per_second():
    (row,) = quick("viewer")["rows"]
    assert row["frames/s"] > 0 and 0 < row["share"] <= 1


@pytest.mark.slow
def test_devices_reports_one_and_all():
    (row,) = quick("devices")["rows"]
    assert row["one"] > 0 and row["all"] > 0


@pytest.mark.slow
def test_options_reports_every_set_that_the_compiler_knows():
    result = quick("options")
    (row,) = result["rows"]
    assert set(row["run"]) == set(row["compile"]) == set(result["options"]) - set(result["unknown"])
    assert len(row["run"]) >= 7 and min(*row["run"].values(), *row["compile"].values()) > 0


@pytest.mark.slow
def test_learning_reports_every_seed():
    rows = quick("learning")["rows"]
    assert rows and all(0 <= row["success"] <= 1 for row in rows)


@pytest.mark.needs("pybullet")
@pytest.mark.slow
@pytest.mark.needs("onnx", "onnxruntime", "flatbuffers")
@pytest.mark.skipif(not (shutil.which("cc") and shutil.which("node")), reason="cc or node is not installed")
def test_export_reports_costs_differences_and_success():
    rows = quick("export")["rows"]
    assert [row["policy"] for row in rows] == ["hover", "recovery, GRU"]
    assert all(max(row["differences"].values()) < 1e-3 and row["code"] > 100 for row in rows)
    assert all(row["success"][0] == row["success"][1] for row in rows)


@pytest.mark.slow
def test_accelerator_runs_every_section_and_names_the_source_of_every_ratio(tmp_path):
    result = quick("accelerator", "--output", str(tmp_path / "result.json"))
    assert not result["stopped"] and {row["section"] for row in result["rows"]} == SECTIONS
    assert json.loads((tmp_path / "result.json").read_text()) == {key: x for key, x in result.items() if key != "lines"}
    for row in result["rows"]:
        assert row["value"] > 0 and all(figure["ratio"] > 0 and figure["source"] for figure in row.get("published", ()))
    assert result["rows"][0]["failed"] == []


@pytest.mark.slow
@pytest.mark.needs("foundation_policy")
def test_any_vehicle_reports_every_policy_in_every_condition():
    rows = quick("any_vehicle")["rows"]
    assert [(row["condition"], row["policy"]) for row in rows] == [
        (condition, policy) for condition in ("cf2x", "drawn") for policy in ("raptor", "any-vehicle")
    ]


@pytest.mark.slow
def test_self_play_reports_teams_and_single_drones_of_every_policy():
    rows = quick("self_play")["rows"]
    assert [(row["policy"], row["drones"]) for row in rows] == [
        (name, drones) for name in ("alone", "blind", "self-play", "league") for drones in (2, 1)
    ]
    assert all(row["collided"][0] == 0 for row in rows if row["drones"] == 1)


@pytest.mark.needs("casadi")
@pytest.mark.slow
def test_the_less_of_a_gate_a_lap_may_use_the_longer_it_takes_and_a_body_that_turns_is_slower():
    bounds = quick("lap")["bounds"]
    assert 1 < bounds["openings"] < bounds["drone"] < bounds["centers"] < 2.5
    assert bounds["drone"] < bounds["vehicle"] < 2.5


@pytest.mark.needs("casadi")
def test_the_fastest_flight_to_a_gate_straight_ahead_is_that_of_a_constant_acceleration():
    """From rest, without gravity, and with a weight that the thrust carries beside the acceleration."""
    track = lap.Track(np.array([[2.0, 0.0, 1.0, 0.0]]), half=1e-6, nodes=20)
    for thrust, gravity, acc in ((10.0, 0.0, 10.0), (5.0, 3.0, 4.0)):
        flight = lap.fastest(lap.point_mass(thrust, gravity, np.array([0.0, 0.0, 1.0])), track)
        np.testing.assert_allclose(flight.times, np.sqrt(2 * 2.0 / acc), rtol=2e-3)
        np.testing.assert_allclose(flight.pos[-1], track.gates[0, :3], atol=1e-5)


@pytest.mark.needs("casadi")
@pytest.mark.slow
@pytest.mark.float32
def test_laps_keep_clear_of_what_a_drone_touches():
    env, radius = jd.make("gates"), 0.06
    near = np.vstack([lap.GATES[:, :3], np.c_[lap.POLES, [0.9] * 4]])
    places = (near + np.random.default_rng(0).uniform(-0.5, 0.5, (40, 8, 3))).reshape(-1, 3)
    gap = np.asarray(jax.vmap(env.scene.replace(ground=False).distance)(places)) - radius
    outside = np.array([min(float(solid(place)) for solid in lap.solids(env, radius)) for place in places])
    assert np.all(outside[gap < -1e-3] < 0) and np.all(outside[gap > 0.06] > 0)
    assert np.sum(gap < 0) > 20


def test_accelerator_names_tests_that_exist():
    named = re.findall(r'"(tests/.*\.py)"', (ROOT / "benchmarks" / "accelerator.py").read_text())
    assert len(named) > 5 and all((ROOT / file).is_file() for file in named)


@pytest.mark.slow
def test_accelerator_stops_what_takes_longer_than_its_share(tmp_path):
    file = tmp_path / "result.json"
    benchmark("accelerator", "--budget", "1", "--sections", "plant", "learning", "--output", str(file))
    result = json.loads(file.read_text())
    assert result["rows"] == [] and set(result["stopped"]) == {"plant", "learning"}


def test_accelerator_prints_every_published_figure_beside_ours_with_its_source():
    figures = [published.SKYFLOW_PLANT[65_536], published.L2F]
    found = accelerator.row("rk4", 1.08e8, figures, worlds=65_536, unit="drone-steps/s", section="plant", note="")
    lines = accelerator.table({"rows": [found], "stopped": {}})
    assert "0.1 times 1.08e+09 substeps/s [1]" in lines[1] and "0.0054 times 2e+10 steps/s [2]" in lines[2]
    assert lines[3].startswith("[1] SkyFlow") and "Synetic-Labs/SkyFlow" in lines[3] and "l2f-benchmark" in lines[4]


def test_a_plant_stands_beside_the_figures_of_its_integrator_and_number_of_worlds():
    def sources(name, worlds):
        return [figure.what.split(",")[0] for figure in accelerator.plants(name, worlds)]

    assert sources("semi-implicit Euler", 65_536) == ["crazyflow"]
    assert sources("rk4", 65_536) == ["crazyflow", "SkyFlow"] and sources("rk4", 65) == []
    assert sources(accelerator.TEN_SUBSTEPS, max(accelerator.WORLDS)) == ["l2f"]


def test_a_success_rate_is_reported_with_its_interval_if_there_is_one():
    assert success_rate(0.5, (0.25, 0.75)) == "0.5000 [0.2500, 0.7500]"
    assert success_rate(1.0, None) == "1.0000 [1 distinct episode]" and success_rate(None, None) == "no criterion"


@pytest.mark.slow
def test_an_environment_with_the_step_of_elsewhere_flies_that_plant():
    env = jd.make("hover", realistic=True, drones=2)
    there = transfer.with_physics(env, transfer.Elsewhere(env.physics, lambda *now: env.physics(*now)))
    key, action = jax.random.key(0), jnp.full((2, 4), 0.1)
    flights = [jax.jit(lambda env=env: env.step(key, env.reset(key)[1], action))() for env in (env, there)]
    jax.tree.map(np.testing.assert_array_equal, *flights)
    still = transfer.with_physics(env, transfer.Elsewhere(env.physics, lambda params, state, rpm: state))
    _, world = env.reset(key)
    np.testing.assert_array_equal(still.step(key, world, action)[1].drones.pos, world.drones.pos)


@pytest.mark.slow
@pytest.mark.needs("pybullet")
def test_transfer_flies_a_policy_on_our_plant_and_on_bullet():
    result = quick("transfer")
    assert [row["plant"] for row in result["rows"]] == ["own", "bullet, damping 0.04"]
    assert all(0 <= row["success"] <= 1 and row["error p50"] > 0 for row in result["rows"])


@pytest.mark.slow
def test_agreement_explains_every_difference_from_recorded_flights():
    rows = quick("agreement")["rows"]
    assert len(rows) == 5 and all(row["explained"] for row in rows)
    for row in rows:
        worth = [max(cause[name] for name in ("pos", "angle", "vel", "omega")) for cause in row["causes"]]
        assert all(w > 1e3 * row["rounding"] for w in worth)  # each cause is one


@pytest.mark.slow
def test_reality_reports_every_horizon_of_our_models():
    (row,) = quick("reality")["rows"]
    assert row["input"] == "PWM and voltage" and set(row["models"]) == {"hold", "ours cf2x", "ours cf21"}
    for horizons in row["models"].values():
        assert set(horizons) == {"10", "25", "50"} and all(min(e.values()) > 0 for e in horizons.values())


@pytest.mark.slow
def test_rivals_races_our_side_where_there_are_no_rivals():
    rows = quick("race")["rows"]
    assert {row["race"] for row in rows} == {"plant-symplectic_euler", "attitude"}
    assert all(row["agree"] is None and min(row["rates"].values()) > 0 for row in rows)


@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="the limit is compiled by a C compiler")
def test_limit_in_c_flies_our_trajectory():
    result = quick("limit")
    assert max(result["agreement"].values()) < 1e-4  # float32, 240 steps
    assert all(row["share"] > 0 and len(row["rates"]) == 5 for row in result["rows"])


@pytest.mark.parametrize("name", NAMES)
def test_every_benchmark_asks_a_question(name):
    tree = ast.parse((ROOT / "benchmarks" / f"{name}.py").read_text())
    assert "?" in ast.get_docstring(tree) and "main" in [node.name for node in tree.body if hasattr(node, "name")]


@pytest.mark.slow
def test_the_state_estimate_of_a_recorded_flight_has_a_tilt_below_a_degree():
    """Against Vicon's attitude less the mean, which is how the markers were declared level."""
    (row,) = quick("state_estimate", str(ROOT / "assets" / "flights" / "B10_lissajous_slow_rep1.npz"))["rows"]
    assert row["tilt"] < 1 and row["as logged"] < 1.5 and row["with attitude"] < 0.5

"""`--realistic` at the shell, alone and with `any`."""

import json

import jax
import pytest
from helpers import SMALL_OPTIONS

from jaxdrones.cli import main
from jaxdrones.training.recipe import Recipe
from jaxdrones.training.run import Run

pytestmark = pytest.mark.float32

TRAIN = ["train", "hover", *SMALL_OPTIONS, "--budget", "1", "--episodes", "4", "--no-figure"]


def said(capsys, *command):
    """What a command that succeeds prints."""
    assert main(list(command)) == 0
    return capsys.readouterr().out


def refused(capsys, *command):
    """The one line of a command that fails."""
    try:
        code = main(list(command))
    except SystemExit as error:  # of argparse
        code = error.code
    line = capsys.readouterr().err
    assert code == 2 and line.count("\n") == 1
    return line


@pytest.mark.slow
def test_a_recipe_of_any_vehicle_draws_another_one_in_every_episode():
    env = Recipe.of("hover", realistic="any").env()
    masses = {float(env.reset(jax.random.key(seed))[1].params.mass[0]) for seed in range(3)}
    assert env.vehicle == "any vehicle" and len(masses) == 3


@pytest.mark.slow
def test_a_run_on_any_vehicle_says_so_and_is_evaluated_and_flown_on_any_vehicle(tmp_path, capsys):
    folder = tmp_path / "hover"
    output = ["--output", str(folder)]
    assert main([*TRAIN, "--realistic", "any", *output]) == 0
    printed = capsys.readouterr()
    assert "hover by bptt, realistic, any vehicle, duration 0.2: " in printed.out
    assert "no tuned settings" not in printed.err
    assert Run(folder).recipe().realistic == "any" and Run(folder).recipe().env().vehicle == "any vehicle"

    printed = said(capsys, "eval", str(folder), "--episodes", "4")
    assert printed.startswith("hover by bptt, realistic, any vehicle, duration 0.2: policy of update ")
    flown = json.loads(said(capsys, "fly", "--policy", str(folder), "--no-figure", "--json"))
    assert flown["realistic"] == "any" and flown["vehicle"] == "any vehicle"
    assert "PWM is requested for 'any vehicle'" in refused(capsys, "fly", "--policy", str(folder), "--pwm")

    again = ["train", "hover", *output, "--resume"]
    assert "was started with realistic any, not True; leave realistic out" in refused(capsys, *again, "--realistic")
    assert "is complete (updates=" in refused(capsys, *again, "--realistic", "any")


@pytest.mark.slow
def test_a_task_that_comes_after_the_option_is_the_task(capsys):
    before = said(capsys, "explain", "--realistic", "hover")
    assert before == said(capsys, "explain", "hover", "--realistic")
    drawn = said(capsys, "explain", "--realistic", "any", "hover")
    assert drawn == said(capsys, "explain", "hover", "--realistic=any") != before
    assert "any vehicle" in drawn and "any vehicle" not in before


@pytest.mark.parametrize("command", [["train", "hover"], ["explain", "hover"], ["eval", "runs/hover"]])
def test_another_value_is_refused_in_one_line(command, capsys):
    line = refused(capsys, *command, "--realistic", "all")
    assert "argument --realistic: 'all' is given; give --realistic alone, or --realistic any" in line


def test_what_contradicts_any_vehicle_is_refused(capsys):
    line = refused(capsys, *TRAIN, "--realistic", "any", "--vehicle", "hb")
    assert "vehicle='hb' is given, but every episode draws a vehicle already; leave out one of them" in line
    line = refused(capsys, "eval", "runs/hover", "--realistic", "any")
    assert "--realistic is given beside the run runs/hover, which determines it; leave it out" in line


@pytest.mark.slow
def test_a_policy_of_ones_own_flies_any_vehicle(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text("import jax.numpy as jnp\ndef still(obs):\n    return jnp.zeros((1, 4))\n")
    command = ["eval", "mine.py:still", "--task", "hover", "--set", "duration=0.2", "--episodes", "4"]
    printed = said(capsys, *command, "--realistic", "any")
    assert printed.startswith("hover by mine.py:still, realistic, any vehicle, duration 0.2")

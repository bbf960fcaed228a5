"""Bundled policies fly the tasks that they are named after."""

import json

import jax
import pytest
from documents import ROOT

import jaxdrones as jd
from jaxdrones import assets
from jaxdrones.cli import main
from jaxdrones.envs import TASKS
from jaxdrones.learning import evaluate

pytestmark = pytest.mark.float32
BUNDLED = sorted(assets.policies())


def report_of(task):
    return json.loads((assets.policies()[task] / "report.json").read_bytes())


def test_there_are_policies_of_at_most_two_megabytes():
    assert set(BUNDLED) <= set(TASKS) and len(BUNDLED) >= 13
    assert sum(file.stat().st_size for file in (ROOT / "assets" / "policies").rglob("*")) < 2e6


def test_the_table_has_the_success_of_every_policy():
    table = (ROOT / "assets" / "policies" / "README.md").read_text()
    for task in BUNDLED:
        report = report_of(task)
        success, interval = report["evaluation"]["success"], report["evaluation"]["success_interval"]
        low = f"{100 * interval[0]:.1f} %" if interval else "one start"
        assert f"| `{task}` | " in table
        assert f"| {100 * success:.1f} % | {low} | {report['evaluation']['episodes']} |" in table


@pytest.mark.slow
@pytest.mark.parametrize("task", BUNDLED)
def test_a_policy_succeeds_as_often_as_its_report_says(task):
    """On other starts than those of the report: within four standard deviations of a sample of 200."""
    expected = report_of(task)["evaluation"]["success"]
    with jd.make(task) as env:
        found = evaluate(env, jd.make_policy(task, env), jax.random.key(7), 200)
    assert abs(found.success - expected) <= 4 * (expected * (1 - expected) / 200) ** 0.5 + 0.01


def test_a_name_that_is_nearly_that_of_a_bundled_policy_is_corrected(capsys):
    assert main(["eval", "forrest"]) == 2
    assert (
        "forrest/best.json does not exist, and forrest is not a bundled policy; did you mean 'forest'?"
        in capsys.readouterr().err
    )


def test_what_cannot_be_flown_is_refused():
    with pytest.raises(
        ValueError, match=r"the policy forest has \d+ observations and 4 actions, the environment hover 22"
    ):
        jd.make_policy("forest", jd.make("hover"))
    swapped = ("position_error", "velocity_error", "rotation_matrix", "omega", "last_action")  # as many entries
    for options in {"observation": swapped}, {"action": "thrust_and_rates"}:
        with pytest.raises(
            ValueError, match=r"hover was trained with observation=position_error,rotation_matrix,.*; give"
        ):
            jd.make_policy("hover", jd.make("hover", **options))
    with pytest.raises(ValueError, match=r"unknown policy 'forrest'; did you mean 'forest'\?"):
        jd.make_policy("forrest")
    with pytest.raises(ValueError, match=r"raptor adapts to a vehicle; give its environment"):
        jd.make_policy("raptor")

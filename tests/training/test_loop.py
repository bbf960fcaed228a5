"""A training that is killed and goes on, or that stops early, has the numbers of one that does neither."""

import dataclasses
import itertools
import shutil
import time
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from helpers import SMALL_TRAINING, mostly_slow

from jaxdrones.training import loop, plan
from jaxdrones.training.recipe import Recipe
from jaxdrones.training.run import Run
from jaxdrones.training.trainer import Trainer

pytestmark = pytest.mark.float32


def test_control_steps_are_those_of_all_drones():
    config, env = SimpleNamespace(worlds=3, horizon=5), SimpleNamespace(drones=7)
    own = SimpleNamespace(trainer=SimpleNamespace(recipe=SimpleNamespace(config=config), env=env))
    assert loop._Loop._steps.fget(own) == 3 * 5 * 7


class Killed(BaseException):
    """The end of the process: no handler of it in the package."""


@pytest.fixture(scope="module")
def trainer():
    with jax.enable_x64(False):
        trainer = Trainer(Recipe.of("hover", "bptt", **SMALL_TRAINING, updates=6), 8)
        trainer.compile()
    return trainer


@pytest.fixture(scope="module")
def whole(trainer, tmp_path_factory):
    """The run of a training that nothing disturbed."""
    run = Run(tmp_path_factory.mktemp("whole"))
    with jax.enable_x64(False):
        loop.train(trainer, run, 3, lambda *_: None)
    return run


def killed_at(call):
    """A function for `on_progress` that ends the process in one of its calls."""
    calls = itertools.count(1)

    def on_progress(*_):
        if next(calls) == call:
            raise Killed

    return on_progress


def numbers(run):
    """All that two trainings of one recipe share: weights, training state, progress but for its clock."""
    rows = [{name: x for name, x in row.items() if name != "seconds"} for row in run.history()]
    files = {name: (run.folder / f"{name}.msgpack").read_bytes() for name in ("best", "last", "state")}
    return rows, files, run.report()["evaluation"], run.report()["best_update"]


@pytest.mark.slow
def test_a_training_that_is_killed_twice_has_the_numbers_of_one_that_was_not(trainer, whole, tmp_path):
    run = Run(tmp_path)
    for call in (4, 2):
        with pytest.raises(Killed):
            loop.train(trainer, run, 3, killed_at(call))
        assert run.started and not run.finished
        with (tmp_path / "progress.csv").open("a") as file:
            file.write("1,2")  # the first bytes of a row that was being written
    before = run.sidecar("state")["evaluating"]
    loop.train(trainer, run, 3, lambda *_: None)
    assert numbers(run) == numbers(whole)
    assert [row["update"] for row in run.history()] == [0, 1, 2, 3, 4, 5, 6]
    assert run.report()["seconds"]["evaluating"] > before > 0


def test_a_training_goes_on_without_a_row_or_an_evaluation_twice(trainer, whole, tmp_path, monkeypatch):
    """Killed before its state is written, it makes these updates again; their rows are not there twice."""
    run, save = Run(tmp_path), Run.save_state
    saves = itertools.count(1)

    def killed(self, *arguments, **about):
        if next(saves) == 4:
            raise Killed
        save(self, *arguments, **about)

    monkeypatch.setattr(Run, "save_state", killed)
    with pytest.raises(Killed):
        loop.train(trainer, run, 3, lambda *_: None)
    monkeypatch.undo()
    assert len(run.history()) == 4 and run.sidecar("state")["update"] == 2
    loop.train(trainer, run, 3, lambda *_: None)
    assert numbers(run) == numbers(whole)


@pytest.mark.parametrize("name", mostly_slow(["best", "last", "state", "report"], ["best", "state"]))
def test_a_file_of_another_training_is_refused_though_it_is_whole(name, trainer, whole, tmp_path):
    """Also where the other training has the same recipe and seed: its numbers may be those of another machine."""
    other = shutil.copytree(whole.folder, tmp_path / "run")
    loop.train(trainer, Run(tmp_path / "other"), 3, lambda *_: None)
    for file in (tmp_path / "other").glob(f"{name}.*"):
        shutil.copy(file, other)
    run = Run(other)
    for read in (run.recipe, run.policy, lambda: run.verify("state"), run.report):
        if (name == "last" or name == "report") and read == run.report:
            continue
        with pytest.raises(ValueError, match=r"are of two trainings; restore the files of one") as refused:
            read()
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize("rate", [0.3, 0.99])
def test_a_training_stops_after_three_evaluations_in_a_row_that_reach_its_rate(rate, trainer, tmp_path, monkeypatch):
    """Evaluations of scripted success: one that falls short starts the count anew, also across a restart."""
    low = iter([0.5, 0.5, 0.2, 0.5, 0.5, 0.5, 0.5, 0.5])
    evaluate = trainer.evaluate

    def scripted(policy, key):
        return evaluate(policy, key).replace(success_interval=(next(low, 0.0), 1.0))

    monkeypatch.setattr(trainer, "evaluate", scripted)
    monkeypatch.setattr(trainer, "recipe", dataclasses.replace(trainer.recipe, stop_at=rate))
    run = Run(tmp_path)
    with pytest.raises(Killed):
        loop.train(trainer, run, 3, killed_at(5))  # after the evaluation of update 4
    assert run.sidecar("state")["reached"] == (2 if rate == 0.3 else 0)
    loop.train(trainer, run, 3, lambda *_: None)
    assert run.report()["updates"] == run.sidecar("state")["recipe"]["config"]["updates"] == (5 if rate == 0.3 else 6)
    assert run.report()["stopped_at_success"] == (rate == 0.3)
    assert run.recipe().stop_at == rate and trainer.recipe.config.updates == 6


def test_an_evaluation_that_is_made_again_counts_once(trainer, tmp_path, monkeypatch):
    """Ctrl-C after the evaluation of update 1, before its training state is the one to save.

    The report is of other episodes than the evaluations.
    """
    evaluate, keys = trainer.evaluate, []

    def scripted(policy, key):
        keys.append(jax.random.key_data(key).tolist())
        return evaluate(policy, key).replace(success_interval=(0.5, 1.0))

    monkeypatch.setattr(trainer, "evaluate", scripted)
    monkeypatch.setattr(trainer, "recipe", dataclasses.replace(trainer.recipe, stop_at=0.3))

    def interrupted(update, *_):
        if update == 1:
            raise KeyboardInterrupt

    run = Run(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        loop.train(trainer, run, 3, lambda *_: None, loggers=[interrupted])
    loop.train(trainer, run, 3, lambda *_: None)
    assert run.report()["updates"] == 2  # with that of the untrained policy, three evaluations in a row
    assert keys[-1] != keys[0] and keys[:-1] == keys[:1] * 4


def test_a_resumed_training_keeps_the_highest_success_to_which_the_best_policy_is_tied(trainer, tmp_path, monkeypatch):
    """Of 8 episodes 7 successes are tied with 8, and 6 with 7 but not with 8."""
    scores, evaluate = iter([(1.0, 1.0), (0.875, 2.0), (0.75, 3.0)]), trainer.evaluate

    def scripted(policy, key):
        success, mean_return = next(scores, (0.0, 0.0))
        return evaluate(policy, key).replace(success=success, mean_return=mean_return)

    monkeypatch.setattr(trainer, "evaluate", scripted)
    run = Run(tmp_path)
    with pytest.raises(Killed):
        loop.train(trainer, run, 3, killed_at(2))  # after the evaluation of update 1
    loop.train(trainer, run, 3, lambda *_: None)
    assert run.report()["best_update"] == 1


def test_evaluations_that_reached_another_rate_do_not_count(trainer, tmp_path, monkeypatch):
    """A training that stopped at a low rate and is continued with a higher one needs three evaluations at that one."""
    evaluate = trainer.evaluate
    monkeypatch.setattr(trainer, "evaluate", lambda *of: evaluate(*of).replace(success_interval=(0.5, 1.0)))
    run, stopped = Run(tmp_path), []
    for rate, updates in (0.3, 6), (0.4, 12):
        config = dataclasses.replace(trainer.recipe.config, updates=updates)
        monkeypatch.setattr(trainer, "recipe", dataclasses.replace(trainer.recipe, config=config, stop_at=rate))
        loop.train(trainer, run, 3, lambda *_: None)
        stopped.append(run.report()["updates"])
    assert stopped == [2, 5]  # with an evaluation after every update, also of the untrained policy


def test_a_rate_that_no_evaluation_reaches_is_refused():
    for rate, has_success, episodes, message in [
        (0.99, True, 100, "begins at 0.9630; give at least 381 episodes"),
        (0.99, False, 1000, "has no criterion of success"),
        (1.0, True, 1000, "between 0 and 1"),
        (0.0, True, 1000, "between 0 and 1"),
        (float("nan"), True, 1000, "between 0 and 1"),
    ]:
        with pytest.raises(ValueError, match=message):
            plan.check_stop_at(rate, has_success, episodes)
    plan.check_stop_at(0.99, True, 381)
    with pytest.raises(ValueError):
        plan.check_stop_at(0.99, True, 380)


@pytest.mark.parametrize(
    ("seconds", "update", "evaluation", "drift"),
    [
        (60, 3.0, 6.0, 1.0),
        (240, 0.9, 20, 1.5),
        pytest.param(60, 0.6, 0.5, 1.0, marks=pytest.mark.slow),
        pytest.param(60, 0.6, 0.5, 2.0, marks=pytest.mark.slow),
        pytest.param(60, 0.6, 0.5, 0.5, marks=pytest.mark.slow),
        pytest.param(9, 0.1, 0, 1, marks=pytest.mark.slow),
    ],
)
def test_a_budget_holds_to_a_tenth_whatever_updates_and_evaluations_take(
    seconds, update, evaluation, drift, trainer, tmp_path, monkeypatch
):
    """On a simulated clock, on which updates become slower or faster during the training."""
    clock = [1000.0]
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])
    advance, evaluate = trainer.advance, trainer.evaluate
    begin, state = clock[0], trainer.start(jax.random.key(3))
    _, metrics = advance(state, 1)
    evaluations = []

    def timed_advance(state, updates):
        share = min(1.0, (clock[0] - begin) / seconds)
        clock[0] += updates * update * drift**share
        return state, {name: np.repeat(x, updates) for name, x in metrics.items()}

    report = evaluate(state.policy, jax.random.key(0))

    def timed_evaluate(policy, key):
        evaluations.append(clock[0])
        clock[0] += evaluation
        return report

    monkeypatch.setattr(trainer, "advance", timed_advance)
    monkeypatch.setattr(trainer, "evaluate", timed_evaluate)
    run = Run(tmp_path)
    loop.train(trainer, run, 3, lambda *_: None, begin + seconds)
    assert 0.9 * seconds < clock[0] - begin < 1.1 * seconds
    assert run.finished and 3 <= len(evaluations) <= 16
    assert "evaluated_return" in run.history()[-1] and run.sidecar("state")["update"] == run.report()["updates"]


def test_the_first_updates_of_a_budget_which_are_slower_count_only_until_the_second():
    timed = plan.TimePlan(time.perf_counter() + 100, 0)
    timed.add_updates(1, 50.0)
    assert timed.updates(1) <= 1 + 100 / 50
    for made in (11, 21):
        timed.add_updates(10, 1.0)
        assert made + 900 < timed.updates(made) <= made + 1000


def test_evaluations_of_a_budget_are_evenly_spaced_and_take_a_quarter_of_it_beside_the_first_and_the_last_two():
    assert plan.TimePlan(0.0, 0, 2).next_evaluation(10, 3) == 5
    timed = plan.TimePlan(time.perf_counter() + 120.5, 0, evaluation_seconds=10.0)
    timed.add_updates(100, 100.0)
    assert 75 < timed.updates(0) <= 80 and timed.evaluations == 3  # of 100 s, 25 for evaluations


def test_a_budget_that_is_spent_makes_one_update(trainer, tmp_path):
    loop.train(trainer, Run(tmp_path), 3, lambda *_: None, time.perf_counter() - 1)
    assert Run(tmp_path).report()["updates"] == 1

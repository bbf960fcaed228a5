"""A run on disk."""

import contextlib
import errno
import itertools
import json
import math
import os
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxdrones import writing
from jaxdrones.envs import make, randomize
from jaxdrones.learning.networks import Policy
from jaxdrones.training.recipe import Recipe, split_changes
from jaxdrones.training.run import Progress, Run


def test_lines_after_the_update_that_training_goes_on_from_are_dropped(tmp_path):
    run, columns = Run(tmp_path), ["update", "reward", "success"]
    with Progress(run, columns, 0) as progress:
        progress.add([{"update": 1, "reward": 0.1}, {"update": 2, "reward": 0.2, "success": 0.5}])
        progress.add([{"update": 3, "reward": 0.3}])
    with Progress(run, columns, 2) as progress:
        progress.add([{"update": 3, "reward": 0.4}])
    assert run.history() == [
        {"update": 1, "reward": 0.1},
        {"update": 2, "reward": 0.2, "success": 0.5},
        {"update": 3, "reward": 0.4},
    ]


def test_every_prefix_of_progress_has_the_rows_that_are_complete(tmp_path):
    """A process may be killed while it writes a row; what it left is neither refused nor taken for a row."""
    run, columns = Run(tmp_path), ["update", "reward"]
    with Progress(run, columns, 0) as progress:
        progress.add([{"update": 1, "reward": 1e-5}, {"update": 12, "reward": -0.25}])
    rows, content = run.history(), (tmp_path / "progress.csv").read_bytes()
    assert len(rows) == 2
    for length in range(len(content)):
        (tmp_path / "progress.csv").write_bytes(content[:length])
        assert run.history() == rows[: max(0, content[:length].count(b"\r") - 1)]


@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning"
)  # files that a killed process leaves open
def test_rows_are_never_missing_while_a_training_goes_on(tmp_path, monkeypatch):
    """Killed at any operation on files by which a training continues, it has all its rows."""
    run, columns = Run(tmp_path), ["update", "reward"]
    with Progress(run, columns, 0) as progress:
        progress.add([{"update": i, "reward": 0.1 * i} for i in range(1, 4)])
    rows = run.history()
    reached = set()
    for place, name in [(os, "open"), (os, "fsync"), (os, "replace"), (Path, "open")]:
        for call in range(1, 4):
            calls, function = itertools.count(1), getattr(place, name)

            def killed(*arguments, function=function, calls=calls, call=call, name=name, **keywords):
                if next(calls) == call:
                    reached.add(name)
                    raise SystemExit
                return function(*arguments, **keywords)

            with monkeypatch.context() as patch, contextlib.suppress(SystemExit):
                patch.setattr(place, name, killed)
                Progress(run, columns, 3).__exit__()
            assert run.history() == rows
    assert reached == {"open", "fsync", "replace"}


def test_loggers_get_every_row_once(tmp_path):
    run, columns, logged = Run(tmp_path), ["update", "reward", "success"], []

    def logger(update, metrics, state):
        logged.append((update, metrics))

    with Progress(run, columns, 0, [logger]) as progress:
        progress.add([{"update": 1, "reward": 0.1, "success": math.nan}, {"update": 2, "reward": 0.2}])
    with Progress(run, columns, 2, [logger]) as progress:
        progress.add([{"update": 3, "reward": 0.3}])
    assert logged == [(1, {"reward": 0.1}), (2, {"reward": 0.2}), (3, {"reward": 0.3})]


def test_a_file_is_replaced_whole_or_stays(tmp_path):
    file, link = tmp_path / "log.npz", tmp_path / "link.npz"
    file.write_text("old")
    link.symlink_to(file)
    for error in (OSError(28, "No space left on device"), KeyboardInterrupt()):
        with pytest.raises(type(error)), writing.replaced(file) as new:
            new.write_text("half")
            assert file.read_text() == "old" and new.suffix == ".npz"
            raise error
        assert sorted(tmp_path.iterdir()) == [link, file]
    with writing.replaced(link) as new:
        new.write_text("new")
    assert file.read_text() == link.read_text() == "new" and link.is_symlink()
    with pytest.raises(OSError, match=r"No space left on device: .*log\.npz"), writing.replaced(file):
        raise OSError(28, "No space left on device")
    with open(os.devnull, "rb"), writing.replaced(os.devnull) as new:
        assert str(new) == os.devnull


def test_an_option_of_a_task_with_the_name_of_a_setting_is_refused_where_it_is_given():
    def task(horizon=3, length=2.0):
        raise AssertionError("made")

    assert split_changes(task, {"length": 1.0, "worlds": 4}, {"horizon", "worlds"}) == ({"length": 1.0}, {"worlds": 4})
    with pytest.raises(ValueError, match="horizon is an option of the environment and a setting of the learner; give"):
        split_changes(task, {"horizon": 4}, {"horizon", "worlds"})


def test_a_recipe_of_numbers_of_numpy_is_that_of_numbers():
    given = Recipe.of("hover", worlds=np.int64(64), learning_rate=np.float64(0.01), reach=np.float32(0.5))
    assert given.as_dict() == Recipe.of("hover", worlds=64, learning_rate=0.01, reach=0.5).as_dict()
    assert type(given.options["reach"]) is float


@pytest.mark.parametrize("realistic", [True, "any"])
def test_a_recipe_survives_json(realistic):
    recipe = Recipe.of("tracking", "ppo", realistic=realistic, period=5.0, worlds=64, restart_fraction=1)
    assert recipe.config.restart_fraction == 1.0 and recipe.options == {"period": 5.0}
    assert Recipe.from_dict(json.loads(json.dumps(recipe.as_dict()))) == recipe
    assert recipe.env().observation_size > 0


@pytest.mark.slow
def test_realistic_hover_trains_beyond_the_limits_of_flight_unless_they_are_given():
    recipe, given = Recipe.of("hover", realistic=True), Recipe.of("hover", realistic=True, delay=0.01, randomize=())
    assert recipe.env().delay == (0.0, 0.04) and recipe.env(practice=True).delay == (0.0, 0.05)
    assert given.env(practice=True).delay == given.env().delay == (0.01, 0.01)
    assert Recipe.of("hover", realistic="any").env(practice=True).delay == (0.0, 0.05)
    keys = jax.random.split(jax.random.key(0), 1000)
    drawn, practiced = (
        jax.vmap(lambda key, env=env: randomize.draw(env.randomize, key, env.params))(keys)
        for env in (recipe.env(), recipe.env(practice=True))
    )
    for name in ("mass", "inertia", "kf", "km", "rotor_rise_time", "rotor_fall_time"):
        assert np.ptp(getattr(practiced, name)) > 1.1 * np.ptp(getattr(drawn, name)), name
    assert given.env(practice=True).randomize == given.env().randomize == ()


@pytest.mark.slow
def test_only_ppo_for_realistic_hover_trains_with_the_reward_for_precision_and_none_flies_with_it():
    trained = {
        (algorithm, realistic): "near"
        in Recipe.of("hover", algorithm, realistic=realistic).env(practice=True).task.rewards
        for algorithm in ("ppo", "bptt")
        for realistic in (False, True, "any")
    }
    assert [pair for pair, rewarded in trained.items() if rewarded] == [("ppo", True)]
    assert "near" not in Recipe.of("hover", "ppo", realistic=True).env().task.rewards
    given = Recipe.of("hover", "ppo", realistic=True, precision=0.5)
    assert given.env(practice=True).task.rewards["near"][0] == given.env().task.rewards["near"][0] == 0.5


def test_a_full_disk_is_reported_with_its_folder_before_training(tmp_path, monkeypatch):
    def full(self, content):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match=r"No space left on device: .*hover"):
        Run(tmp_path / "hover").prepare(1000)
    assert list((tmp_path / "hover").iterdir()) == []


def test_a_disk_that_fills_up_leaves_the_checkpoint_that_was_there(tmp_path, monkeypatch):
    run = Run(tmp_path)
    run.save_state({"x": 1.0 * np.arange(3)}, update=1)

    def full(self, content):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match=r"state\.msgpack"):
        run.save_state({"x": np.zeros(3)}, update=2)
    monkeypatch.undo()
    assert run.sidecar("state")["update"] == 1
    assert run.load_state({"x": np.zeros(3)})["x"].tolist() == [0, 1, 2]


def test_a_policy_that_does_not_fit_the_environment_is_refused(tmp_path):
    env = make("hover")
    run = Run(tmp_path)
    run.save_policy("best", Policy.init(jax.random.key(0), env, (4,)))
    run.policy("best", env)
    with pytest.raises(
        ValueError, match=r"best has 22 observations and 4 actions, the environment leader-follower 12 and 1"
    ):
        run.policy("best", make("leader-follower"))

"""The table of learners: what each module of it has to define."""

import dataclasses
import inspect
import typing

import pytest
from helpers import SMALL_TRAINING

from jaxdrones.cli import main
from jaxdrones.learning import bptt
from jaxdrones.training.algorithms import ALGORITHMS, learner
from jaxdrones.training.recipe import Recipe
from jaxdrones.training.trainer import Trainer


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_learner_defines_what_training_needs(name):
    module = learner(name)
    assert list(inspect.signature(module.init).parameters) == ["key", "env", "config", "network"]
    assert list(inspect.signature(module.update).parameters) == ["env", "config", "state"]
    assert list(inspect.signature(module.train).parameters) == ["key", "env", "config", "network", "callback", "state"]
    config = module.Config()
    for setting in ("updates", "worlds", "horizon"):
        assert getattr(config, setting) >= 1


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_setting_has_a_precise_type_with_a_check(name):
    config = learner(name).Config
    hints = typing.get_type_hints(config, include_extras=True)
    for field in dataclasses.fields(config):
        assert typing.get_origin(hints[field.name]) is typing.Annotated, field.name
        assert "Any" not in str(typing.get_args(hints[field.name])[0]), field.name


def test_an_unknown_learner_names_the_closest_one():
    with pytest.raises(ValueError, match=r"unknown algorithm 'pppo'; did you mean 'ppo'\?"):
        learner("pppo")


@pytest.mark.slow
@pytest.mark.float32
def test_a_training_traces_its_update_once(monkeypatch):
    traced, update = [], bptt.update
    monkeypatch.setattr(bptt, "update", lambda *arguments: traced.append(arguments) or update(*arguments))
    trainer = Trainer(Recipe.of("hover", "bptt", **SMALL_TRAINING, updates=4), episodes=8)
    trainer.compile()
    assert len(traced) == 1


@pytest.mark.slow
def test_a_new_learner_is_a_module_and_a_line_in_the_table(tmp_path, monkeypatch, capsys):
    (tmp_path / "own_learner.py").write_text("from jaxdrones.learning.bptt import Config, init, train, update\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(ALGORITHMS, "own", "own_learner")
    recipe = Recipe.of("hover", "own", worlds=4, horizon=2, hidden_sizes=(4,))
    assert Recipe.from_dict(recipe.as_dict()) == recipe
    assert "nonfinite_gradients" in Trainer(recipe, episodes=2).metrics
    assert main(["list"]) == 0 and ", own" in capsys.readouterr().out

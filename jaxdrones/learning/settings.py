"""What the settings of every learner must be to make sense. Those that are not shapes may be traced."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

from jaxdrones.checks import check_callable, check_choice, check_number, check_switch, check_whole, is_known, shown
from jaxdrones.learning.gradients import GRADIENTS

Check = Callable[[str, Any], None]

_share = partial(check_number, at_least=0, at_most=1)
_positive_share = partial(check_number, above=0, at_most=1)
_below_one = partial(check_number, at_least=0, below=1)
_positive = partial(check_number, above=0)
_positive_or_infinite = partial(check_number, above=0, infinite=True)
_not_negative = partial(check_number, at_least=0)


def _whole_or_traced(name: str, value: Any) -> None:
    if is_known(value):
        check_whole(name, value)


def _layers(name: str, sizes) -> None:
    if not isinstance(sizes, tuple | list) or not sizes:
        raise ValueError(f"{name} is {shown(sizes)}; give the sizes of the hidden layers, for example (32, 32)")
    for size in sizes:
        check_whole(f"an entry of {name}", size)


def _gradient(name: str, value: Any) -> None:
    check_choice(name, value, GRADIENTS)


def _surrogate(name: str, step) -> None:
    if step is not None:
        check_callable(name, step, "jaxdrones.make_step()")


_CHECKS: dict[str, Check] = {
    "updates": _whole_or_traced,
    "worlds": check_whole,
    "horizon": check_whole,
    "epochs": check_whole,
    "batches": check_whole,
    "critic_steps": check_whole,
    "sizes": _layers,
    "critic_hidden_sizes": _layers,
    "memory": _positive_or_infinite,
    "settle": _share,
    "per_agent": check_switch,
    "centralized_critic": check_switch,
    "privileged_critic": check_switch,
    "learning_rate": _positive,
    "critic_rate": _positive,
    "min_learning_rate": _positive,
    "max_learning_rate": _positive,
    "change": _positive,
    "cool": _share,
    "trust": _positive_share,
    "discount": _share,
    "trace": _share,
    "target_speed": _positive_share,
    "b2": _below_one,
    "clip_epsilon": _positive,
    "entropy": _not_negative,
    "value_coef": _not_negative,
    "spread": _positive,
    "min_std": _positive,
    "calm": _positive,
    "restart": _share,
    "clip": _positive_or_infinite,
    "gradient": _gradient,
    "decay": _share,
    "surrogate": _surrogate,
}


def check_settings(config: Any, valued: bool = False) -> None:
    """Raise unless every setting makes sense.

    Args:
        config: dataclass of settings.
        valued: whether a critic learns the value of all that is to come, which is finite with a discount below one.

    Raises:
        ValueError: names the setting, what was given, and what to give.
    """
    checks = _CHECKS | ({"discount": _below_one} if valued else {})
    for field in dataclasses.fields(config):
        checks[field.name](field.name, getattr(config, field.name))


def check_config(config: Any, kind: type) -> None:
    """Raise unless the settings are those of this learner."""
    if isinstance(config, kind):
        return
    learner = _learner(kind)
    if isinstance(config, dict):
        raise ValueError(f"config is a dictionary; give jaxdrones.learning.{learner}.Config(**config)")
    given = f"{_learner(type(config))}.Config" if dataclasses.is_dataclass(config) else shown(config)
    raise ValueError(f"config is {given}; {learner} learns with jaxdrones.learning.{learner}.Config(...)")


def _learner(kind: type) -> str:
    return kind.__module__.rpartition(".")[2]

"""Common settings of the learners."""

import dataclasses
from typing import Any

from jaxdrones import arguments
from jaxdrones.checks import short_repr
from jaxdrones.errors import UserError


@dataclasses.dataclass(frozen=True)
class Config:
    """Common settings; numbers that are not shapes may be traced, for `vmap` over many values."""

    updates: arguments.TracedCount = 200
    worlds: arguments.Count = 256
    horizon: arguments.Count = 64
    """Control steps of a trajectory."""
    hidden_sizes: arguments.HiddenSizes = (32, 32)
    recurrent_size: arguments.NonNegativeInt = 0
    """Size of the hidden state of a gated recurrent unit (GRU) in the policy; 0 for none."""
    set_sizes: arguments.HiddenSizes = (32, 32)
    """Sizes of the layers that encode a row of a set in the observation, such as `encounters`."""
    obs_stats_window: arguments.PositiveOrInfinite = 1e9
    """Averaging window of the statistics of observations, in trajectories."""
    obs_stats_freeze: arguments.Fraction = 0.2
    """Fraction of the updates after which the statistics of observations are frozen."""
    per_agent: arguments.Switch = False
    """Whether every drone has its own networks; otherwise all drones share them."""
    learning_rate: arguments.Positive = 2e-2
    """Initial learning rate of the policy."""
    gamma: arguments.Fraction = 1.0
    """Discount factor."""
    restart_fraction: arguments.Fraction = 0.2
    """Fraction of the worlds that start a new episode before an update; the others continue theirs."""
    max_grad_norm: arguments.PositiveOrInfinite = 0.3
    """Largest norm of a gradient; longer gradients are scaled down."""


def check_config(config: Any, kind: type) -> None:
    """Raise unless the settings are of the type `kind`."""
    if isinstance(config, kind):
        return
    learner = _learner(kind)
    if isinstance(config, dict):
        raise UserError(f"config is a dictionary; give jaxdrones.learning.{learner}.Config(**config)")
    given = f"{_learner(type(config))}.Config" if dataclasses.is_dataclass(config) else short_repr(config)
    raise UserError(f"config is {given}; give jaxdrones.learning.{learner}.Config(...)")


def check_environment(env: Any) -> None:
    """Raise for the name of a task in place of an environment."""
    if isinstance(env, str):
        raise UserError(f"env is {env!r}; give an environment, for example jaxdrones.make({env!r})")


def _learner(kind: type) -> str:
    return kind.__module__.rpartition(".")[2]

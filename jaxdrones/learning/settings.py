"""Common settings of the learners, and annotated types of settings with validation.

A learner's `Config` annotates each field with one of these types. Numbers that are not shapes may be traced by JAX, and
are then not validated.
"""

from __future__ import annotations

import dataclasses
import functools
import typing
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

import jax

from jaxdrones.checks import check_number, check_switch, check_whole, is_concrete, short_repr
from jaxdrones.errors import UserError

Scalar = float | jax.Array
"""Number that may be traced, for `jax.vmap` over many values."""


def _check_whole_if_known(name: str, value: Any) -> None:
    if is_concrete(value):
        check_whole(name, value)


def _check_layers(name: str, sizes: Any) -> None:
    if not isinstance(sizes, tuple | list) or not sizes:
        raise UserError(f"{name} is {short_repr(sizes)}; give the sizes of the hidden layers, for example (32, 32)")
    for size in sizes:
        check_whole(f"an entry of {name}", size)


Positive = Annotated[Scalar, partial(check_number, above=0)]
PositiveOrInfinite = Annotated[Scalar, partial(check_number, above=0, infinite=True)]
NotNegative = Annotated[Scalar, partial(check_number, at_least=0)]
Fraction = Annotated[Scalar, partial(check_number, at_least=0, at_most=1)]
PositiveFraction = Annotated[Scalar, partial(check_number, above=0, at_most=1)]
BelowOne = Annotated[Scalar, partial(check_number, at_least=0, below=1)]
Count = Annotated[int, check_whole]
TracedCount = Annotated[int | jax.Array, _check_whole_if_known]
NonNegativeInt = Annotated[int, partial(check_whole, minimum=0)]
Bool = Annotated[bool, check_switch]
HiddenSizes = Annotated[tuple[int, ...], _check_layers]


def check_settings(config: Any) -> None:
    """Raise unless every setting of a dataclass is valid for its type."""
    for name, check in _checks(config.__class__).items():
        check(name, getattr(config, name))


@functools.cache
def _checks(kind: type) -> dict[str, Callable[[str, Any], None]]:
    """Checks of the fields of a dataclass."""
    hints = typing.get_type_hints(kind, include_extras=True)
    annotated = {field.name: getattr(hints[field.name], "__metadata__", ()) for field in dataclasses.fields(kind)}
    return {name: metadata[0] for name, metadata in annotated.items() if metadata}


@dataclasses.dataclass(frozen=True)
class Config:
    """Common settings; numbers that are not shapes may be traced, for `vmap` over many values."""

    updates: TracedCount = 200
    worlds: Count = 256
    horizon: Count = 64
    """Control steps of a trajectory."""
    hidden_sizes: HiddenSizes = (32, 32)
    recurrent_size: NonNegativeInt = 0
    """Size of the hidden state of a gated recurrent unit (GRU) in the policy; 0 for none."""
    obs_stats_window: PositiveOrInfinite = 1e9
    """Averaging window of the statistics of observations, in trajectories."""
    obs_stats_freeze: Fraction = 0.2
    """Fraction of the updates after which the statistics of observations are frozen."""
    per_agent: Bool = False
    """Whether every drone has its own networks; otherwise all drones share them."""
    learning_rate: Positive = 2e-2
    """Initial learning rate of the policy."""
    gamma: Fraction = 1.0
    """Discount factor."""
    restart_fraction: Fraction = 0.2
    """Fraction of the worlds that start a new episode before an update; the others continue theirs."""
    max_grad_norm: PositiveOrInfinite = 0.3
    """Largest norm of a gradient; longer gradients are scaled down."""

    def __post_init__(self) -> None:
        check_settings(self)


def check_config(config: Any, kind: type) -> None:
    """Raise unless the settings are of the type `kind`."""
    if isinstance(config, kind):
        return
    learner = _learner(kind)
    if isinstance(config, dict):
        raise UserError(f"config is a dictionary; give jaxdrones.learning.{learner}.Config(**config)")
    given = f"{_learner(type(config))}.Config" if dataclasses.is_dataclass(config) else short_repr(config)
    raise UserError(f"config is {given}; {learner} learns with jaxdrones.learning.{learner}.Config(...)")


def _learner(kind: type) -> str:
    return kind.__module__.rpartition(".")[2]

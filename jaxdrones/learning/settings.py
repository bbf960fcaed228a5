"""Types of the settings of learners, each with the check of its values.

A learner's `Config` annotates each field with one of these types, and `check_settings` applies the checks. Numbers that
are not shapes may be traced by JAX; what is traced has no value yet and passes.
"""

from __future__ import annotations

import dataclasses
import functools
import typing
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, Literal

import jax

from jaxdrones.checks import check_callable, check_choice, check_number, check_switch, check_whole, is_known, shown
from jaxdrones.engine.step import Step
from jaxdrones.errors import UserError

GRADIENTS = ("exact", "decay", "surrogate", "point_mass")
"""Names of the gradients that `learning.gradients` explains."""

Scalar = float | jax.Array
"""A number that may be traced, so that `jax.vmap` trains with many values of it at once."""


def _check_whole_if_known(name: str, value: Any) -> None:
    if is_known(value):
        check_whole(name, value)


def _check_layers(name: str, sizes: Any) -> None:
    if not isinstance(sizes, tuple | list) or not sizes:
        raise UserError(f"{name} is {shown(sizes)}; give the sizes of the hidden layers, for example (32, 32)")
    for size in sizes:
        check_whole(f"an entry of {name}", size)


def _check_gradient(name: str, value: Any) -> None:
    check_choice(name, value, GRADIENTS)


def _check_surrogate(name: str, step: Any) -> None:
    if step is not None:
        check_callable(name, step, "jaxdrones.make_step()")


Positive = Annotated[Scalar, partial(check_number, above=0)]
PositiveOrInfinite = Annotated[Scalar, partial(check_number, above=0, infinite=True)]
NotNegative = Annotated[Scalar, partial(check_number, at_least=0)]
Fraction = Annotated[Scalar, partial(check_number, at_least=0, at_most=1)]
PositiveFraction = Annotated[Scalar, partial(check_number, above=0, at_most=1)]
BelowOne = Annotated[Scalar, partial(check_number, at_least=0, below=1)]
"""At least 0 and below 1, such as the discount of an infinite sum."""
Count = Annotated[int, check_whole]
TracedCount = Annotated[int | jax.Array, _check_whole_if_known]
"""A whole number that may be traced."""
Switch = Annotated[bool, check_switch]
CountOrNone = Annotated[int, partial(check_whole, minimum=0)]
"""A whole number, 0 where the thing that is counted is left out."""
HiddenSizes = Annotated[tuple[int, ...], _check_layers]
"""Sizes of the hidden layers of a network."""
Gradient = Annotated[Literal["exact", "decay", "surrogate", "point_mass"], _check_gradient]
Surrogate = Annotated[Step | None, _check_surrogate]


def check_settings(config: Any) -> None:
    """Raise unless every setting is one that its type allows.

    Args:
        config: dataclass whose fields are annotated with types of this module; fields of other types are not checked.

    Raises:
        ValueError: names the setting, what was given, and what to give.
    """
    for name, check in _checks(config.__class__).items():
        check(name, getattr(config, name))


@functools.cache
def _checks(kind: type) -> dict[str, Callable[[str, Any], None]]:
    """The check of each field of a dataclass that has one."""
    hints = typing.get_type_hints(kind, include_extras=True)
    annotated = {field.name: getattr(hints[field.name], "__metadata__", ()) for field in dataclasses.fields(kind)}
    return {name: metadata[0] for name, metadata in annotated.items() if metadata}


def check_config(config: Any, kind: type) -> None:
    """Raise unless the settings are those of the learner whose `Config` is `kind`."""
    if isinstance(config, kind):
        return
    learner = _learner(kind)
    if isinstance(config, dict):
        raise UserError(f"config is a dictionary; give jaxdrones.learning.{learner}.Config(**config)")
    given = f"{_learner(type(config))}.Config" if dataclasses.is_dataclass(config) else shown(config)
    raise UserError(f"config is {given}; {learner} learns with jaxdrones.learning.{learner}.Config(...)")


def _learner(kind: type) -> str:
    return kind.__module__.rpartition(".")[2]

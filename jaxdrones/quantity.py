"""Descriptions of observation and action entries, and of functions."""

import dataclasses
import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from jaxdrones.checks import short_repr
from jaxdrones.errors import UserError

Function = TypeVar("Function", bound=Callable[..., Any])


@dataclasses.dataclass(frozen=True)
class Quantity:
    """Description of one entry of an observation or of an action."""

    name: str
    """For example `x of the velocity`."""
    unit: str = "-"
    """Unit of the number, or of `values` if given; `-` for none."""
    frame: str = "-"
    """Axes, `world` or `body`; `-` for none."""
    values: tuple[float, float, float] | None = None
    """Values at -1, 0 and 1, in `unit`; `None` if the number itself is in `unit`."""


def quantities(
    name: str,
    unit: str = "-",
    frame: str = "-",
    parts: Sequence[Any] = "xyz",
    values: tuple[float, float, float] | None = None,
) -> tuple[Quantity, ...]:
    """Components of a vector, or entries of a list, with names such as `x of the velocity`; see `Quantity`."""
    return tuple(Quantity(f"{part} of the {name}", unit, frame, values) for part in parts)


def check_quantities(name: str, entries: Any) -> None:
    """Raise unless entries are described by a tuple of quantities."""
    if not (isinstance(entries, tuple) and all(isinstance(entry, Quantity) for entry in entries)):
        raise UserError(f"{name} is {short_repr(entries)}; give a tuple, (Quantity('height', 'm', 'world'), ...)")


def described(text: str, function: Function) -> Function:
    """Set the docstring of a function, for a lambda or a closure."""
    function.__doc__ = text
    return function


def description(function: Any) -> str:
    """First paragraph of a function's docstring in one line; empty without a docstring."""
    if isinstance(function, functools.partial) and "__doc__" not in vars(function):
        function = function.func
    text = inspect.getdoc(function) or ""
    return " ".join(text.split("\n\n")[0].split())

"""What a number of an observation or of an action stands for, and what a function says of itself."""

import dataclasses
import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])


@dataclasses.dataclass(frozen=True)
class Quantity:
    """What one number of an observation or of an action stands for."""

    name: str
    """For example `x of the velocity`."""
    unit: str = "-"
    """Unit of the number, or of `values` where these are given; `-` where it has none."""
    frame: str = "-"
    """`world` or `body`, the axes it is given in; `-` where it has none."""
    values: tuple[float, float, float] | None = None
    """What the numbers -1, 0 and 1 stand for, in `unit`; `None` where the number itself is in `unit`."""


def quantities(
    name: str,
    unit: str = "-",
    frame: str = "-",
    parts: Sequence[Any] = "xyz",
    values: tuple[float, float, float] | None = None,
) -> tuple[Quantity, ...]:
    """The components of a vector, or the entries of a list: `x of the velocity`, ...

    Args:
        name: what the parts belong to.
        unit: of every part.
        frame: of every part.
        parts: what the parts are called; the axes when left out.
        values: what -1, 0 and 1 stand for, of every part.
    """
    return tuple(Quantity(f"{part} of the {name}", unit, frame, values) for part in parts)


def described(text: str, function: Function) -> Function:
    """The same function with a docstring: for a lambda, or a function that another one returns."""
    function.__doc__ = text
    return function


def description(function: Any) -> str:
    """The first paragraph of a function's docstring in one line; of one without a docstring nothing."""
    if isinstance(function, functools.partial) and "__doc__" not in vars(function):
        function = function.func
    text = inspect.getdoc(function) or ""
    return " ".join(text.split("\n\n")[0].split())

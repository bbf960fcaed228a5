"""Declarations of effects and pair effects for the engines."""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])


@dataclasses.dataclass(frozen=True)
class Needs:
    """Declaration of an effect, attached by `declare`; kept by `functools.partial` and `functools.wraps`."""

    contact: str = ""
    """Kind of contact: `ground`, `obstacles` or `drones`; empty for other effects.

    Bullet rejects contact effects, as it resolves contacts itself. The explicit backend computes contact with obstacles
    only near one, and stops fast drones at their surfaces."""
    ground_only: bool = False
    """Whether the effect uses only the ground of a scene."""
    largest_step: float = math.inf
    """Longest physics step with which the effect is stable, s; the explicit backend rejects longer ones."""


def declare(needs: Needs) -> Callable[[Function], Function]:
    """Declare the needs of an effect, as a decorator."""

    def declared(function: Function) -> Function:
        function.__dict__["needs"] = needs
        return function

    return declared


def layers(function: Callable) -> Iterator[Any]:
    """A function, and then those inside where it has bound arguments or is a wrapper, such as that of `jax.jit`."""
    inner: Any = function
    while inner is not None:
        yield inner
        inner = inner.func if isinstance(inner, functools.partial) else getattr(inner, "__wrapped__", None)


def needs_of(function: Callable) -> Needs:
    """Declaration of an effect, also of one with bound arguments or in a wrapper."""
    declared = (getattr(layer, "needs", None) for layer in layers(function))
    return next((needs for needs in declared if isinstance(needs, Needs)), Needs())

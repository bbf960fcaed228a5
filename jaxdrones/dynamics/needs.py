"""What an effect or a pair effect declares about itself, so that an engine treats it as it must."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])


@dataclasses.dataclass(frozen=True)
class Needs:
    """A declaration; `declare` gives it to a function, and `functools.partial` and `functools.wraps` keep it."""

    contact: str = ""
    """What the drone touches, `ground`, `obstacles` or `drones`; empty if the effect is no contact.

    Bullet refuses contact, because it resolves contacts by itself. The explicit backend checks that its physics step is
    short enough, computes contact with obstacles only where one is near, and stops fast drones at their surfaces."""
    ground_only: bool = False
    """Whether all that the effect looks at in a scene is if there is a ground."""


def declare(needs: Needs) -> Callable[[Function], Function]:
    """Declare the needs of an effect, as a decorator."""

    def declared(function: Function) -> Function:
        function.__dict__["needs"] = needs
        return function

    return declared


def needs_of(function: Callable) -> Needs:
    """The needs that an effect declares, also one with bound arguments."""
    while isinstance(function, functools.partial):
        function = function.func
    needs = getattr(function, "needs", None)
    return needs if isinstance(needs, Needs) else Needs()

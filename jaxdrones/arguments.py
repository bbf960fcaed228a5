"""Ranges of arguments, stated in annotations such as `height: Annotated[float, number("m", above=0)]`.

The decorator `checked` validates the annotated arguments of a function, or of a dataclass when it is made. Numbers that
are not shapes may be traced by JAX, and are then not validated; neither are defaults, and `None` where it is allowed.
"""

import dataclasses
import functools
import inspect
import typing
from collections.abc import Callable, Iterable
from typing import Annotated, Any, TypeVar, cast

import jax

from jaxdrones import checks
from jaxdrones.checks import check_key, check_switch, check_whole, is_concrete, short_repr
from jaxdrones.errors import UserError
from jaxdrones.limits import LARGEST_COUNT, LARGEST_SEED

Check = Callable[[str, Any], Any]
"""(name, value) of an argument; raises for a wrong value."""


@dataclasses.dataclass(frozen=True)
class Range:
    """Check with another name of the argument in messages, such as "{argument} of {function}"."""

    check: Check
    name: str

    def __call__(self, argument: str, value: Any) -> None:
        """Raise for a wrong value."""
        self.check(self.name.format(argument=argument) or argument, value)

    def __repr__(self) -> str:
        stated = getattr(self.check, "keywords", {}).items()
        return f"Range({', '.join(f'{name}={bound!r}' for name, bound in stated if bound != '')})"


Function = TypeVar("Function", bound=Callable[..., Any])


def number(unit: str = "", name: str = "", **bounds: Any) -> Range:
    """One real number within bounds (`at_least`, `above`, `at_most`, `below`); `name` is that of messages."""
    return Range(functools.partial(checks.check_number, unit=unit, **bounds), name)


def whole(name: str = "", minimum: int = 1, limit: int | None = None) -> Range:
    """Integer of at least `minimum`, and at most `limit`."""
    return Range(functools.partial(check_whole, minimum=minimum, limit=limit), name)


def choice(kind: str, known: Iterable[str]) -> Check:
    """One of the known names."""
    return lambda argument, value: checks.check_choice(kind, value, known)


def sequence(example: str, each: Check | None = None) -> Check:
    """Check of a sequence whose entries pass the check `each`; `example` is an entry, for messages."""

    def check(argument: str, value: Any) -> None:
        for entry in checks.check_sequence(argument, value, example):
            if each is not None:
                each(argument, entry)

    return check


def choices(kind: str, known: Iterable[str], example: str) -> Check:
    """Sequence of known names."""
    return sequence(example, choice(kind, known))


def function(example: str, arguments: tuple[str, ...] | None = None, name: str = "") -> Range:
    """Function, of these arguments if they are given; `example` is one."""
    return Range(functools.partial(checks.check_function, arguments=arguments, example=example), name)


def shape(*lengths: int | str, meaning: str, name: str = "", finite: bool = False) -> Range:
    """Array of this shape, and with `finite` only of finite numbers; a string is any length of at least one."""
    return Range(functools.partial(checks.check_shape, shape=lengths, meaning=meaning, finite=finite), name)


def quaternion(name: str = "") -> Range:
    """Unit quaternions (..., 4)."""
    return Range(checks.check_quaternion, name)


def _count_if_known(name: str, value: Any) -> None:
    if is_concrete(value):
        count(name, value)


def _check_layers(name: str, sizes: Any) -> None:
    if not isinstance(sizes, tuple | list) or not sizes:
        raise UserError(f"{name} is {short_repr(sizes)}; give the sizes of the hidden layers, for example (32, 32)")
    for size in sizes:
        check_whole(f"an entry of {name}", size)


Scalar = float | jax.Array
"""Number that may be traced, for `jax.vmap` over many values."""
Positive = Annotated[Scalar, number(above=0)]
PositiveOrInfinite = Annotated[Scalar, number(above=0, infinite=True)]
NotNegative = Annotated[Scalar, number(at_least=0)]
Fraction = Annotated[Scalar, number(at_least=0, at_most=1)]
PositiveFraction = Annotated[Scalar, number(above=0, at_most=1)]
BelowOne = Annotated[Scalar, number(at_least=0, below=1)]
Seconds = Annotated[float, number("s", above=0)]
TimeStep = Annotated[float, number("s", above=0, at_most=1)]
Hertz = Annotated[float, number("1/s", above=0)]
count, seed = whole(limit=LARGEST_COUNT), whole(minimum=0, limit=LARGEST_SEED)
Count = Annotated[int, count]
TracedCount = Annotated[int | jax.Array, _count_if_known]
NonNegativeInt = Annotated[int, whole(minimum=0)]
Switch = Annotated[bool, check_switch]
HiddenSizes = Annotated[tuple[int, ...], _check_layers]
Key = Annotated[jax.Array, check_key]


def checked(function: Function) -> Function:
    """Decorate a function or dataclass to validate annotated arguments, and to name the closest to an unknown one."""
    called: Any = function.__dict__["__init__"] if isinstance(function, type) else function
    parameters = inspect.signature(called).parameters.values()
    positional = [p.name for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    known = {p.name for p in parameters}
    others = next((p.name for p in parameters if p.kind is p.VAR_KEYWORD), None)

    @functools.wraps(called)
    def checking(*args: Any, **kwargs: Any) -> Any:
        ranges = _ranges(function)
        for name, value in (*zip(positional, args, strict=False), *kwargs.items()):
            if name not in known and others is None:
                checks.check_keyword(function.__qualname__, name, known - {"self", "cls"})
            optional, to_pass = ranges.get(name if name in known else others, (False, ()))
            for check in () if optional and value is None else to_pass:
                check(name, value)
        return called(*args, **kwargs)

    if isinstance(function, type):
        setattr(function, "__init__", checking)  # noqa: B010, a type checker does not let it be assigned
        return function
    return cast(Function, checking)


@functools.cache
def _ranges(function: Callable[..., Any]) -> dict[str | None, tuple[bool, list[Check]]]:
    """Of every annotated argument, whether it may be `None`, and its checks."""
    ranges: dict[str | None, tuple[bool, list[Check]]] = {}
    called = function.__name__.replace("_", "-")
    for name, hint in typing.get_type_hints(function, include_extras=True).items():
        parts = hint, *typing.get_args(hint)
        stated = [_of_function(check, called) for part in parts for check in getattr(part, "__metadata__", ())]
        if stated:
            ranges[name] = any(type(None) in typing.get_args(part) for part in parts), stated
    return ranges


def _of_function(check: Check, called: str) -> Check:
    return Range(check.check, check.name.replace("{function}", called)) if isinstance(check, Range) else check

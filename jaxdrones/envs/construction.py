"""Objects that are known by how they were made: they pickle, compare and hash by their arguments."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, TypeVar, cast

import jax
import numpy as np

Function = TypeVar("Function", bound=Callable[..., Any])


class Constructed:
    """A base class whose objects remember how they were made, and which attributes were set afterwards.

    `_programs`, what is compiled for an object, is its own and is emptied when an attribute is set.
    """

    def __new__(cls, *args: Any, **kwargs: Any) -> Any:  # noqa: D102
        made = super().__new__(cls)
        _remember(made, (cls, args, kwargs))
        return made

    def __setattr__(self, name: str, value: Any) -> None:
        vars(self).update(_changes=vars(self)["_changes"] | {name: value}, _programs={})
        super().__setattr__(name, value)

    def __reduce__(self):
        return _made_again, (*vars(self)["_recipe"], vars(self)["_changes"])

    def __copy__(self):
        copied = object.__new__(type(self))
        vars(copied).update(vars(self), _programs={})
        return copied

    def __deepcopy__(self, memo: dict):
        return self.__copy__()

    def __eq__(self, other: object) -> bool:
        return self is other or (type(other) is type(self) and self._key == other._key)

    def __hash__(self) -> int:
        return hash(self._key)

    @property
    def _key(self) -> Any:
        return comparable((vars(self)["_recipe"], vars(self)["_changes"]))


def remembered(function: Function) -> Function:
    """The same function; what it returns is known by the arguments of this call."""

    @functools.wraps(function)
    def called(*args: Any, **kwargs: Any) -> Any:
        made = function(*args, **kwargs)
        _remember(made, (called, args, kwargs))
        return made

    return cast(Function, called)


def constructed(made: Constructed) -> None:
    """Forget the attributes that were set during the construction, which follow from its arguments."""
    vars(made)["_changes"] = {}


def comparable(value: Any) -> Any:
    """Something that is equal and hashes alike for equal arguments: arrays by their numbers, functions as they are."""
    if isinstance(value, jax.core.Tracer):
        return id(value)
    if isinstance(value, np.ndarray | jax.Array):
        array = np.asarray(value)
        return "array", array.shape, str(array.dtype), array.tobytes()
    if isinstance(value, Mapping):
        return "mapping", tuple((name, comparable(x)) for name, x in sorted(value.items(), key=lambda entry: entry[0]))
    if isinstance(value, list | tuple):
        return "sequence", tuple(map(comparable, value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        return type(value), tuple(comparable(getattr(value, field.name)) for field in fields)
    return value


def _remember(made: Any, recipe: tuple[Callable, tuple, dict[str, Any]]) -> None:
    vars(made).update(_recipe=recipe, _changes={})


def _made_again(function: Callable, args: tuple, kwargs: dict[str, Any], changes: dict[str, Any]) -> Any:
    made = function(*args, **kwargs)
    for name, value in changes.items():
        setattr(made, name, value)
    return made

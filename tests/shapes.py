"""A type checker for the import hook of jaxtyping: shapes of arrays, and nothing else, are checked in every call.

After the call, so that a function's own errors about wrong input come first.
"""

import functools
import inspect
import typing
from collections.abc import Callable
from typing import Any

import beartype
import jax.numpy as jnp
import jaxtyping
import numpy as np

_jaxtyped = jaxtyping.jaxtyped


def jaxtyped(*, typechecker: Callable) -> Callable:
    """`jaxtyping.jaxtyped` for what `checked` checks; calls of anything else would only take time."""
    return lambda thing: _jaxtyped(thing, typechecker=typechecker) if _is_checked(thing) else thing


def checked(function: Callable) -> Callable:
    """The function that jaxtyping calls with the arguments and the result of a function, which checks their shapes."""
    if not _is_checked(function):  # what it calls before
        return function
    hints = function.__annotations__
    function.__annotations__ = {name: hint if _has_shape(hint) else Any for name, hint in hints.items()}
    checking = beartype.beartype(function)

    @functools.wraps(function)
    def check(*args: Any, **kwargs: Any) -> Any:
        return checking(*map(_as_jax, args), **{name: _as_jax(value) for name, value in kwargs.items()})

    return check


def _as_jax(value: Any) -> Any:
    """Numbers and arrays of NumPy as arrays of JAX, which functions take in their place."""
    return jnp.asarray(value) if isinstance(value, np.ndarray | np.generic | float) else value


def _is_checked(thing: Any) -> bool:
    """Whether a function, or that which makes a dataclass, says what it returns and has shapes in its annotations."""
    hints = getattr(thing.__init__ if inspect.isclass(thing) else thing, "__annotations__", {})
    return hints.get("return", Any) is not Any and any(isinstance(x, str) or _has_shape(x) for x in hints.values())


def _has_shape(hint: Any) -> bool:
    if isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray):
        return True
    return any(map(_has_shape, typing.get_args(hint)))

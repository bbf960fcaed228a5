"""A type checker for the import hook of jaxtyping: shapes of arrays, and nothing else, are checked in every call.

After the call, so that a function's own errors about wrong input come first.
"""

import functools
import typing
from collections.abc import Callable
from typing import Any

import beartype
import jax.numpy as jnp
import jaxtyping
import numpy as np


def checked(function: Callable) -> Callable:
    """The function that jaxtyping calls with the arguments and the result of a function, which checks their shapes."""
    hints = function.__annotations__
    if hints.get("return", Any) is Any:  # what it calls before, or a function without an annotation
        return function
    if not any(map(_has_shape, hints.values())):
        return function
    function.__annotations__ = {name: hint if _has_shape(hint) else Any for name, hint in hints.items()}
    checking = beartype.beartype(function)

    @functools.wraps(function)
    def check(*args: Any, **kwargs: Any) -> Any:
        return checking(*map(_as_jax, args), **{name: _as_jax(value) for name, value in kwargs.items()})

    return check


def _as_jax(value: Any) -> Any:
    """Numbers and arrays of NumPy as arrays of JAX, which functions take in their place."""
    return jnp.asarray(value) if isinstance(value, np.ndarray | np.generic | float) else value


def _has_shape(hint: Any) -> bool:
    if isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray):
        return True
    return any(map(_has_shape, typing.get_args(hint)))

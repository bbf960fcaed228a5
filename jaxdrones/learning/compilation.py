"""Compilation of trainings and evaluations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax

from jaxdrones.accelerate.compiler import training_options


def jit(function: Callable, **arguments: Any) -> Any:
    """`jax.jit` with compiler options for training.

    The result can be called or lowered, but not inside another traced function, where JAX rejects compiler options.
    The options depend on the device, so this initializes it.

    Args:
        function: function to compile.
        **arguments: further arguments of `jax.jit`.
    """
    return jax.jit(function, compiler_options=training_options(), **arguments)


def is_tracing() -> bool:
    """Whether the caller runs inside a function that JAX is tracing to compile it."""
    return isinstance(jax.numpy.zeros(()) + 0, jax.core.Tracer)

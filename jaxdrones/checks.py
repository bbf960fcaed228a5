"""Errors that finish the sentence: what was wrong, what was given, what to do."""

import difflib
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np


def check_shape(name: str, array: Any, shape: tuple[int | str, ...], meaning: str) -> None:
    """Raise unless `array` has `shape`; a string entry stands for any length of at least one."""
    given = np.shape(array)
    fits = len(given) == len(shape) and all(
        n >= 1 if isinstance(wanted, str) else n == wanted for n, wanted in zip(given, shape, strict=True)
    )
    if not fits:
        wanted = "(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")"
        raise ValueError(f"{name} has shape {given}; expected {wanted}: {meaning}")


def check_finite(name: str, tree: Any) -> None:
    """Raise if a concrete array of `tree` holds NaN or infinity; traced values cannot be looked at."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if not isinstance(leaf, jax.core.Tracer) and not np.all(np.isfinite(leaf)):
            where = name + jax.tree_util.keystr(path)
            raise ValueError(f"{where} is not finite: {np.asarray(leaf).tolist()}; give finite numbers")


def check_positive(name: str, value: float, unit: str) -> None:
    """Raise unless a number is positive and finite; a traced one cannot be looked at."""
    if not isinstance(value, jax.core.Tracer) and not (np.isfinite(value) and value > 0):
        raise ValueError(f"{name} is {value}; give a positive number ({unit})")


def check_whole(name: str, value: int, minimum: int = 1) -> None:
    """Raise unless `value` is an integer of at least `minimum`."""
    if not isinstance(value, int | np.integer) or value < minimum:
        raise ValueError(f"{name} is {value!r}; give a whole number of at least {minimum}")


def check_choice(kind: str, name: str, known: Iterable[str]) -> None:
    """Raise unless `name` is one of the `known` names."""
    known = sorted(known)
    if name not in known:
        close = difflib.get_close_matches(str(name), known, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise ValueError(f"unknown {kind} {name!r}{hint} (known: {', '.join(known)})")

"""Two layouts of arrays over worlds, and primitives with one array per entry."""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdrones.accelerate import compiler
from jaxdrones.accelerate.fitting import ELEMENTWISE, PRODUCTS, REDUCTIONS

_MAX_UNROLLED = 32
"""Largest number of terms of an unrolled reduction; a loop is used for more."""

_OPERATIONS: dict[str, Callable] = {
    "reduce_sum": operator.add,
    "reduce_prod": operator.mul,
    "reduce_max": jnp.maximum,
    "reduce_min": jnp.minimum,
    "reduce_and": operator.and_,
    "reduce_or": operator.or_,
}


@dataclasses.dataclass(frozen=True)
class Whole:
    """Array of JAX (..., worlds), or without that axis if equal in all worlds."""

    x: Array
    varies: bool

    def in_all_worlds(self, worlds: int) -> Array:
        """Array with the axis over worlds, broadcast if necessary."""
        return self.x if self.varies else jnp.broadcast_to(self.x[..., None], (*self.x.shape, worlds))


Apart = np.ndarray
"""Array of objects, its entries: (worlds,) each, or () if equal in all worlds."""

Value = Whole | Apart


def apart(value: Value) -> Apart:
    """Split a value into entries."""
    if not isinstance(value, Whole):
        return value
    shape = value.x.shape[:-1] if value.varies else value.x.shape
    return of_numbers([value.x[i] for i in np.ndindex(shape)], shape)


def whole(value: Value) -> Whole:
    """Join a value into one array."""
    if isinstance(value, Whole):
        return value
    x = jnp.stack(_alike(value.flat))
    return Whole(x.reshape(*value.shape, *x.shape[1:]), x.ndim > 1)


def of_numbers(numbers: Sequence, shape: tuple[int, ...]) -> Apart:
    """Array of objects of a shape."""
    array = np.empty(len(numbers), object)
    for i, x in enumerate(numbers):
        array[i] = x
    return array.reshape(shape)


def number_by_number(eqn: compiler.Equation, inputs: list[Apart]) -> list[Apart]:
    """Results of an elementwise, rearranging or reducing equation."""
    p, x = eqn.params, inputs[0]
    match eqn.primitive.name:
        case name if name in ELEMENTWISE:
            return [_elementwise(eqn, inputs)]
        case name if name in REDUCTIONS:
            rows = np.moveaxis(x, p["axes"], range(len(p["axes"])))
            rows = rows.reshape(-1, *rows.shape[len(p["axes"]) :])
            totals = [functools.reduce(_OPERATIONS[name], _alike(rows[:, *i])) for i in np.ndindex(rows.shape[1:])]
            return [of_numbers(totals, rows.shape[1:])]
        case name if name in PRODUCTS:
            return product(eqn, *inputs)
        case "broadcast_in_dim":
            shape = np.ones(len(p["shape"]), int)
            shape[list(p["broadcast_dimensions"])] = x.shape
            return [np.broadcast_to(x.reshape(shape), p["shape"])]
        case "reshape":
            return [(x if p["dimensions"] is None else x.transpose(p["dimensions"])).reshape(p["new_sizes"])]
        case "squeeze":
            return [np.squeeze(x, p["dimensions"])]
        case "transpose":
            return [x.transpose(p["permutation"])]
        case "rev":
            return [np.flip(x, p["dimensions"])]
        case "concatenate":
            return [np.concatenate(inputs, p["dimension"])]
        case "stack":
            return [np.stack(inputs, p["axis"])]
        case "tile":
            return [np.tile(x, p["reps"])]
        case "split":
            return np.split(x, np.cumsum(p["sizes"])[:-1], p["axis"])
        case "unstack":
            return [np.squeeze(part, p["axis"]) for part in np.split(x, x.shape[p["axis"]], p["axis"])]
        case "slice":
            strides = p["strides"] or (1,) * x.ndim
            return [x[tuple(map(slice, p["start_indices"], p["limit_indices"], strides))]]
        case "pad":
            return [_padded(x, inputs[1].item(), eqn)]
        case name:
            raise compiler.UnknownError(name)


def reduced(eqn: compiler.Equation, x: Array) -> list[Array]:
    """Reduction, unrolled or by a loop: XLA may call a library for it, which a kernel cannot."""
    axes, operation = eqn.params["axes"], _OPERATIONS[eqn.primitive.name]
    rows = jnp.moveaxis(x, axes, range(len(axes)))
    rows = rows.reshape(-1, *rows.shape[len(axes) :])
    if len(rows) <= _MAX_UNROLLED:
        return [functools.reduce(operation, jnp.unstack(rows))]
    return [jax.lax.scan(lambda total, row: (operation(total, row), None), rows[0], rows[1:])[0]]


def product(eqn: compiler.Equation, a: Any, b: Any) -> list[Any]:
    """Product of two small arrays, of numbers or of entries, as a sum of products."""
    (contracted_a, contracted_b), (batch_a, batch_b) = eqn.params["dimension_numbers"]
    shape = eqn.outvars[0].aval.shape

    def terms(x: Any, contracted: Sequence[int], batch: Sequence[int]) -> Any:
        """Array (batch, free, contracted), each axis flattened."""
        free = [axis for axis in range(x.ndim) if axis not in (*contracted, *batch)]
        sizes = [math.prod(x.shape[axis] for axis in axes) for axes in (batch, free, contracted)]
        return x.transpose(*batch, *free, *contracted).reshape(sizes)

    a, b = terms(a, contracted_a, batch_a), terms(b, contracted_b, batch_b)
    products = [a[:, :, None, k] * b[:, None, :, k] for k in range(a.shape[-1])]
    return [functools.reduce(operator.add, products).reshape(shape)]


def _elementwise(eqn: compiler.Equation, inputs: list[Apart]) -> Apart:
    def result(*numbers):
        if eqn.primitive.name == "div" and isinstance(numbers[1], np.generic) and numbers[1] == 1:
            return numbers[0]  # `stored` in derivatives divides by one
        return eqn.primitive.bind(*_alike(numbers), **eqn.params)

    alike = np.broadcast_arrays(*inputs)
    return of_numbers([result(*numbers) for numbers in zip(*(x.flat for x in alike), strict=True)], alike[0].shape)


def _padded(x: Apart, value: Array, eqn: compiler.Equation) -> Apart:
    shape, config = eqn.outvars[0].aval.shape, eqn.params["padding_config"]
    padded = of_numbers([value] * int(np.prod(shape)), shape)
    for i in np.ndindex(x.shape):
        to = tuple(low + k * (1 + between) for k, (low, _, between) in zip(i, config, strict=True))
        if all(0 <= k < n for k, n in zip(to, shape, strict=True)):
            padded[to] = x[i]
    return padded


def _alike(numbers: Iterable) -> list:
    """Entries, all of shape (worlds,) if any is."""
    numbers = list(numbers)
    shape = max(map(jnp.shape, numbers), key=len)
    return [x if jnp.shape(x) == shape else jnp.broadcast_to(x, shape) for x in numbers]

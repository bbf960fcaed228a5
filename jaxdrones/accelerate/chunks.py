"""Traced programs for many worlds in chunks, by `jax.vmap` or as a single kernel."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdrones.accelerate import compiler
from jaxdrones.accelerate.compiler import is_cpu
from jaxdrones.accelerate.fitting import fits_a_kernel, fits_number_by_number, gains_by_chunks
from jaxdrones.accelerate.reordered import has_reordered, store_reordered
from jaxdrones.accelerate.soa import over_last_axis
from jaxdrones.arguments import Count, checked

_ONE_KERNEL = {"xla_cpu_small_call": "true", "inlineable": "false"}
"""Attributes for XLA's CPU compiler: compile this call to a single function, loops included. Otherwise every step of a
scan is about twenty kernels, each handed to a thread."""

_KERNEL_CHUNK, _VMAP_CHUNK = 128, 512
"""Number of worlds with states that fit in the cache: for a single kernel, and for many kernels."""


@dataclasses.dataclass(frozen=True)
class ChunkedProgram:
    """Program of one world, with the axes of its inputs over worlds."""

    program: Any
    consts: list[Array]
    along: tuple[int, ...]
    used: tuple[bool, ...]
    """Whether each argument of the function is an input; the others do not matter for its results."""
    chunk: int | None

    @classmethod
    @checked
    def of(
        cls,
        function: Callable,
        tree: Any,
        of_one_world: Sequence[jax.ShapeDtypeStruct],
        along: tuple[int, ...],
        chunk: Count | None,
    ) -> tuple[ChunkedProgram, Any]:
        """Trace a function of one world; return its program and the structure of its result.

        Raises:
            ValueError: a `chunk` that is not a positive integer.
        """
        program, consts, shape = compiler.trace(lambda *leaves: function(*tree.unflatten(leaves)), *of_one_world)
        program, used = compiler.without_dead(program)
        along = tuple(itertools.compress(along, used))
        return cls(program, consts, along, tuple(used), chunk), jax.tree.structure(shape)

    @functools.cached_property
    def fits_a_kernel(self) -> bool:
        """Whether it can be a single kernel, or on an accelerator a few kernels per iteration of its loops."""
        return fits_a_kernel(self.program) and (is_cpu() or fits_number_by_number(self.program))

    def by_vmap(self, *leaves: Array) -> list[Array]:
        """Results for many worlds by `jax.vmap`, chunk by chunk where that is faster."""
        return self._by_vmap(self.consts, leaves)

    def by_one_kernel(self, *leaves: Array) -> list[Array]:
        """Results for many worlds, chunk by chunk in a single kernel. Derivatives are those of `by_vmap`.

        On an accelerator, whose threads share the worlds, there are no chunks.

        Raises:
            NoKernelError: the program cannot be a single kernel.
        """

        def of_worlds(consts, leaves):
            last = [jnp.moveaxis(x, axis, -1) for x, axis in zip(leaves, self.along, strict=True)]
            by_numbers = fits_number_by_number(self.program)
            results = over_last_axis(self.program, last, [True] * len(last), by_numbers, consts)
            return [jnp.moveaxis(x, -1, 0) for x in results]

        @jax.custom_jvp
        def flown(consts, leaves):
            if not is_cpu():
                return of_worlds(consts, leaves)
            return kernel_of_chunks(of_worlds, consts, leaves, self._worlds(leaves), self.along, self.chunk)

        flown.defjvp(lambda inputs, tangents: jax.jvp(self._by_vmap, inputs, tangents))
        return flown(self.consts, leaves)

    def _by_vmap(self, consts: Sequence[Array], leaves: Sequence[Array]) -> list[Array]:
        in_chunks = is_cpu() and gains_by_chunks(self.program)
        evaluate = store_reordered if in_chunks and has_reordered(self.program) else _as_it_is
        of_many = jax.vmap(functools.partial(evaluate, self.program, consts), self.along)
        if not in_chunks:
            return of_many(*leaves)
        chunks = _chunks(of_many, leaves, self.along, self.chunk or _VMAP_CHUNK)
        return [_joined(x, self._worlds(leaves)) for x in chunks]

    def _worlds(self, leaves: Sequence[Array]) -> int:
        return leaves[0].shape[self.along[0]]


def kernel_of_chunks(
    function: Callable,
    consts: Sequence[Array],
    leaves: Sequence[Array],
    worlds: int,
    axes: Sequence[int] | None = None,
    chunk: int | None = None,
) -> list[Array]:
    """Results of `function(consts, leaves)`, chunk by chunk in a single kernel; leaves have worlds on their `axes`."""
    along = (0,) * len(leaves) if axes is None else tuple(axes)

    @as_one_kernel
    def chunks(consts, leaves):
        return _chunks(lambda *leaves: function(consts, leaves), leaves, along, chunk or _KERNEL_CHUNK)

    return [_joined(x, worlds) for x in chunks(consts, leaves)]


def _as_it_is(program: Any, consts: Sequence[Array], *inputs: Array) -> list[Array]:
    return compiler.as_function(program, consts)(*inputs)


def _chunks(function: Callable, leaves: Sequence[Array], axes: tuple[int, ...], size: int) -> list[Array]:
    """Results of a function chunk by chunk, (chunks, worlds of a chunk, ...)."""
    worlds = leaves[0].shape[axes[0]]
    size = min(size, worlds)

    def chunk(first):
        return function(
            *(jax.lax.dynamic_slice_in_dim(x, first, size, axis) for x, axis in zip(leaves, axes, strict=True))
        )

    # The last chunk overlaps the one before: some worlds are computed twice, but with one program.
    return jax.lax.map(chunk, jnp.minimum(jnp.arange(0, worlds, size), worlds - size))


def _joined(chunks: Array, worlds: int) -> Array:
    """Concatenate (chunks, worlds of a chunk, ...) along the worlds, without the overlap of the last chunk."""
    count, size, *shape = chunks.shape
    if count * size == worlds:
        return chunks.reshape(worlds, *shape)
    rest = worlds - (count - 1) * size
    return jnp.concatenate([chunks[:-1].reshape(worlds - rest, *shape), chunks[-1, -rest:]])


def as_one_kernel(function: Callable) -> Callable:
    """Compile the function to a single kernel.

    XLA computes a single large result in several threads, and aborts for an unused argument. So the first number of
    each argument is returned, too. Closed-over arrays become opaque arguments, because XLA would inline their numbers.
    """

    def kernel(consts, leaves):
        def with_firsts(consts, leaves):
            return function(consts, leaves), [x.reshape(-1)[:1] for x in (*consts, *leaves)]

        inputs = jax.lax.optimization_barrier((list(map(jnp.asarray, consts)), list(leaves)))
        called = compiler.set_notes(jax.jit(with_firsts)(*inputs), **_ONE_KERNEL)
        return jax.lax.optimization_barrier(called)[0]

    return kernel

"""One traced program for many worlds, a chunk of them after another: by `jax.vmap`, or as a single kernel."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdrones.accelerate import compiler
from jaxdrones.accelerate.fitting import fits_a_kernel
from jaxdrones.accelerate.reordered import has_reordered, store_reordered
from jaxdrones.accelerate.soa import vmap_for_kernel
from jaxdrones.checks import check_whole

_ONE_KERNEL = {"xla_cpu_small_call": "true", "inlineable": "false"}
"""Notes to XLA's CPU compiler: make a single function of what this `jax.jit` calls, loops included. It would otherwise
run every step of a scan as some twenty kernels, and hand each to a thread."""

_KERNEL_CHUNK, _VMAP_CHUNK = 128, 512
"""Worlds whose states stay in the cache during a flight: of a flight as one kernel, and of one as many kernels."""


@dataclasses.dataclass(frozen=True)
class ChunkedProgram:
    """A program of one world, and the axes along which its inputs have many."""

    program: Any
    consts: list[Array]
    along: tuple[int, ...]
    chunk: int | None

    @classmethod
    def of(
        cls,
        function: Callable,
        tree: Any,
        of_one_world: Sequence[jax.ShapeDtypeStruct],
        along: tuple[int, ...],
        chunk: int | None,
    ) -> tuple[ChunkedProgram, Any]:
        """Trace a function of one world; returns its program and the structure of its result.

        Raises:
            ValueError: `chunk` is given and not a whole number above zero.
        """
        if chunk is not None:
            check_whole("chunk", chunk)
        program, consts, shape = compiler.trace(lambda *leaves: function(*tree.unflatten(leaves)), *of_one_world)
        return cls(program, consts, along, chunk), jax.tree.structure(shape)

    @functools.cached_property
    def fits_a_kernel(self) -> bool:
        """Whether it can be a single kernel."""
        return fits_a_kernel(self.program)

    def by_vmap(self, *leaves: Array) -> list[Array]:
        """The results for many worlds by `jax.vmap`, chunk by chunk unless the program has effects."""
        return self._by_vmap(self.consts, leaves)

    def by_one_kernel(self, *leaves: Array) -> list[Array]:
        """The results for many worlds, chunk by chunk in a single kernel. Derivatives are those of `by_vmap`.

        Raises:
            NoKernelError: it can be none, which shows only here.
        """

        @_as_one_kernel
        def chunks(consts, leaves):
            def of_a_chunk(*leaves):
                last = [jnp.moveaxis(x, axis, -1) for x, axis in zip(leaves, self.along, strict=True)]
                return [jnp.moveaxis(x, -1, 0) for x in vmap_for_kernel(self.program, consts, last)]

            return _chunks(of_a_chunk, leaves, self.along, self.chunk or _KERNEL_CHUNK)

        @jax.custom_jvp
        def flown(consts, leaves):
            return [_joined(x, self._worlds(leaves)) for x in chunks(consts, leaves)]

        flown.defjvp(lambda inputs, tangents: jax.jvp(self._by_vmap, inputs, tangents))
        return flown(self.consts, leaves)

    def _by_vmap(self, consts: Sequence[Array], leaves: Sequence[Array]) -> list[Array]:
        evaluate = store_reordered if has_reordered(self.program) else _as_it_is
        of_many = jax.vmap(functools.partial(evaluate, self.program, consts), self.along)
        if self.program.effects:
            return of_many(*leaves)
        chunks = _chunks(of_many, leaves, self.along, self.chunk or _VMAP_CHUNK)
        return [_joined(x, self._worlds(leaves)) for x in chunks]

    def _worlds(self, leaves: Sequence[Array]) -> int:
        return leaves[0].shape[self.along[0]]


def _as_it_is(program: Any, consts: Sequence[Array], *inputs: Array) -> list[Array]:
    return compiler.as_function(program, consts)(*inputs)


def _chunks(function: Callable, leaves: Sequence[Array], axes: tuple[int, ...], size: int) -> list[Array]:
    """The results of a function for one chunk of the worlds after another, (chunks, worlds of a chunk, ...)."""
    worlds = leaves[0].shape[axes[0]]
    size = min(size, worlds)

    def chunk(first):
        return function(
            *(jax.lax.dynamic_slice_in_dim(x, first, size, axis) for x, axis in zip(leaves, axes, strict=True))
        )

    # The last chunk is a whole one too: some worlds are flown twice, but one program is compiled.
    return jax.lax.map(chunk, jnp.minimum(jnp.arange(0, worlds, size), worlds - size))


def _joined(chunks: Array, worlds: int) -> Array:
    """Join (chunks, worlds of a chunk, ...) along the worlds; of the last chunk only those that no other has."""
    count, size, *shape = chunks.shape
    if count * size == worlds:
        return chunks.reshape(worlds, *shape)
    rest = worlds - (count - 1) * size
    return jnp.concatenate([chunks[:-1].reshape(worlds - rest, *shape), chunks[-1, -rest:]])


def _as_one_kernel(function: Callable) -> Callable:
    """The function as a single kernel.

    XLA would have several threads compute a single large result, and aborts where an argument is not used. So the first
    number of each argument is returned too. What the function closes over is an argument whose value XLA does not see,
    because XLA would put its numbers in its place.
    """

    def kernel(consts, leaves):
        def with_firsts(consts, leaves):
            return function(consts, leaves), [x.reshape(-1)[:1] for x in (*consts, *leaves)]

        inputs = jax.lax.optimization_barrier((list(map(jnp.asarray, consts)), list(leaves)))
        called = compiler.set_notes(jax.jit(with_firsts)(*inputs), **_ONE_KERNEL)
        return jax.lax.optimization_barrier(called)[0]

    return kernel

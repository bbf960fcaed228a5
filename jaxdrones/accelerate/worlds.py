"""Many worlds at once, as fast as the device flies them."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, TypeVar, cast

import jax
import jax.numpy as jnp
from jax.sharding import AxisType, PartitionSpec
from jaxtyping import Array

from jaxdrones.accelerate import compiler
from jaxdrones.accelerate.reordered import has_reordered, store_reordered
from jaxdrones.accelerate.soa import NoKernel, fits_a_kernel, vmap_for_kernel
from jaxdrones.checks import check_whole

_ONE_KERNEL = {"xla_cpu_small_call": "true", "inlineable": "false"}
"""To XLA's CPU compiler: make a single function of what this `jax.jit` calls, loops included. It would otherwise run
every step of a scan as some twenty kernels, and hand each to a thread: 19 instead of (with `KERNEL_OPTIONS`) 11 ns a
step of a drone with lagging rotors and drag, with gradients 117 and 35."""

_KERNEL_CHUNK, _CHUNK = 128, 512
"""Worlds whose states a cache holds in a flight as one kernel, and in one by many kernels."""


P = ParamSpec("P")
R = TypeVar("R")


def over_worlds(
    function: Callable[P, R],
    chunk: int | None = None,
    in_axes: int | Sequence[int] = 0,
    one_kernel: bool = True,
    devices: Sequence[jax.Device] = (),
) -> Callable[P, R]:
    """A function of one world, for many: of arrays with an axis over worlds in place of its arguments.

    It gives what `jax.vmap` gives, of every function. On a CPU the function is applied to one chunk of the worlds after
    another, whose states stay in the cache. Where it has loops and is made of arithmetic, as flights and their
    gradients are, it is compiled as a single kernel, which keeps one core busy; with sorting, matrix products, solvers,
    random numbers or branches as usual. Derivatives belong in the function: around it they are those of `jax.vmap`,
    which this is on other devices. `jax.jit(over_worlds(fly), compiler_options=jaxdrones.KERNEL_OPTIONS)` is faster
    still.

    Args:
        function: of one world; what is the same for all worlds it closes over.
        chunk: worlds of a chunk: 128 if left out, in many kernels 512.
        in_axes: axis over worlds, of each argument or of all. Commands (steps, worlds, ...), that is 1, are read faster
            than (worlds, steps, ...): at 2,048 steps a flight under a controller takes two thirds of the time.
            Results have worlds first.
        one_kernel: False for many kernels in any case.
        devices: each flies an equal share of the worlds. A CPU is one device, unless JAX is told before its first use:
            `jax.config.update("jax_num_cpu_devices", 2)`.

    Raises:
        ValueError: chunk is not a whole number above zero. When called: other arguments than `in_axes` is of, arguments
            of unequal numbers of worlds, or a number that the devices do not divide.
    """
    if chunk is not None:
        check_whole("chunk", chunk)

    def many(*arguments: Any) -> Any:
        axes = tuple(in_axes) if isinstance(in_axes, Sequence) else (in_axes,) * len(arguments)
        worlds = _worlds(arguments, axes)
        share: Callable[..., Any] = jax.vmap(function, axes)
        if worlds and jax.default_backend() == "cpu" and _is_able():
            share = _on_a_cpu(function, chunk, axes, one_kernel)
        if not worlds or len(devices) < 2:
            return share(*arguments)
        if worlds % len(devices):
            raise ValueError(f"{worlds} worlds cannot be shared equally by {len(devices)} devices; give a multiple")
        mesh = jax.make_mesh((len(devices),), ("worlds",), axis_types=(AxisType.Auto,), devices=devices)
        shares = tuple(PartitionSpec(*[None] * axis, "worlds") for axis in axes)
        first = PartitionSpec("worlds")
        return jax.shard_map(share, mesh=mesh, in_specs=shares, out_specs=first, check_vma=False)(*arguments)

    return cast(Callable[P, R], many)


def _worlds(arguments: tuple, axes: tuple[int, ...]) -> int:
    """The number of worlds, which all arguments must have."""
    for axis in axes:
        check_whole("an axis of in_axes", axis, minimum=0)
    if len(axes) != len(arguments):
        raise ValueError(f"in_axes is of {len(axes)} arguments, {len(arguments)} were given; give an axis for each")
    shapes = [(jnp.shape(x), axis) for tree, axis in zip(arguments, axes, strict=True) for x in jax.tree.leaves(tree)]
    for shape, axis in shapes:
        if len(shape) <= axis:
            raise ValueError(f"an array of shape {shape} has no axis {axis} over worlds; give one, or close over it")
    found = {shape[axis] for shape, axis in shapes}
    if len(found) != 1:
        raise ValueError(f"arguments of {sorted(found)} worlds, by in_axes {axes}; give all of them the same number")
    return found.pop()


def _is_able() -> bool:
    if not compiler.AVAILABLE:
        _warn("lacks an interface")
    return compiler.AVAILABLE


@functools.cache
def _warn(why: str) -> None:
    warnings.warn(
        f"jaxdrones.over_worlds is jax.vmap here: JAX {jax.__version__} {why} that it knows",
        RuntimeWarning,
        stacklevel=4,
    )


def _on_a_cpu(function: Callable, chunk: int | None, axes: tuple[int, ...], one_kernel: bool) -> Callable:
    """The function of many worlds, chunk by chunk: as one kernel where it can be one, and where that is wanted."""

    def share(*arguments):
        leaves, tree = jax.tree.flatten(jax.tree.map(jnp.asarray, arguments))
        worlds = _worlds(arguments, axes)
        along = tuple(axis for argument, axis in zip(arguments, axes, strict=True) for _ in jax.tree.leaves(argument))
        of_one_world = map(_without_axis, leaves, along)
        program, consts, shape = compiler.trace(lambda *leaves: function(*tree.unflatten(leaves)), *of_one_world)

        def by_vmap(consts, leaves):
            evaluate = store_reordered if has_reordered(program) else _as_it_is
            of_many = jax.vmap(functools.partial(evaluate, program, consts), along)
            if program.effects:
                return of_many(*leaves)
            return [_joined(x, worlds) for x in _chunks(of_many, leaves, along, chunk or _CHUNK)]

        @_as_one_kernel
        def chunks(consts, leaves):
            def of_a_chunk(*leaves):
                last = [jnp.moveaxis(x, axis, -1) for x, axis in zip(leaves, along, strict=True)]
                return [jnp.moveaxis(x, -1, 0) for x in vmap_for_kernel(program, consts, last)]

            return _chunks(of_a_chunk, leaves, along, chunk or _KERNEL_CHUNK)

        @jax.custom_jvp
        def by_one_kernel(consts, leaves):
            return [_joined(x, worlds) for x in chunks(consts, leaves)]

        by_one_kernel.defjvp(lambda inputs, tangents: jax.jvp(by_vmap, inputs, tangents))
        try:
            fits = one_kernel and fits_a_kernel(program)
            results = (by_one_kernel if fits else by_vmap)(consts, leaves)
        except NoKernel:
            results = by_vmap(consts, leaves)
        except compiler.Unknown as error:
            _warn(f"has an equation ({error}) other than those")
            results = by_vmap(consts, leaves)
        return jax.tree.structure(shape).unflatten(results)

    return share


def _as_it_is(program: Any, consts: Sequence[Array], *inputs: Array) -> list[Array]:
    return compiler.as_function(program, consts)(*inputs)


def _without_axis(x: Array, axis: int) -> jax.ShapeDtypeStruct:
    shape = (*x.shape[:axis], *x.shape[axis + 1 :])
    return jax.ShapeDtypeStruct(shape, x.dtype, weak_type=jax.typeof(x).weak_type)


def _chunks(function: Callable, leaves: Sequence[Array], axes: tuple[int, ...], size: int) -> list[Array]:
    """What a function of many worlds gives for chunks of them, (chunks, worlds of a chunk, ...)."""
    worlds = leaves[0].shape[axes[0]]
    size = min(size, worlds)

    def chunk(first):
        return function(
            *(jax.lax.dynamic_slice_in_dim(x, first, size, axis) for x, axis in zip(leaves, axes, strict=True))
        )

    # The last chunk starts where it is a whole one too: some worlds are flown twice, but one program is compiled.
    return jax.lax.map(chunk, jnp.minimum(jnp.arange(0, worlds, size), worlds - size))


def _joined(chunks: Array, worlds: int) -> Array:
    """(chunks, worlds of a chunk, ...) as one axis; of the last chunk the last worlds, if they are a rest."""
    count, size, *shape = chunks.shape
    if count * size == worlds:
        return chunks.reshape(worlds, *shape)
    rest = worlds - (count - 1) * size
    return jnp.concatenate([chunks[:-1].reshape(worlds - rest, *shape), chunks[-1, -rest:]])


def _as_one_kernel(function: Callable) -> Callable:
    """XLA would have several threads compute a single large result, and aborts where an argument is of no use.

    So the first number of each argument is returned too, and what the function closes over is an argument whose value
    XLA does not see: it would put what is constant in its place.
    """

    def kernel(consts, leaves):
        def with_firsts(consts, leaves):
            return function(consts, leaves), [x.reshape(-1)[:1] for x in (*consts, *leaves)]

        inputs = jax.lax.optimization_barrier((list(map(jnp.asarray, consts)), leaves))
        called = compiler.set_notes(jax.jit(with_firsts)(*inputs), **_ONE_KERNEL)
        return jax.lax.optimization_barrier(called)[0]

    return kernel

"""Many worlds at once, as fast as the device flies them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.sharding import AxisType, PartitionSpec

from jaxdrones.backends.soa import vmap_apart
from jaxdrones.checks import check_whole

KERNEL_OPTIONS = {
    "xla_cpu_prefer_vector_width": 512,
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_experimental_ynn_fusion_type": "",
}
"""For `jax.jit(over_worlds(...), compiler_options=...)` on a CPU: wider vectors where the CPU has them, and the elder
emitters; together 1.3 to 1.5 times as many steps of a single kernel. And no sums by a library, which do not compile in
one: gradients through contacts or downwash need it. Not JAX's default, and nothing to other devices.
"""

_ONE_KERNEL = {"xla_cpu_small_call": "true", "inlineable": "false"}
"""To XLA's CPU compiler: make a single function of what this `jax.jit` calls, loops included. It would otherwise run
every step of a scan as some twenty kernels, and hand each to a thread: 19 instead of (with `KERNEL_OPTIONS`) 11 ns a
step of a drone with lagging rotors and drag, with gradients 117 and 35."""


def over_worlds(
    function: Callable,
    chunk: int | None = None,
    in_axes: int | Sequence[int] = 0,
    one_kernel: bool = True,
    devices: Sequence[jax.Device] = (),
) -> Callable[..., Any]:
    """A function of one world, for many: of arrays with an axis over worlds in place of its arguments.

    On a CPU it is applied to one chunk of the worlds after another, whose states stay in the cache, all compiled as a
    single kernel, which keeps one core busy. So it should be a flight of many steps, or the gradient of one, not a
    step. Derivatives belong in the function: around it they are those of `jax.vmap`, which this is on other devices.
    `jax.jit(over_worlds(fly), compiler_options=jaxdrones.KERNEL_OPTIONS)` is faster still.

    Args:
        function: of one world; what is the same for all worlds it closes over.
        chunk: worlds of a chunk: 128 if left out, in many kernels 512.
        in_axes: axis over worlds, of each argument or of all. Commands (steps, worlds, ...), that is 1, are read faster
            than (worlds, steps, ...): at 2,048 steps a flight under a controller takes two thirds of the time.
            Results have worlds first.
        one_kernel: False for a function with matrix products, sorting or solvers (networks, `rates`, `Cells`). Of these
            XLA cannot make one kernel, and says UNIMPLEMENTED, "Failed to materialize symbols" or "Incorrect number of
            arguments". Gradients of teams, or through contacts or downwash, need `KERNEL_OPTIONS`.
        devices: each flies an equal share of the worlds. A CPU is one device, unless JAX is told before its first use:
            `jax.config.update("jax_num_cpu_devices", 2)`.

    Raises:
        ValueError: chunk is not a whole number above zero. When called: other arguments than `in_axes` is of, arguments
            of unequal numbers of worlds, or a number that the devices do not divide.
    """
    chunk = (128 if one_kernel else 512) if chunk is None else chunk
    check_whole("chunk", chunk)

    def many(*arguments):
        axes = tuple(in_axes) if isinstance(in_axes, Sequence) else (in_axes,) * len(arguments)
        worlds = _worlds(arguments, axes)
        if jax.default_backend() != "cpu":
            share = jax.vmap(function, axes)
        else:
            share = _chunk_by_chunk(function, chunk, axes, one_kernel)
        if len(devices) < 2:
            return share(*arguments)
        if worlds % len(devices):
            raise ValueError(f"{worlds} worlds cannot be shared equally by {len(devices)} devices; give a multiple")
        mesh = jax.make_mesh((len(devices),), ("worlds",), axis_types=(AxisType.Auto,), devices=devices)
        shares = tuple(PartitionSpec(*[None] * axis, "worlds") for axis in axes)
        first = PartitionSpec("worlds")
        return jax.shard_map(share, mesh=mesh, in_specs=shares, out_specs=first, check_vma=False)(*arguments)

    return many


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


def _chunk_by_chunk(function: Callable, chunk: int, axes: tuple[int, ...], one_kernel: bool) -> Callable:
    def flown(*arguments):
        worlds = _worlds(arguments, axes)
        size = min(chunk, worlds)

        def part(first):
            def cut(tree, axis):
                return jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, first, size, axis), tree)

            if not one_kernel:
                return jax.vmap(function, axes)(*map(cut, arguments, axes))
            last = [_moved(cut(tree, axis), axis, -1) for tree, axis in zip(arguments, axes, strict=True)]
            return _moved(vmap_apart(function)(*last), -1, 0)

        # The last chunk starts where it is a whole one too: some worlds are flown twice, but one program is compiled.
        return jax.lax.map(part, jnp.minimum(jnp.arange(0, worlds, size), worlds - size))

    def joined(*arguments):
        done = (_as_one_kernel(flown) if one_kernel else flown)(*arguments)
        rest = _worlds(arguments, axes) % chunk
        return jax.tree.map(lambda x: _joined(x, rest), done)

    return joined


def _joined(chunks: jax.Array, rest: int) -> jax.Array:
    """(chunks, worlds of a chunk, ...) as one axis; of the last chunk the last worlds, if they are a rest."""
    if len(chunks) == 1 or not rest:
        return chunks.reshape(-1, *chunks.shape[2:])
    return jnp.concatenate([chunks[:-1].reshape(-1, *chunks.shape[2:]), chunks[-1, -rest:]])


def _moved(tree, axis: int, to: int):
    return jax.tree.map(lambda x: jnp.moveaxis(x, axis, to), tree)


def _as_one_kernel(function: Callable) -> Callable:
    """XLA would have several threads compute a single large result, and aborts where an argument is of no use.

    So the first number of each argument is returned too, and what the function closes over is an argument whose value
    XLA does not see: it would put what is constant in its place.
    """

    def kernel(*arguments):
        traced, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)

        def with_firsts(consts, leaves):
            results = jaxpr_as_fun(ClosedJaxpr(traced.jaxpr, consts))(*leaves)
            return results, [x.reshape(-1)[:1] for x in (*consts, *leaves)]

        inputs = jax.lax.optimization_barrier((traced.consts, jax.tree.leaves(arguments)))
        called = set_xla_metadata(jax.jit(with_firsts)(*inputs), **_ONE_KERNEL)
        return jax.tree.structure(shape).unflatten(jax.lax.optimization_barrier(called)[0])

    return kernel

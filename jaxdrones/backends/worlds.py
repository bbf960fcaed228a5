"""Many worlds at once, as fast as the device flies them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.experimental.xla_metadata import set_xla_metadata
from jax.sharding import AxisType, PartitionSpec

from jaxdrones.checks import check_whole

KERNEL_OPTIONS = {"xla_cpu_prefer_vector_width": 512, "xla_cpu_use_fusion_emitters": False}
"""For `jax.jit(over_worlds(...), compiler_options=...)` on a CPU: wider vectors where the CPU has them, and the elder
emitters; together 1.3 to 1.5 times as many steps of a single kernel. Not JAX's default, and nothing to other devices.
"""

_ONE_KERNEL = {"xla_cpu_small_call": "true", "inlineable": "false"}
"""To XLA's CPU compiler: make a single function of what this `jax.jit` calls, loops included. It would otherwise run
every step of a scan as some twenty kernels, and hand each to a thread: 78 M steps/s, not 121 M or more, of a drone with
lagging rotors in each of 1,024 worlds; with gradients 9.9 and 27 M. Compiles in half the time."""


def over_worlds(
    function: Callable, chunk: int = 512, one_kernel: bool = True, devices: Sequence[jax.Device] = ()
) -> Callable[..., Any]:
    """A function of one world, for many: of arrays with a leading axis over worlds in place of its arguments.

    On a CPU it is applied to one chunk of the worlds after another, whose states stay in the cache, and each call of it
    is compiled as a single kernel, which keeps one core busy. So it should be a flight of many steps, or the gradient
    of one, not a step. On other devices this is `jax.vmap`.
    `jax.jit(over_worlds(fly), compiler_options=jaxdrones.KERNEL_OPTIONS)` is faster still.

    Args:
        function: of one world; what is the same for all worlds it closes over.
        chunk: worlds of a chunk.
        one_kernel: False for a function with matrix products, sorting or solvers (networks, `rates`, `Cells`), and for
            one that returns long trajectories (half a megabyte of a chunk). Of these XLA cannot make one kernel, and
            says UNIMPLEMENTED, "Failed to materialize symbols" or "Incorrect number of arguments".
        devices: each flies an equal share of the worlds. A CPU is one device, unless JAX is told before its first use:
            `jax.config.update("jax_num_cpu_devices", 2)`.

    Raises:
        ValueError: chunk is not a whole number above zero.
    """
    check_whole("chunk", chunk)
    if jax.default_backend() == "cpu":
        world = _as_one_kernel(function) if one_kernel else function

        def share(*arguments):
            return jax.lax.map(lambda x: world(*x), arguments, batch_size=chunk)
    else:
        share = jax.vmap(function)
    if len(devices) < 2:
        return share
    mesh = jax.make_mesh((len(devices),), ("worlds",), axis_types=(AxisType.Auto,), devices=devices)
    shared = PartitionSpec("worlds")
    return jax.shard_map(share, mesh=mesh, in_specs=shared, out_specs=shared, check_vma=False)


def _as_one_kernel(function: Callable) -> Callable:
    called = jax.jit(function)
    return lambda *arguments: set_xla_metadata(called(*arguments), **_ONE_KERNEL)

"""Worlds spread over the devices of one host or of several.

A training state is the same on every device but for its `worlds`, of which each flies a share. A world's random numbers
are its own whoever flies it, so the result is that of one device, to rounding. Devices exchange gradients and
statistics, and nothing while they fly: a flight is a `shard_map` (`each_device`), what surrounds it is left to the
compiler. To use it without `training.Trainer`:

    with jax.set_mesh(sharding.devices(config.worlds)):
        result = jax.jit(lambda key: bptt.train(key, env, config))(key)

A CPU is one device, unless JAX is told before its first use: `jax.config.update("jax_num_cpu_devices", 2)`, or
`XLA_FLAGS=--xla_force_host_platform_device_count=2` in the environment.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

_AXIS = "worlds"

WORLDS = PartitionSpec(_AXIS)
"""Of arrays (w, ...)."""
STEPS = PartitionSpec(None, _AXIS)
"""Of arrays (t, w, ...)."""
SAME = PartitionSpec()
"""On every device."""


def devices(worlds: int, chosen: Sequence[jax.Device] | None = None) -> Mesh:
    """Devices, each with an equal share of the worlds.

    Args:
        worlds: number of them.
        chosen: devices; all of all hosts when left out.

    Raises:
        ValueError: worlds is no multiple of the number of devices.
    """
    chosen = jax.devices() if chosen is None else chosen
    count = len(chosen)
    if worlds % count:
        raise ValueError(
            f"worlds is {worlds}, to be shared by {count} devices; give a multiple of {count}, "
            "or hide devices (CUDA_VISIBLE_DEVICES=0 leaves one)"
        )
    return jax.make_mesh((count,), (_AXIS,), axis_types=(AxisType.Auto,), devices=chosen)


def everywhere(mesh: Mesh) -> NamedSharding:
    """Where arrays are that every device has all of."""
    return NamedSharding(mesh, SAME)


def layout(mesh: Mesh, state: Any) -> Any:
    """Where the arrays of a training state are to be: a tree of shardings of its structure."""
    placed = jax.tree.map(lambda _: everywhere(mesh), state)
    return placed.replace(worlds=jax.tree.map(lambda _: NamedSharding(mesh, WORLDS), state.worlds))


def placed(mesh: Mesh, state: Any) -> Any:
    """A training state that every host has all of, spread over the devices."""
    return jax.jit(lambda x: x, out_shardings=layout(mesh, state))(state)


def each_device(function: Callable, inputs: Any, outputs: Any) -> Callable:
    """The function, run by each device of `jax.set_mesh` on its own share; the function itself where there is one.

    The gradient by an argument that is the `SAME` everywhere is the sum over devices, right for a loss that is taken of
    all worlds outside; `check_vma=False` forms it once, at the end, not in every step of a scan.

    Args:
        function: of arrays; what it closes over must not be differentiated.
        inputs: `WORLDS`, `STEPS` or `SAME` for each argument.
        outputs: the same for each result.
    """
    if jax.sharding.get_abstract_mesh().shape.get(_AXIS, 1) == 1:
        return function
    return jax.shard_map(function, in_specs=inputs, out_specs=outputs, check_vma=False)


def whole(mesh: Mesh, tree: Any) -> Any:
    """A copy of all of it on one device of each host; every host has to ask."""
    same = jax.jit(lambda x: x, out_shardings=everywhere(mesh))(tree)
    return jax.tree.map(lambda x: x.addressable_data(0), same)

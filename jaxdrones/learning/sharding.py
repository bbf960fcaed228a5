"""Training on several devices, of one host or of several: each device simulates its share of the worlds.

A training state is replicated on all devices but for its `worlds`, which are divided among them. A world draws the same
random numbers on whichever device it is, so the result equals that of one device up to rounding. Devices exchange
gradients and statistics; while trajectories are collected, which is a `shard_map` (`map_worlds`), they exchange
nothing. To use several devices without `jaxdrones.training`:

    with jax.set_mesh(sharding.make_mesh(config.worlds)):
        result = jax.jit(lambda key: bptt.train(key, env, config))(key)

A CPU is one device, unless JAX is told before its first use: `jax.config.update("jax_num_cpu_devices", 2)`, or
`XLA_FLAGS=--xla_force_host_platform_device_count=2` in the environment.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from jaxdrones.errors import UserError

_AXIS = "worlds"

WORLDS = PartitionSpec(_AXIS)
"""Arrays (w, ...), divided by worlds."""
STEPS = PartitionSpec(None, _AXIS)
"""Arrays (t, w, ...), divided by worlds."""
REPLICATED = PartitionSpec()
"""Arrays of which every device has a copy."""


def make_mesh(worlds: int, devices: Sequence[jax.Device] | None = None) -> Mesh:
    """A mesh of devices, each with an equal share of the worlds.

    Args:
        worlds: number of worlds.
        devices: devices to use; all devices of all hosts when left out.

    Raises:
        ValueError: worlds is not a multiple of the number of devices.
    """
    devices = jax.devices() if devices is None else devices
    count = len(devices)
    if worlds % count:
        raise UserError(
            f"worlds is {worlds}, to be shared by {count} devices; give a multiple of {count}, "
            "or hide devices (CUDA_VISIBLE_DEVICES=0 leaves one)"
        )
    return jax.make_mesh((count,), (_AXIS,), axis_types=(AxisType.Auto,), devices=devices)


def replicated(mesh: Mesh) -> NamedSharding:
    """The sharding of arrays of which every device has a copy."""
    return NamedSharding(mesh, REPLICATED)


def state_sharding(mesh: Mesh, state: Any) -> Any:
    """The shardings of the arrays of a training state, as a tree of its structure."""
    shardings = jax.tree.map(lambda _: replicated(mesh), state)
    return shardings.replace(worlds=jax.tree.map(lambda _: NamedSharding(mesh, WORLDS), state.worlds))


def shard_state(mesh: Mesh, state: Any) -> Any:
    """A training state of which every host has a copy, distributed over the devices."""
    return jax.jit(lambda x: x, out_shardings=state_sharding(mesh, state))(state)


def map_worlds(function: Callable, in_specs: Any, out_specs: Any) -> Callable:
    """The function, applied by each device of `jax.set_mesh` to its own worlds; with one device the function itself.

    The gradient with respect to a `REPLICATED` argument is summed over the devices, which is right for a loss that is
    computed outside from all worlds. With `check_vma=False` this sum is formed once, at the end, and not in every step
    of a scan.

    Args:
        function: function of arrays; the values that it closes over must not be differentiated.
        in_specs: `WORLDS`, `STEPS` or `REPLICATED` for each argument.
        out_specs: the same for each result.
    """
    if jax.sharding.get_abstract_mesh().shape.get(_AXIS, 1) == 1:
        return function
    return jax.shard_map(function, in_specs=in_specs, out_specs=out_specs, check_vma=False)


def gather(mesh: Mesh, tree: Any) -> Any:
    """A copy of the whole tree on one device of each host; every host has to call this."""
    copies = jax.jit(lambda x: x, out_shardings=replicated(mesh))(tree)
    return jax.tree.map(lambda x: x.addressable_data(0), copies)

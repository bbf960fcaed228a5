"""Training on several devices of one or more hosts: each device simulates its share of the worlds.

A training state is replicated on all devices except for its `worlds`, which are sharded. The random numbers of a world
are independent of its device, so the result equals that of one device up to rounding, except with `outlier_gradient`,
which compares a gradient with those of the worlds of its device. Devices exchange gradients and statistics, but nothing
during the collection of trajectories, which is a `shard_map` (`map_worlds`). To use several devices without
`jaxdrones.training`:

    with jax.set_mesh(sharding.make_mesh(config.worlds)):
        result = jax.jit(lambda key: bptt.train(key, env, config))(key)

A CPU is one device by default. Before the first use of JAX, set `jax.config.update("jax_num_cpu_devices", 2)`, or
`XLA_FLAGS=--xla_force_host_platform_device_count=2` in the environment.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from jaxdrones.errors import UserError

_AXIS = "worlds"

WORLDS = PartitionSpec(_AXIS)
"""Arrays (w, ...), sharded by worlds."""
STEPS = PartitionSpec(None, _AXIS)
"""Arrays (t, w, ...), sharded by worlds."""
REPLICATED = PartitionSpec()
"""Replicated arrays."""


def make_mesh(worlds: int, devices: Sequence[jax.Device] | None = None) -> Mesh:
    """Mesh of devices, each with an equal share of the worlds; by default of all devices of all hosts."""
    devices = jax.devices() if devices is None else devices
    count = len(devices)
    if worlds % count:
        raise UserError(
            f"worlds is {worlds}, to be shared by {count} devices; give a multiple of {count}, "
            "or hide devices (CUDA_VISIBLE_DEVICES=0 leaves one)"
        )
    return jax.make_mesh((count,), (_AXIS,), axis_types=(AxisType.Auto,), devices=devices)


def replicated(mesh: Mesh) -> NamedSharding:
    """Sharding of replicated arrays."""
    return NamedSharding(mesh, REPLICATED)


def state_sharding(mesh: Mesh, state: Any) -> Any:
    """Shardings of the arrays of a training state, as a tree of its structure."""
    shardings = jax.tree.map(lambda _: replicated(mesh), state)
    return shardings.replace(worlds=jax.tree.map(lambda _: NamedSharding(mesh, WORLDS), state.worlds))


def shard_state(mesh: Mesh, state: Any) -> Any:
    """Distribute a training state over the devices, given a copy on every host."""
    return jax.jit(lambda x: x, out_shardings=state_sharding(mesh, state))(state)


def map_worlds(function: Callable, in_specs: Any, out_specs: Any) -> Callable:
    """Map a function of arrays over the devices of `jax.set_mesh`, each with its own worlds.

    The specifications of arguments and results are `WORLDS`, `STEPS` or `REPLICATED`. Values in the closure of the
    function must not be differentiated. The gradient with respect to a `REPLICATED` argument is summed over the
    devices, as needed for a loss over all worlds outside of the function. With `check_vma=False` this sum is formed
    once, at the end, and not in every step of a scan.
    """
    if jax.sharding.get_abstract_mesh().shape.get(_AXIS, 1) == 1:
        return function
    return jax.shard_map(function, in_specs=in_specs, out_specs=out_specs, check_vma=False)


def on_every_device(tree: Any) -> Any:
    """Identity for arrays that every device computes for itself, outside of `map_worlds`."""
    if jax.sharding.get_abstract_mesh().shape.get(_AXIS, 1) == 1:
        return tree
    return jax.lax.with_sharding_constraint(tree, REPLICATED)


def mean_over_devices(tree: Any) -> Any:
    """Mean of the arrays of all devices, in one exchange; for functions of `map_worlds`."""
    if jax.sharding.get_abstract_mesh().shape.get(_AXIS, 1) == 1:
        return tree
    flat, unflatten = ravel_pytree(tree)
    return unflatten(jax.lax.pmean(flat, _AXIS))


def share_of_mean(x: Array, where: Array | None = None) -> Array:
    """Number of each device whose mean over devices is the mean of the entries of all devices `where` a mask holds.

    The mean over devices of their own means would give an entry more weight on a device with fewer of them.
    """
    if where is None:
        return jnp.mean(x)
    return jnp.sum(x, where=where) / mean_over_devices(jnp.sum(where, dtype=x.dtype))


def gather(mesh: Mesh, tree: Any) -> Any:
    """Copy of the whole tree on one device of each host; every host has to call this."""
    return jax.tree.map(lambda x: x.addressable_data(0), _copier(mesh)(tree))


@functools.cache
def _copier(mesh: Mesh) -> Callable[[Any], Any]:
    return jax.jit(lambda x: x, out_shardings=replicated(mesh))

"""The memory of a team of drones that have the same controller."""

from typing import Any

import jax
import jax.numpy as jnp

from jaxdrones.checks import check_whole


def for_team(memory: Any, n: int) -> Any:
    """The memory of a controller for each of `n` drones: every array gains a leading drone axis.

    Raises:
        ValueError: `n` < 1.
    """
    check_whole("number of drones", n)
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (n, *jnp.shape(x))), memory)

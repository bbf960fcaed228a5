"""Controller memory of a team."""

from typing import Any

import jax
import jax.numpy as jnp


def for_team(memory: Any, n: int) -> Any:
    """Memory of a controller for each of `n` drones, with a leading drone axis on every array."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (n, *jnp.shape(x))), memory)

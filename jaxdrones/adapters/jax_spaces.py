"""Spaces with samples by JAX, compatible with those of gymnax and JaxMARL."""

from collections.abc import Mapping
from typing import Any, Protocol

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxdrones.checks import check_shape


class Box:
    """Arrays between two bounds."""

    def __init__(self, low: ArrayLike, high: ArrayLike, shape: tuple[int, ...], dtype: Any = jnp.float32):
        self.low, self.high, self.shape, self.dtype = low, high, shape, dtype

    def sample(self, key: jax.Array) -> jax.Array:
        """Uniform sample between the bounds, which are -1 and 1 for unbounded entries."""
        bounded = jnp.isfinite(self.low) & jnp.isfinite(self.high)
        low, high = jnp.where(bounded, self.low, -1.0), jnp.where(bounded, self.high, 1.0)
        return jax.random.uniform(key, self.shape, minval=low, maxval=high).astype(self.dtype)

    def contains(self, x: Any) -> jax.Array:
        """Whether all entries of `x` are between the bounds."""
        return jnp.all((x >= self.low) & (x <= self.high))


class Discrete:
    """The numbers 0 to n - 1."""

    def __init__(self, num_categories: int, dtype: Any = jnp.int32):
        self.n, self.shape, self.dtype = num_categories, (), dtype

    def sample(self, key: jax.Array) -> jax.Array:
        """Uniform sample."""
        return jax.random.randint(key, (), 0, self.n, self.dtype)

    def contains(self, x: Any) -> jax.Array:
        """Whether `x` is one of the numbers."""
        return jnp.asarray((x >= 0) & (x < self.n))


class Dict:
    """Spaces by name."""

    def __init__(self, spaces: Mapping[str, Any]):
        self.spaces = spaces

    def sample(self, key: jax.Array) -> dict[str, jax.Array]:
        """A sample of every space."""
        keys = jax.random.split(key, len(self.spaces))
        return {name: space.sample(k) for k, (name, space) in zip(keys, self.spaces.items(), strict=True)}

    def contains(self, x: Mapping[str, Any]) -> jax.Array:
        """Whether every space contains its entry of `x`."""
        return jnp.all(jnp.stack([space.contains(x[name]) for name, space in self.spaces.items()]))


class Spaces(Protocol):
    """Module of space classes: this one, `gymnax.environments.spaces` or `jaxmarl.environments.spaces`."""

    Box: Any
    Discrete: Any
    Dict: Any


def of_gymnasium(space: gymnasium.Space, spaces: Spaces) -> Any:
    """Convert a gymnasium space."""
    if isinstance(space, gymnasium.spaces.Dict):
        return spaces.Dict({name: of_gymnasium(entry, spaces) for name, entry in space.items()})
    assert isinstance(space, gymnasium.spaces.Box)
    return spaces.Box(jnp.asarray(space.low), jnp.asarray(space.high), space.shape, space.dtype)


def action_space(discrete_actions: Any, size: int, spaces: Spaces) -> tuple[Float[Array, "k a"] | None, Any]:
    """Validated table of discrete actions, one per row, and their space; or `None` and the space of continuous ones."""
    if discrete_actions is None:
        return None, spaces.Box(-1.0, 1.0, (size,))
    table = np.asarray(discrete_actions, np.float32)
    check_shape("discrete_actions", table, ("k", size), "one row for every discrete action", finite=True)
    return jnp.asarray(table), spaces.Discrete(len(table))

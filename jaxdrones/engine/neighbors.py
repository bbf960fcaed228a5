"""Neighbor search in a large team by a grid of cells as wide as the interaction cutoff."""

import dataclasses
from typing import Annotated

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxdrones.arguments import Count, checked, number

_FARTHEST = 16_000  # cells from the middle of the team; drones farther out are clamped
_ROW = 2 * _FARTHEST + 3  # cells, one beyond either end


@checked
@dataclasses.dataclass(frozen=True)
class NeighborGrid:
    """Restrict pair effects to drones within a horizontal cutoff."""

    cutoff: Annotated[float, number("m", above=0)]
    """m; pairs farther apart do not interact."""
    capacity: Count = 24
    """Drones in three neighboring cells, each `cutoff` wide; with more, all pairs of the team are computed."""

    def near(self, pos: Float[Array, "n 3"]) -> tuple[Int[Array, "k n"], Bool[Array, "k n"], Bool[Array, ""]]:
        """Indices of candidates within the cutoff of each drone, their mask, and whether the list is complete.

        Drones are sorted by rows of the grid, so those in three neighboring cells of a row are contiguous.
        """
        middle = jnp.mean(pos[:, :2], axis=0, keepdims=True)
        column, row = jnp.clip(jnp.floor((pos[:, :2] - middle) / self.cutoff), -_FARTHEST, _FARTHEST).astype(int).T
        cell = row * _ROW + column
        order = jnp.argsort(cell)
        cells = cell[order]
        index, meant, complete = [], [], jnp.ones((), bool)
        for next_row in (-_ROW, 0, _ROW):
            first = jnp.searchsorted(cells, cell + next_row - 1)
            end = jnp.searchsorted(cells, cell + next_row + 1, side="right")
            slots = first[None] + jnp.arange(self.capacity)[:, None]
            index.append(order[jnp.minimum(slots, len(pos) - 1)])
            meant.append(slots < end[None])
            complete &= jnp.all(end - first <= self.capacity)
        return jnp.concatenate(index), jnp.concatenate(meant), complete

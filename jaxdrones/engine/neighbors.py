"""Who is near whom in a large team: a grid of cells as wide as the cutoff of what drones do to each other."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxdrones.checks import check_positive, check_whole

_FARTHEST = 16_000  # cells from the middle of the team; who is further counts as there
_ROW = 2 * _FARTHEST + 3  # cells, one beyond either end


@dataclasses.dataclass(frozen=True)
class NeighborGrid:
    """Pair effects between drones that are near each other in the horizontal plane, and no others."""

    cutoff: float
    """m; what is further apart does nothing to each other."""
    capacity: int = 24
    """Drones in three neighbouring cells, each `cutoff` wide; if there are more, all pairs of the team are tried."""

    def __post_init__(self):
        check_positive("cutoff", self.cutoff, "m")
        check_whole("capacity", self.capacity)

    def near(self, pos: Float[Array, "n 3"]) -> tuple[Int[Array, "k n"], Bool[Array, "k n"], Bool[Array, ""]]:
        """Indices of all that may be within cutoff of each drone, which of them are meant, and whether all are there.

        Drones are sorted row by row of the grid, so that those in three neighbouring cells of a row follow one another.
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

"""Trajectories of the high-level commander: polynomials of seventh order, in pieces."""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

PIECE_BYTES = 132
"""Size of a piece in the memory of trajectories."""
_ORDER = 8  # coefficients


class Goal(NamedTuple):
    """Point of a trajectory."""

    pos: np.ndarray
    """(3,) m, world."""
    vel: np.ndarray
    """(3,) m/s, world."""
    acc: np.ndarray
    """(3,) m/s^2, world."""
    yaw: float
    """rad."""
    yaw_rate: float
    """rad/s."""

    @classmethod
    def at_rest(cls, pos: np.ndarray, yaw: float) -> Self:
        """Point without motion."""
        return cls(np.array(pos, float), np.zeros(3), np.zeros(3), float(yaw), 0.0)


class Piece(NamedTuple):
    """Polynomials of x, y, z (m) and yaw (rad) in time (s)."""

    duration: float
    """s."""
    coefficients: np.ndarray
    """(4, 8) from the constant on."""


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """Pieces, one after the other, from a start time on; afterwards its last point without motion."""

    pieces: Sequence[Piece]
    begin: float
    """Time of its start, s."""
    scale: float = 1.0
    """Factor of its duration."""
    backwards: bool = False
    shift: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    """(3,) displacement after the turn, m."""
    turn: float = 0.0
    """Rotation about z, rad."""

    @property
    def duration(self) -> float:
        """Time from start to end, s."""
        return self.scale * sum(piece.duration for piece in self.pieces)

    def finished(self, t: float) -> bool:
        """Whether the trajectory has ended at time t (s)."""
        return t >= self.begin + self.duration

    def at(self, t: float) -> Goal:
        """Point at time t (s)."""
        along = min(max((t - self.begin) / self.scale, 0.0), self.duration / self.scale)
        if self.backwards:
            along = self.duration / self.scale - along
        for piece in self.pieces:
            if along <= piece.duration or piece is self.pieces[-1]:
                break
            along -= piece.duration
        speed = (-1.0 if self.backwards else 1.0) / self.scale if t < self.begin + self.duration else 0.0
        values = [piece.coefficients @ _row(along, order) * speed**order for order in range(3)]
        cos, sin = math.cos(self.turn), math.sin(self.turn)
        rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        pos, vel, acc = (rotation @ value[:3] for value in values)
        return Goal(pos + self.shift, vel, acc, values[0][3] + self.turn, values[1][3])


def go_to(start: Goal, pos: np.ndarray, yaw: float, duration: float, begin: float, linear: bool = False) -> Trajectory:
    """Trajectory from `start` at `begin` (s) to rest at a position (m, world) and yaw (rad, the shorter way).

    It has no jerk at its ends; a `linear` one begins and ends at once with a constant velocity.
    """
    way = (yaw - start.yaw + math.pi) % (2 * math.pi) - math.pi
    first = np.append(start.pos, start.yaw)
    last = np.append(pos, start.yaw + way)
    coefficients = np.zeros((4, _ORDER))
    if linear:
        coefficients[:, 0], coefficients[:, 1] = first, (last - first) / duration
    else:
        zero = np.zeros(4)
        begins = [first, np.append(start.vel, start.yaw_rate), np.append(start.acc, 0.0), zero]
        ends = [last, zero, zero, zero]
        rows = [_row(0.0, order) for order in range(4)] + [_row(1.0, order) for order in range(4)]
        right = [x * duration**order for order, x in enumerate(begins)] + ends  # in time over the duration
        coefficients = np.linalg.solve(np.array(rows), np.array(right)).T / duration ** np.arange(_ORDER)
    return Trajectory((Piece(duration, coefficients),), begin)


def unpack(memory: bytes, offset: int, count: int) -> list[Piece] | None:
    """Pieces in the memory of trajectories: 4 times 8 coefficients and a duration each; `None` if they are invalid."""
    if count == 0 or offset + count * PIECE_BYTES > len(memory):
        return None
    numbers = np.frombuffer(memory, "<f4", count * PIECE_BYTES // 4, offset).reshape(count, -1).astype(float)
    if not np.isfinite(numbers).all() or (numbers[:, -1] <= 0).any():
        return None
    return [Piece(float(row[-1]), row[:-1].reshape(4, _ORDER)) for row in numbers]


def _row(t: float, order: int) -> np.ndarray:
    """(8,) derivatives of the powers of t."""
    factors = [math.perm(k, order) * t ** (k - order) if k >= order else 0.0 for k in range(_ORDER)]
    return np.array(factors)

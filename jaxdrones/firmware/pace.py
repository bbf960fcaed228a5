"""Simulated and real time of a flight by the clock."""

from __future__ import annotations

import dataclasses

LATE = 0.1  # s, lag behind the clock after which the schedule restarts


@dataclasses.dataclass
class Pace:
    """Simulated and real time of a flight."""

    simulated_s: float = 0.0
    real_s: float = 0.0
    late: int = 0
    """Number of times that the flight fell behind the clock by 0.1 s."""

    @property
    def real_time_factor(self) -> float:
        """Simulated over real time."""
        return self.simulated_s / self.real_s if self.real_s else 0.0

"""Figures that others publish, each with its hardware and source; what accelerator.py compares with."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Figure:
    """A number and where it stands."""

    value: float
    unit: str
    what: str
    hardware: str
    source: str


_CRAZYFLOW = "README of github.com/learnsyslab/crazyflow, table Performance, commit 0d3bc9a"
CRAZYFLOW = {
    worlds: Figure(rate, "steps/s", "crazyflow, first-principles dynamics, one drone a world", "RTX 4090", _CRAZYFLOW)
    for worlds, rate in {64: 1.2e6, 1024: 18.7e6, 16384: 257e6, 65536: 678e6, 262144: 914e6}.items()
}
"""By number of worlds. The README does not say with which integrator and controller."""

_QUADSWARM = "Huang et al. 2023, arXiv 2306.09537, abstract"
QUADSWARM = {
    drones: Figure(rate, "samples/s", f"QuadSwarm, {drones} quadrotors a world", "CPU of 16 cores", _QUADSWARM)
    for drones, rate in {1: 48_500.0, 8: 62_000.0}.items()
}
"""By number of drones; environment steps, with observation and reward."""

LEARNING_TO_FLY_IN_SECONDS = Figure(
    18.0,
    "s",
    "training of a Crazyflie's rotor speeds from scratch",
    "laptop",
    "Eschmann et al. 2023, arXiv 2311.13081, abstract",
)

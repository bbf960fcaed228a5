"""Published figures with hardware and source, for the comparison in accelerator.py."""

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

_SKYFLOW = "README of github.com/Synetic-Labs/SkyFlow, section Performance, commit 09880db"
SKYFLOW_PLANT = {
    worlds: Figure(rate, "substeps/s", "SkyFlow, rk4 substeps of the plant at 1 kHz", "RTX 4090", _SKYFLOW)
    for worlds, rate in {64: 1.3e6, 1024: 23.7e6, 16384: 487e6, 65536: 1.08e9}.items()
}
SKYFLOW_ENVS = {
    worlds: Figure(rate, "steps/s", "SkyFlow, environment at 100 Hz, ten rk4 substeps, resets", "RTX 4090", _SKYFLOW)
    for worlds, rate in {64: 107e3, 1024: 2.0e6, 16384: 22.5e6, 65536: 35.5e6}.items()
}
"""By number of worlds."""

L2F = Figure(
    20e9,
    "steps/s",
    "l2f, the simulator of Learning to Fly in Seconds, rk4, about",
    "RTX 4090 mobile",
    "README of github.com/rl-tools/l2f-benchmark, commit 08d7317",
)

PUFFERLIB = Figure(
    6.4e6,
    "steps/s",
    "PufferLib 4.0, drone (hover and race), ppo with learning, 2,048 drones",
    "RTX 5090, physics on the CPU",
    "a user's measurement of github.com/PufferAI/PufferLib at 7b11311, 2026-07-02; the authors publish none of drones",
)

MUJOCO_WARP = Figure(
    1.36e6,
    "images/s",
    "MuJoCo Warp, render kernel alone, 64 x 64, 127 primitives, 8,192 worlds",
    "RTX 6000 Ada",
    "pull request 1113 of github.com/google-deepmind/mujoco_warp, from notes; its table was not read again",
)

LEARNING_TO_FLY_IN_SECONDS = Figure(
    18.0,
    "s",
    "training of a Crazyflie's rotor speeds from scratch",
    "laptop",
    "Eschmann et al. 2023, arXiv 2311.13081, abstract",
)

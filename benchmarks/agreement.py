"""Do simulators agree on the same flight, and what causes the differences?

All simulators start from the same tilted state in motion and receive the same rotor speeds for one second, in float64
(l2f: float32): jaxdrones with its defaults; gym-pybullet-drones (2021) and (2.x), both physics models of each, from
recorded data (tests/golden); and, in a separate environment (rivals/environment.py), crazyflow 0.4.0, rotorpy 3.0.0
and, if it can be installed, l2f 2.0.18, with their default integrators. Rotor speeds are fractions of hover speed.

The result is the largest difference during the second. rivals/switches.py switches each cause of a difference to the
behavior of the other simulator. `all switched` is the remaining difference, which should be rounding errors; the row of
a cause is the difference with all causes switched except this one.
"""

import argparse
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from benchmarks.rivals import environment, switches
from benchmarks.rivals.switches import Cause, Setup
from jaxdrones import rotation

GOLDEN = Path(__file__).parent.parent / "tests" / "golden"
SECONDS = 1.0
L2F = "l2f==2.0.18"
_BULLET_DAMPING = 0.03999999910593033  # 0.04 in single precision


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    jax.config.update("jax_enable_x64", True)
    rows, versions = recorded(), {}
    if not options.quick:
        there = environment.add(L2F)
        result = environment.run("benchmarks.rivals.agreement", *([] if there else ["--without-l2f"]))
        rows, versions = rows + result["rows"], result["versions"]
    lines = [line for row in rows for line in _table(row)]
    result = {"about": versions, "rows": rows}
    unexplained = [row["simulator"] for row in rows if not row["explained"]]
    if unexplained:
        result["failed"] = f"differences that no switch explains: {', '.join(unexplained)}"
    return result, lines


def recorded() -> list[dict]:
    """gym-pybullet-drones: the explicit model and Bullet, of both versions."""
    mirrored = Cause("frame", "rotors left and right exchanged", _mirrored)
    millimeters = Cause("constant", "rotor places rounded to millimeters", lambda s: s.but(rotor_pos=_rounded(s)))
    damped = Cause("drag", "Bullet's damping, 0.04 (1 + |v|) v", lambda s: s.plus(switches.damping(_BULLET_DAMPING)))
    stale = Cause("frame", "forces along the axes of the step before", switches.stale_frame)
    box = Cause(
        "inertia", "that of the collision box, not of the URDF",
        lambda setup: setup.but(inertia=_case("pyb_paper_cf2x_random_b_init")[1]["vehicle_constants"]["J_bullet"]),
    )  # fmt: skip
    angles = Cause(
        "attitude integration", "body rates added to roll, pitch and yaw",
        lambda setup: setup.but(integrator=switches.euler_angles),
    )  # fmt: skip
    world = Cause("drag frame", "along the world axes", lambda setup: setup.but(effects=(jd.drag_world_axes,)))
    earlier = Cause("rotor model", "drag from the rotor speeds of the step before", switches.earlier_speeds)
    ours = Setup(jd.load_params("cf2x"))
    flights = {
        "dyn_main_cf2x_random_b_init": ("gym-pybullet-drones (2.x), explicit", ours, []),
        "dyn_paper_cf2x_random_b_init": ("gym-pybullet-drones (2021), explicit", ours, [mirrored, angles]),
        "pyb_main_cf2x_random_b_init": ("gym-pybullet-drones (2.x), Bullet", ours, [millimeters, stale, damped]),
        "pyb_paper_cf2x_random_b_init": (
            "gym-pybullet-drones (2021), Bullet", ours, [mirrored, millimeters, box, stale, damped],
        ),
        "pyb_drag_main_cf2x_drag_a": (
            "gym-pybullet-drones (2.x), Bullet with drag", ours.plus(jd.drag),
            [world, earlier, millimeters, stale, damped],
        ),
    }  # fmt: skip
    rows = []
    for file, (name, setup, causes) in flights.items():
        start, tape, dt, theirs = _flight(file)
        rows.append(switches.attribution(name, setup, causes, start, tape, dt, theirs))
    return rows


def _mirrored(setup: Setup) -> Setup:
    return setup.but(rotor_pos=setup.params.rotor_pos * jnp.array([[1.0, -1, 1]]))


def _rounded(setup: Setup) -> np.ndarray:
    return np.round(np.asarray(setup.params.rotor_pos), 3)


def _case(file: str) -> tuple[dict[str, np.ndarray], dict]:
    with np.load(GOLDEN / f"{file}.npz") as arrays:
        return dict(arrays), json.loads((GOLDEN / f"{file}.json").read_text())


def _flight(file: str) -> tuple[jd.State, np.ndarray, float, dict[str, np.ndarray]]:
    """Start, tape, time step and the recorded states of the only drone of a case."""
    arrays, case = _case(file)
    dt = 1 / case["physics_freq_hz"]
    length = round(SECONDS / dt)
    states = {name: arrays[name][: length + 1, 0] for name in ("pos", "quat", "vel")}
    if "body_rates" in arrays:
        states["omega"] = arrays["body_rates"][: length + 1, 0]
    else:
        turn = jax.vmap(rotation.rotate_inverse)
        states["omega"] = np.asarray(turn(jnp.asarray(states["quat"]), jnp.asarray(arrays["ang_vel"][: length + 1, 0])))
    start = jd.State(**{name: jnp.asarray(x[0]) for name, x in states.items()}, rpm=jnp.zeros(4))
    return start, arrays["rpm_applied"][:length, 0], dt, {name: x[1:] for name, x in states.items()}


def _table(row: dict) -> list[str]:
    def numbers(d: dict) -> str:
        return f"{d['pos']:9.1e} m {d['angle']:9.1e} rad {d['vel']:9.1e} m/s {d['omega']:9.1e} rad/s"

    lines = [f"{row['simulator']}, {row['seconds']:g} s", f"    {'ours as it comes':66}{numbers(row['as it comes'])}"]
    lines += [f"    {'all but ' + c['kind'] + ': ' + c['what']:66}{numbers(c)}" for c in row["causes"]]
    verdict = "" if row["explained"] else f"  NOT EXPLAINED, above {row['rounding']:.0e}"
    return [*lines, f"    {'all switched':66}{numbers(row['all switched'])}{verdict}"]

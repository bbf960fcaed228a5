"""Does `firmware_pid` compute the same commands as the firmware, and how long does a call take?

Logs of NanoBench have est_pos, est_vel, est_quat, gyro, ref_pos, ref_yaw, vbat, pwm and cmd at 100 Hz. From the first
row with thrust, with integrators at zero and five calls at 500 Hz per row, the controller receives the logged estimates
and set-points; its commands are not simulated. Its desired roll and pitch (degrees) and its thrust (16 bit) are
compared with the logged ones. The height integrator drifts because of gaps in the log, so the difference in thrust is
also reported without a parabola in time.

The cost is the time of a step of one Crazyflie in each of many worlds by `over_worlds`, at 500 Hz with a new set-point
in every step, relative to the attitude loop and mixer of `pid` in the same run.
"""

import argparse
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from benchmarks.common import seconds
from benchmarks.rivals import ours
from jaxdrones.control import Setpoint, firmware_motors, firmware_pid, for_team

BUNDLED = Path(__file__).parent.parent / "tests/control/recorded/B10_lissajous_slow_rep1_from_take_off.npz"
DT = 0.002  # s
WORLDS, STEPS = 1024, 500


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("flights", nargs="*", type=Path, default=[BUNDLED], metavar="FLIGHT.npz")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    rows = [{"flight": path.stem, **agreement(path)} for path in options.flights]
    costs = cost(*((4, 10, 1) if options.quick else (WORLDS, STEPS, 7)))
    lines = []
    lines.append("flight                                   | roll, deg | pitch, deg | thrust | without drift | PWM")
    lines += [
        f"{row['flight']:40} | {row['roll']:9.3f} | {row['pitch']:10.3f} | {row['thrust']:6.0f} | "
        f"{row['thrust_without_drift']:13.0f} | {row['pwm_ratio']:.4f}"
        for row in rows
    ]
    lines += [f"{name}: {1e9 * row['seconds']:.1f} ns, {row['ratio']:.2f} times" for name, row in costs.items()]
    return {"rows": rows, "costs": costs}, lines


@jax.jit
def commanded(log: dict[str, jax.Array]) -> firmware_motors.Command:
    def row(memory, now):
        quat = jd.rotation.normalize(now["est_quat"])
        state = jd.State(now["est_pos"], quat, now["est_vel"], now["gyro"], jnp.zeros(4))
        target = Setpoint.at(now["ref_pos"], yaw=now["ref_yaw"])

        def call(memory, _):
            return firmware_pid.pwm(firmware_pid.gains(), memory, state, target, now["vbat"])

        memory, commands = jax.lax.scan(call, memory, length=5)
        return memory, jax.tree.map(lambda x: x[0], commands)

    return jax.lax.scan(row, firmware_pid.init(), log)[1]


def agreement(path: Path) -> dict[str, float]:
    """Root mean squares of the differences, and the mean duty cycle over the logged one."""
    with np.load(path) as arrays:
        log = {name: np.asarray(arrays[name], np.float32) for name in arrays}
    flying = np.flatnonzero(log["cmd"][:, 3] > 0)
    log = {name: x[flying[0] : flying[-1] + 1] for name, x in log.items()}
    inputs = ("est_pos", "est_vel", "est_quat", "gyro", "ref_pos", "ref_yaw", "vbat")
    command = commanded({name: jnp.asarray(log[name]) for name in inputs})
    inner = slice(2, -2)  # the first and the last row are halfway to no thrust
    off = (np.asarray(command.attitude)[:, :2] - log["cmd"][:, :2])[inner]
    thrust = (np.asarray(command.thrust) - log["cmd"][:, 3])[inner]
    t = np.linspace(-1, 1, len(thrust))
    roll, pitch = np.sqrt(np.mean(off**2, axis=0))
    return {
        "roll": float(roll),
        "pitch": float(pitch),
        "thrust": float(np.sqrt(np.mean(thrust**2))),
        "thrust_without_drift": float(np.std(thrust - np.polyval(np.polyfit(t, thrust, 2), t))),
        "pwm_ratio": float(np.mean(np.asarray(command.pwm)[inner]) / np.mean(log["pwm"][inner])),
    }


def cost(worlds: int, steps: int, repeats: int) -> dict[str, dict[str, float]]:
    """Seconds of a drone-step by each controller, and the ratio to the first."""
    step, params = jd.make_step(dt=DT), jd.repeat(jd.load_params("cf2x"), 1)
    start, _ = ours.starts(worlds, jax.random.key(0), params)
    rpy, thrust = ours.attitudes(worlds, steps, jax.random.key(1))
    asked = jnp.concatenate([rpy, thrust * np.float32(params.weight[0])], axis=-1)

    def fly(setpoint):
        def world(params, start, commands):
            def advance(carry, command):
                memory, state = carry
                control = functools.partial(firmware_pid.control, firmware_pid.gains(), dt=DT)
                memory, rpm = jax.vmap(control)(params, memory, state, jax.vmap(setpoint)(command))
                return (memory, step(params, state, rpm)), None

            return jax.lax.scan(advance, (for_team(firmware_pid.init(), 1), start), commands)[0][1]

        return world

    high = jnp.array([0, 0, 200.0])
    flights = {
        "attitude loop of pid": ours.controlled(step, DT),
        "firmware_pid, positions": fly(lambda x: Setpoint.at(high + x[:3], yaw=x[3])),
        "firmware_pid, attitudes": fly(lambda x: firmware_pid.Attitude(x[:3], 136000 * x[3])),
    }
    programs = {name: ours.program(flight, params, start, asked, axis=1) for name, flight in flights.items()}
    times = {name: seconds(program, repeats=repeats)["best"] / (worlds * steps) for name, program in programs.items()}
    first = next(iter(times.values()))
    return {name: {"seconds": time, "ratio": time / first} for name, time in times.items()}

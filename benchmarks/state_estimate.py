"""How accurately does the Kalman filter estimate the tilt in flights of a real Crazyflie?

Flights of NanoBench (Ullah and Baca 2026, arXiv 2603.09908): the log of the onboard IMU at 100 Hz, with gaps of the
radio link filled by linear interpolation, and Vicon's poses. The filter uses the IMU and Vicon's position; the error is
relative to Vicon's attitude, in flight. Two contributions are not errors of the filter: the attitude at which the
markers were defined as level, constant in each flight, and the errors of Vicon's attitude. To estimate the latter, the
last column compares Vicon's attitude with the tilt from Vicon's acceleration and the small lateral force of the IMU.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import butter, filtfilt

from jaxdrones import rotation
from jaxdrones.sensing import kalman
from jaxdrones.sensing.inertial import STANDARD_GRAVITY

POS_DEVIATION = 0.001  # m
ANGLE_DEVIATION = 0.035  # rad; of Vicon's attitude, where it is fused
OFFSET = (0.0, 0.0, 0.02)  # m, of the markers from the IMU; Vicon sees them 2 to 3 cm above it
LATE = 1  # rows by which the log is behind Vicon
NOISE = dict(gyro=0.1, acc=0.05, gyro_walk=1e-5, acc_walk=1e-3)  # with the gaps of the log, which are most of it
START = (0.01, 0.01, 0.02, 1e-3, 0.1)  # m, m/s, rad, rad/s (the firmware removes the bias on the ground), m/s^2
LOW_PASS = 2.0  # Hz


def load(path: Path) -> dict[str, np.ndarray]:
    """The columns of a flight, with Vicon as late as the log."""
    columns = {name: np.asarray(x, float) for name, x in np.load(path).items()}
    missing = [name for name in ("t", "gyro", "acc", "pos", "quat") if name not in columns]
    if missing:
        raise ValueError(f"{path.name} lacks {', '.join(missing)}; give flights with t, gyro, acc, pos and quat")
    now, seen = slice(LATE, None), slice(None, -LATE)
    logged = {name: columns[name][now] for name in ("t", "gyro", "acc")}
    return {**logged, **{name: columns[name][seen] for name in ("pos", "quat")}}


@jax.jit
def estimates(flight, angle_deviation):
    """Attitudes (n - 1, 4) by IMU and Vicon's position, and attitude where its deviation is finite."""
    noise = kalman.ImuNoise(**{name: jnp.asarray(x) for name, x in NOISE.items()})
    gravity, offset = jnp.asarray(STANDARD_GRAVITY), jnp.array(OFFSET)

    def step(estimate, row):
        before, after = row
        gyro, acc = ((before[name] + after[name]) / 2 for name in ("gyro", "acc"))
        dt = after["t"] - before["t"]
        estimate = kalman.predict(noise, estimate, gyro, STANDARD_GRAVITY * acc, gravity, dt)
        estimate = kalman.update_position(estimate, after["pos"], POS_DEVIATION, offset)
        fused = kalman.update_attitude(estimate, after["quat"], jnp.minimum(angle_deviation, 1e3))
        estimate = jax.tree.map(lambda a, b: jnp.where(jnp.isfinite(angle_deviation), a, b), fused, estimate)
        return estimate, estimate.quat

    quat = flight["quat"][0]
    pos = flight["pos"][0] - rotation.rotate(quat, offset)
    begun = kalman.init(pos, jnp.zeros(3), quat, jnp.repeat(jnp.array(START), 3))
    rows = tuple(jax.tree.map(lambda x, s=s: x[s], flight) for s in (slice(-1), slice(1, None)))
    return jax.lax.scan(step, begun, rows)[1]


def in_the_air(flight) -> slice:
    """Rows of the flight without takeoff and landing."""
    high = np.flatnonzero(flight["pos"][:, 2] > flight["pos"][0, 2] + 0.05)
    return slice(high[0] + 20, high[-1] - 10)


def tilt(quat, reference) -> np.ndarray:
    """Roll and pitch (n, 2) from an attitude to the reference, degrees."""
    return np.degrees(jax.vmap(kalman.angle)(jnp.asarray(quat), jnp.asarray(reference)))[:, :2]


def of_acceleration(flight) -> np.ndarray:
    """Roll and pitch (n, 2) from Vicon's acceleration to Vicon's attitude, degrees, low-passed."""

    def smooth(x):
        return filtfilt(*butter(3, LOW_PASS, fs=100), x, axis=0)

    quat = jnp.asarray(flight["quat"])
    pos = flight["pos"] - np.asarray(jax.vmap(rotation.rotate, (0, None))(quat, jnp.array(OFFSET)))
    acc = np.gradient(np.gradient(smooth(pos), flight["t"], axis=0), flight["t"], axis=0)
    force = smooth(jax.vmap(rotation.rotate_inverse)(quat, jnp.asarray(acc + np.array([0, 0, STANDARD_GRAVITY]))))
    felt = STANDARD_GRAVITY * smooth(flight["acc"])
    return np.degrees((force - felt)[:, :2] / STANDARD_GRAVITY)


def rms(x) -> float:
    """Root of the mean square of the length of rows, or of numbers."""
    return float(np.sqrt(np.mean(np.sum(np.atleast_2d(x.T).T ** 2, axis=-1))))


def row(path: Path) -> dict:
    """What is found in a flight, degrees."""
    flight = load(path)
    air = in_the_air(flight)
    error = tilt(estimates(flight, jnp.inf), flight["quat"][1:])[air]
    fused = tilt(estimates(flight, jnp.asarray(ANGLE_DEVIATION)), flight["quat"][1:])[air]
    level = error - error.mean(axis=0)
    own = of_acceleration(flight)[air]
    return {
        "flight": path.stem,
        "as logged": rms(error),
        "mounting": error.mean(axis=0).tolist(),
        "tilt": rms(level),
        "roll": rms(level[:, 0]),
        "pitch": rms(level[:, 1]),
        "with attitude": rms(fused - fused.mean(axis=0)),
        "vicon itself": rms(own - own.mean(axis=0)),
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("flights", nargs="+", type=Path, help="flights of NanoBench, .npz")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    jax.config.update("jax_enable_x64", True)
    rows = [row(path) for path in (options.flights[:1] if options.quick else options.flights)]
    names = ("as logged", "tilt", "roll", "pitch", "with attitude", "vicon itself")
    lines = [" ".join([f"{'rms, degrees':24}", *(f"{name:>14}" for name in names), f"{'mounting':>14}"])]
    for found in rows:
        mounting = "{:.1f}, {:.1f}".format(*found["mounting"])
        lines.append(
            " ".join([f"{found['flight']:24}", *(f"{found[name]:14.2f}" for name in names), f"{mounting:>14}"])
        )
    lines.append(" ".join([f"{'mean':24}", *(f"{np.mean([found[name] for found in rows]):14.2f}" for name in names)]))
    return {"rows": rows}, lines

"""Quaternions (x, y, z, w) as NumPy arrays (..., 4), for recorded data."""

import numpy as np


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of quaternions: the rotation b, then the rotation a."""
    u, v, s, t = a[..., :3], b[..., :3], a[..., 3:], b[..., 3:]
    vector = s * v + t * u + np.cross(u, v)
    return np.concatenate([vector, s * t - np.sum(u * v, axis=-1, keepdims=True)], axis=-1)


def conjugate(quat: np.ndarray) -> np.ndarray:
    """The inverse rotations."""
    return quat * np.array([-1, -1, -1, 1])


def rotate(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) in the world frame, from those in the body frame."""
    twice = 2 * np.cross(quat[..., :3], vector)
    return vector + quat[..., 3:] * twice + np.cross(quat[..., :3], twice)


def exp(vector: np.ndarray) -> np.ndarray:
    """The rotations of rotation vectors (..., 3), rad."""
    half = np.linalg.norm(vector, axis=-1, keepdims=True) / 2
    return np.concatenate([np.sinc(half / np.pi) * vector / 2, np.cos(half)], axis=-1)


def log(quat: np.ndarray) -> np.ndarray:
    """The rotation vectors (..., 3), rad, of at most half a turn."""
    shortest = np.where(quat[..., 3:] < 0, -quat, quat)
    sine = np.linalg.norm(shortest[..., :3], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, shortest[..., 3:])
    return np.where(sine > 0, angle / np.where(sine > 0, sine, 1), 2) * shortest[..., :3]


def slerp(t: np.ndarray, times: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """Attitudes at the times t, s, between attitudes (K, 4) at `times` (K,): at a constant rate in between."""
    before = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
    part = ((t - times[before]) / (times[before + 1] - times[before]))[:, None]
    return multiply(quat[before], exp(part * log(multiply(conjugate(quat[before]), quat[before + 1]))))

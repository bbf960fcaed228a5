"""Rotation of single vectors on the host: tuples of numbers in double precision, as pybullet returns them."""


def in_body(quat: tuple, vector: tuple) -> tuple[float, float, float]:
    """R^T v: a vector from the world frame to the body frame, v + w t + t x u with t = 2 v x u and q = (u, w)."""
    x, y, z, w = quat
    a, b, c = vector
    tx, ty, tz = 2 * (b * z - c * y), 2 * (c * x - a * z), 2 * (a * y - b * x)
    return a + w * tx + ty * z - tz * y, b + w * ty + tz * x - tx * z, c + w * tz + tx * y - ty * x

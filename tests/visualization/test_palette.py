"""Colors are told apart by people of all kinds of sight."""

import itertools

import numpy as np
import pytest

from jaxdrones.visualization.palette import COLORS, DISTINCT, as_rgb, colors

# linear RGB as people without one kind of cones see it: Machado, Oliveira, Fernandes (2009), severity 1
SIGHTS = {
    "all cones": np.eye(3),
    "no red cones": np.array([[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]]),
    "no green cones": np.array([[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]]),
    "no blue cones": np.array([[1.256, -0.077, -0.179], [-0.078, 0.931, 0.148], [0.005, 0.691, 0.304]]),
}
TO_XYZ = np.array([[0.4125, 0.3576, 0.1804], [0.2127, 0.7152, 0.0722], [0.0193, 0.1192, 0.9503]])
WHITE = TO_XYZ.sum(axis=1)


def lab(color, sight):
    """CIE 1976 L*a*b* of a color as it is seen."""
    level = as_rgb(color) / 255
    linear = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    x, y, z = TO_XYZ @ np.clip(SIGHTS[sight] @ linear, 0, 1) / WHITE
    x, y, z = (np.cbrt(s) if s > 216 / 24389 else 841 / 108 * s + 4 / 29 for s in (x, y, z))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def smallest_distance(palette, sight):
    seen = [lab(color, sight) for color in palette]
    return min(np.linalg.norm(a - b) for a, b in itertools.combinations(seen, 2))


@pytest.mark.parametrize("sight", SIGHTS)
def test_colors_are_far_apart_for_all_kinds_of_sight(sight):
    assert smallest_distance(COLORS, sight) > 15  # 2.3 is just noticeable
    assert smallest_distance([*COLORS, "#ffffff"], sight) > 15  # the ground of figures


def test_every_drone_has_a_color_of_its_own():
    palette = colors(DISTINCT)
    assert palette[: len(COLORS)] == COLORS and len(set(palette)) == DISTINCT == 24
    assert smallest_distance(palette, "all cones") > 8
    assert colors(DISTINCT + 3)[DISTINCT:] == COLORS[:3]

"""Colors of drones and lines in figures, films and pages, safe for color blindness, after Okabe and Ito (2008)."""

import numpy as np

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#882255", "#222222")
"""Blue, vermilion, green, purple, orange, sky blue, wine, near black."""
_SHADES = ((0.0, 0), (0.5, 255), (0.65, 0))  # fraction and level of the added gray, for every eight drones

DISTINCT = len(COLORS) * len(_SHADES)
"""Number of distinct colors."""


def colors(n: int) -> tuple[str, ...]:
    """Colors of n drones: the palette, then lighter and darker shades of it. Beyond `DISTINCT` they repeat."""
    found = []
    for i in range(n):
        share, gray = _SHADES[i // len(COLORS) % len(_SHADES)]
        mixed = (1 - share) * as_rgb(COLORS[i % len(COLORS)]) + share * gray
        found.append("#" + "".join(f"{round(x):02x}" for x in mixed))
    return tuple(found)


def as_rgb(color: str) -> np.ndarray:
    """(3,) red, green and blue of a color such as `#0072b2`, 0 to 255."""
    return np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)])

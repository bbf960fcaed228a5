"""Panels with the paths of a flight: in three dimensions, and in the widest plane."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from jaxdrones import rotation
from jaxdrones.flights.log import FlightLog
from jaxdrones.sensing import Mesh, Scene
from jaxdrones.sensing.files import File
from jaxdrones.visualization import style

_SMALLEST = 0.2  # m, range of a panel
MOST_NAMED = 12  # drones with a line in the legend each; paths of more are thin
_MOST_OBSTACLES = 400
_CORNERS = 180  # of the outline of an obstacle
OUTLINE: dict[str, Any] = {"facecolor": "#c9ced3", "edgecolor": "#9aa1a8", "linewidth": 0.8, "zorder": 0}
START: Any = dict(marker="o", markersize=7, markerfacecolor="white", markeredgewidth=1.8, linestyle="none")
_GOAL: dict[str, Any] = {"marker": "x", "markersize": 9, "markeredgewidth": 2.2, "linestyle": "none"}
END: dict[str, Any] = {"marker": "o", "markersize": 7, "linestyle": "none"}
ENDS = {"start": START, "end": END}
"""Style of the first and the last point of a path."""


def widest_plane(pos: np.ndarray) -> tuple[int, int]:
    """Two axes of largest extent of positions (K, n, 3), in the order x, y, z; x and z for a vertical line."""
    extent = [np.ptp(style.limits(pos[..., axis])) for axis in range(3)]
    first, second = np.argsort([-extent[0], -extent[1], -extent[2]], kind="stable")[:2]
    if extent[second] < 0.1 * extent[first]:
        second = {0: 1, 1: 0, 2: 0}[int(first)]
    return min(first, second), max(first, second)


def draw_plane(axis: Any, record: FlightLog, colors: Sequence[str]) -> None:
    """Draw the paths in the widest plane, at equal scales, with outlines of obstacles."""
    plane = prepare_plane(axis, [record])
    if record.scene.ground and plane[1] == 2:
        axis.axhline(0, color="#9aa1a8", linewidth=1.2, zorder=0)
    crowded = len(colors) > MOST_NAMED
    for i, color in enumerate(colors):
        _draw_path(axis, record.pos[:, i, plane], record.target_pos[:, i, plane], color, crowded)


def prepare_plane(axis: Any, records: Sequence[FlightLog]) -> list[int]:
    """Draw the obstacles of the first flight in its widest plane, and set the panel for paths; return the plane's axes.

    The scales are equal, with a limited aspect ratio.
    """
    plane = list(widest_plane(records[0].pos))
    for outline in outlines(records[0].scene, *np.eye(3)[plane]):
        axis.fill(*outline.T, **OUTLINE)
    found = np.array([ranges(record, plane) for record in records])  # (flights, 2 axes, 2 ends)
    (left, low), (right, high) = found[..., 0].min(axis=0), found[..., 1].max(axis=0)
    wide, tall = max(right - left, (high - low) / 1.5), max(high - low, (right - left) / 1.5)
    middle, height = (left + right) / 2, (low + high) / 2
    axis.set(xlim=(middle - wide / 2, middle + wide / 2), ylim=(height - tall / 2, height + tall / 2))
    axis.set_aspect("equal")
    title = "path from the side" if 2 in plane else "path from above"
    axis.set(xlabel=f"{'xyz'[plane[0]]} (m)", ylabel=f"{'xyz'[plane[1]]} (m)", title=title)
    return plane


def draw_space(axis: Any, record: FlightLog, colors: Sequence[str]) -> None:
    """Draw the paths in three dimensions, with projections on the floor of the panel."""
    spaces = ranges(record, [0, 1, 2])
    floor = spaces[2][0]
    crowded = len(colors) > MOST_NAMED
    for i, color in enumerate(colors):
        path, target = _inside(record.pos[:, i], spaces), _inside(record.target_pos[:, i], spaces)
        x, y, z = path.T
        if not crowded:
            axis.plot(x, y, np.full_like(z, floor), color="#c3c8cd", linewidth=1.2)
        _draw_path(axis, path, target, color, crowded)
    axis.set(xlim=spaces[0], ylim=spaces[1], zlim=spaces[2], xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
    spans = np.ptp(spaces, axis=1)
    axis.set_box_aspect(np.maximum(spans, 0.5 * spans.max()), zoom=0.95)
    axis.view_init(elev=26, azim=-55)
    axis.locator_params(nbins=4)
    axis.tick_params(labelsize=12, pad=3)
    for side in (axis.xaxis, axis.yaxis, axis.zaxis):
        side.labelpad = 10
    axis.set_title("path")


def _draw_path(axis: Any, path: np.ndarray, target: np.ndarray, color: str, crowded: bool) -> None:
    """Draw a path and its target (K, 2 or 3); of a crowd a thin path and its last point."""
    if crowded:
        axis.plot(*path.T, color=color, linewidth=0.8, alpha=0.6)
        axis.plot(*path[-1:].T, color=color, marker="o", markersize=4, linestyle="none")
        return
    axis.plot(*target.T, color=color, **style.TARGET)
    axis.plot(*path.T, color=color)
    axis.plot(*target[-1:].T, color=color, **_GOAL)
    axis.plot(*path[:1].T, color=color, **START)
    axis.plot(*path[-1:].T, color=color, **END)


def legend_handles(record: FlightLog) -> list[Any]:
    """Legend entries common to all drones of a figure."""
    from matplotlib.lines import Line2D

    looks = dict(ENDS)
    if len(record.labels) > MOST_NAMED:
        looks = {"end": END}
    elif np.isfinite(record.target_pos).any():
        looks = {"commanded": style.TARGET, "last target": _GOAL} | looks
    elif np.isfinite(record.target_vel).any():
        looks = {"commanded": style.TARGET} | looks
    return [Line2D([], [], color="#555555", label=label, **look) for label, look in looks.items()]


def outlines(scene: Scene, right: np.ndarray, up: np.ndarray) -> list[np.ndarray]:
    """Outlines (c, 2) of the obstacles of a scene, projected along the cross product of two directions (3,).

    They are empty for scenes with more than 400 obstacles and for URDF files.
    """
    solids = [solid.bounding_box() if isinstance(solid, Mesh) else solid for solid in scene.numbered.values()]
    if len(solids) > _MOST_OBSTACLES:
        return []
    angles = 2 * np.pi * np.arange(_CORNERS) / _CORNERS
    directions = np.cos(angles)[:, None] * right + np.sin(angles)[:, None] * up
    found = []
    for solid in solids:
        if isinstance(solid, File):
            continue
        local = jax.vmap(rotation.rotate_inverse, (None, 0))(solid.quat, directions)
        reach = np.asarray(jax.vmap(solid.extent)(local) + solid.rounding)
        following = np.roll(reach, -1)
        # the tangents at two neighboring directions meet at reach along the first and this much to its left
        aside = (following - reach * np.cos(angles[1])) / np.sin(angles[1])
        left = -np.sin(angles)[:, None] * right + np.cos(angles)[:, None] * up
        corners = np.asarray(solid.pos) + reach[:, None] * directions + aside[:, None] * left
        found.append(np.stack([corners @ right, corners @ up], axis=1))
    return found


def ranges(record: FlightLog, axes: Sequence[int]) -> list[tuple[float, float]]:
    """Ranges of panels for paths and commands along some axes, 0 to 2."""
    both = np.concatenate([record.pos, record.target_pos], axis=1)
    return [style.limits(both[..., axis], _SMALLEST) for axis in axes]


def _inside(path: np.ndarray, spaces: Sequence[tuple[float, float]]) -> np.ndarray:
    """Clip a path (K, 3) to the ranges, as three-dimensional axes do not clip."""
    low, high = np.transpose(spaces)
    return np.where(((path >= low) & (path <= high)).all(axis=1, keepdims=True), path, np.nan)

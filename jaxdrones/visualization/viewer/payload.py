"""Payload of a page: a JSON header and arrays of numbers, compressed, in base64.

The bytes before compression are the length of the header (uint32), the header, and the arrays, all little-endian. In
the header an array is `{"dtype", "offset", "shape", "low", "step"}`. Numbers within a resolution of 65,536 steps are
int16: they count steps from `low`, and are stored as differences along the first axis, modulo 2^16.
"""

import base64
import json
import math
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxdrones.errors import UserError
from jaxdrones.flights.log import STATE_AND_SPEEDS, FlightLog
from jaxdrones.sensing.scene import scene_to_dict
from jaxdrones.visualization.palette import COLORS, DISTINCT, as_rgb, colors
from jaxdrones.visualization.shots import only_shapes
from jaxdrones.visualization.viewer.contacts import contact_forces

_LARGEST_ERROR = {"pos": 5e-5, "targets": 5e-5, "loads": 5e-5}  # m, of rounding to int16
_FARTHEST = 10.0  # m: depth of the darkest pixel, if any is as far
_MOST = 2_000_000  # states of drones in a page, 60 MB
_LEVELS = 65535  # steps of an int16 beside the first
_CONSTANTS = ("rotor_pos", "prop_radius", "rotor_spin", "kf", "mass", "inertia", "gravity")  # of the page


class _Arrays:
    """Concatenated arrays and their offsets."""

    def __init__(self) -> None:
        self.data: list[bytes] = []
        self.size = 0

    def add(self, array: np.ndarray, largest_error: float = math.inf) -> dict[str, Any]:
        """Append an array (K, ...); return its entry in the header."""
        columns = array.shape[-1] if array.ndim > 1 else 1
        rows = np.asarray(array, float).reshape(-1, columns)
        finite = bool(np.isfinite(rows).all())
        with np.errstate(over="ignore"):
            low, step = rows.min(axis=0), np.ptp(rows, axis=0) / _LEVELS
        if array.ndim > 1 and finite and np.isfinite(step).all() and (step / 2 <= largest_error).all():
            counts = np.round((rows - low) / np.where(step > 0, step, 1)) - 32768
            whole = counts.astype(np.int16).reshape(array.shape)
            differences = np.diff(whole, axis=0, prepend=np.zeros_like(whole[:1]))  # wraps around, and so back
            entry = {"dtype": "i2", "low": low.tolist(), "step": step.tolist()}
            return entry | self._append(differences.astype("<i2"))
        with np.errstate(over="ignore"):  # beyond float32: infinite, and not shown
            return {"dtype": "f4"} | self._append(np.asarray(array, "<f4"))

    def add_bytes(self, array: np.ndarray) -> dict[str, Any]:
        """Append an array of uint8; return its entry in the header."""
        return {"dtype": "u1"} | self._append(array)

    def _append(self, array: np.ndarray) -> dict[str, Any]:
        data = array.tobytes()
        entry = {"offset": self.size, "shape": list(array.shape)}
        padding = -len(data) % 4
        self.data.append(data + bytes(padding))
        self.size += len(data) + padding
        return entry


def encode(
    records: Sequence[FlightLog], names: Sequence[str], title: str, arrows: np.ndarray | None = None, **others: Any
) -> str:
    """Encode the payload of a page.

    Args:
        records: logs of the flights, one world each.
        names: of the worlds.
        title: of the page.
        arrows: (K, n, 3) vectors along the paths of the first world.
        others: further entries of the header, or in place of the colors of drones (`palette`) and of the names of the
            first plots (`signals`).

    Raises:
        ValueError: too much data for a browser.
    """
    check_size(*(record.pos for record in records))
    arrays = _Arrays()
    vehicles: list[dict[str, Any]] = []
    scenes: list[dict[str, Any]] = []
    worlds = []
    for record, name in zip(records, names, strict=True):
        world: dict[str, Any] = {"name": name, "labels": list(record.labels)} | _rows(arrays, record)
        params = record.params.replace(kf=record.params.kf * record.params.relative_density)  # thrust in this air
        constants = {name: np.asarray(getattr(params, name), float).tolist() for name in _CONSTANTS}
        drones = [{name: values[i] for name, values in constants.items()} for i in range(len(record.labels))]
        world["vehicle"] = [_index(vehicles, drone) for drone in drones]
        world["images"] = [
            {"name": kind, "t": arrays.add(images.t), "frames": arrays.add_bytes(_pixels(kind, images.frames))}
            | ({"farthest": _farthest(images.frames)} if kind == "depth" else {})
            for kind, images in record.images.items()
        ]
        world["scene"] = _index(scenes, scene_to_dict(only_shapes(record.scene)))
        worlds.append(world)
    if arrows is not None:
        worlds[0]["arrows"] = arrays.add(arrows)
    has_targets = any(np.isfinite(record.target_pos).any() for record in records)
    signals = ["distance from target" if has_targets else "position z", "rotor speeds"]  # names in plots.js
    header = {"title": title, "worlds": worlds, "vehicles": vehicles, "scenes": scenes, "palette": colors(DISTINCT)}
    return _packed(header | {"signals": signals} | others, arrays)


def encode_rows(record: FlightLog) -> str:
    """Encode further rows of the only world of a page, with the header `{"rows": arrays by name}`."""
    arrays = _Arrays()
    return _packed({"rows": _rows(arrays, record)}, arrays)


def _rows(arrays: _Arrays, record: FlightLog) -> dict[str, Any]:
    """Arrays of a flight for the page by name; `None` for unknown targets and loads, and without contact."""
    rows: dict[str, Any] = {"t": arrays.add(record.t)}
    for name in STATE_AND_SPEEDS:
        rows[name] = arrays.add(getattr(record, name), _LARGEST_ERROR.get(name, math.inf))
    optional = {"targets": record.target_pos, "target_vel": record.target_vel, "loads": record.load_pos}
    for name, values in optional.items():
        known = bool(np.isfinite(values).any())
        rows[name] = arrays.add(values, _LARGEST_ERROR.get(name, math.inf)) if known else None
    forces = contact_forces(record)
    rows["contacts"] = None if forces is None else arrays.add(forces)
    return rows


def _packed(header: dict[str, Any], arrays: _Arrays) -> str:
    """Header and arrays as text."""
    text = json.dumps(header, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    data = len(text).to_bytes(4, "little") + text + b"".join(arrays.data)
    return base64.b64encode(zlib.compress(data, 6)).decode()


def _pixels(kind: str, frames: np.ndarray) -> np.ndarray:
    """Images as uint8 (F, n, height, width, channels): depth from 255 at the camera to 0; 1, 3 or 4 channels."""
    if kind == "depth":
        farthest = _farthest(frames)
        grey = 1 - np.clip(np.nan_to_num(frames, nan=np.inf), 0, farthest) / farthest
        return np.round(255 * grey).astype(np.uint8)[..., None]
    if kind == "segmentation":
        painted = np.array([as_rgb(color) for color in COLORS], np.uint8)
        return np.where(frames[..., None] < 0, np.uint8(255), painted[frames % len(painted)])
    return np.asarray(frames, np.uint8)


def _farthest(frames: np.ndarray) -> float:
    """Depth of the darkest pixel, m."""
    seen = frames[np.isfinite(frames)]
    return max(1e-6, min(_FARTHEST, float(seen.max()))) if seen.size else 1.0


def _index(known: list[dict[str, Any]], entry: dict[str, Any]) -> int:
    if entry not in known:
        known.append(entry)
    return known.index(entry)


def check_size(*positions: ArrayLike) -> None:
    """Raise if arrays of positions (..., 3) are too large for a page."""
    samples = sum(math.prod(np.shape(pos)[:-1]) for pos in positions)
    if samples > _MOST:
        raise UserError(
            f"the flights have {samples:,} states of drones, more than a page plays ({_MOST:,}); give "
            "fewer worlds, or every tenth row: jax.tree.map(lambda x: x[::10], trajectory)"
        )

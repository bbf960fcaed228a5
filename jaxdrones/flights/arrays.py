"""Checks of the arrays of a recorded flight."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxdrones.errors import UserError


def check_arrays_of_flight(record: Any, name: str) -> None:
    """Raise unless the arrays of a record belong together and can be shown.

    Args:
        record: a `Record`.
        name: of the record, for the error.

    Raises:
        ValueError: names the array that has another shape, is no number, or runs backwards.
    """
    rows, drones = len(np.atleast_1d(record.t)), len(record.labels)
    if not (rows and drones):
        raise UserError(f"{name} has {rows} times and {drones} drones; give a flight with at least one of each")
    widths = {"pos": 3, "quat": 4, "vel": 3, "omega": 3, "rpm": 4, "target_pos": 3, "target_vel": 3}
    shapes = {"t": (rows,)} | {array: (rows, drones, width) for array, width in widths.items()}
    for array, shape in shapes.items():
        x = np.asarray(getattr(record, array))
        if x.shape != shape or x.dtype.kind not in "fiu":
            raise UserError(
                f"{name}: {array} is {x.dtype} of shape {x.shape}; give numbers of shape {shape}: "
                f"{rows} times and {drones} drones"
            )
    t = np.asarray(record.t, float)
    if not np.isfinite(t).all() or not (np.diff(t) > 0).all():
        raise UserError(f"{name}: t is not finite or does not increase; sort the rows by time, and remove broken ones")
    states = np.concatenate([getattr(record, array) for array in ("pos", "quat", "vel", "omega", "rpm")], axis=-1)
    finite: np.ndarray = np.asarray(np.isfinite(states).all(axis=-1))
    row, drone = np.nonzero(np.concatenate([~finite[:1], ~finite[:-1] & finite[1:]]))
    if len(row):
        where = f"before row {row[0]}" if row[0] else "in row 0"
        raise UserError(
            f"{name}: the state of {record.labels[drone[0]]} is not finite {where}, which no flight recovers from; "
            "the log is damaged, record it again"
        )
    for field, x in vars(record.params).items():
        if field != "aux" and (np.ndim(x) < 1 or len(x) != drones):
            raise UserError(
                f"{name}: params.{field} has shape {np.shape(x)}; give one entry for each of {drones} drones"
            )
    for kind, images in record.images.items():
        if len(images.t) != len(images.frames) or np.shape(images.frames)[1:2] != (drones,):
            shape = np.shape(images.frames)
            raise UserError(f"{name}: images {kind!r} have shape {shape} for {len(images.t)} times, {drones} drones")

"""Log files: .npz, .csv, and ROS 2 bags."""

import csv
import json
import os
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from jaxdrones import assets
from jaxdrones.control.pid import VEHICLES, rpm_to_pwm
from jaxdrones.errors import UserError
from jaxdrones.flights.bag import read_bag
from jaxdrones.flights.log import OPTIONAL, STATE, FlightLog, ImageSequence, LoggedConditions
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.sensing.scene import scene_from_dict, scene_to_dict
from jaxdrones.writing import replaced

_ALIASES = {"gyro": "omega", "ref_pos": "target_pos", "ref_yaw": "target_yaw"}
_WIDTHS = STATE | OPTIONAL
_AXES = {"quat": "xyzw", "rpy": "rpy", "rpm": "0123", "pwm": "0123", "vbat": ("",), "target_yaw": ("",)}  # else "xyz"
_MEANINGS = {
    "t": "time, s",
    "pos": "position, m, world",
    "quat": "attitude, quaternion x, y, z, w, body to world",
    "vel": "velocity, m/s, world",
    "omega": "angular velocity, rad/s, body",
    "rpm": "rotor speeds, RPM",
    "pwm": "duty cycles of the motors, 0 to 65535",
    "vbat": "voltage of the battery, V",
    "target_pos": "commanded position, m, world",
    "target_vel": "commanded velocity, m/s, world",
    "target_yaw": "commanded heading, rad",
    "load_pos": "position of the load on the cable of each drone, m, world",
}
_MAX_STRETCH = 0.05  # largest deviation of the length of a quaternion from 1
_IMAGES = "images/"  # prefix of the names of their arrays
# What NumPy and zipfile raise for damaged files; NotImplementedError for an unknown compression.
_DAMAGE = (OSError, ValueError, EOFError, KeyError, NotImplementedError, RuntimeError, MemoryError)


def find_log(path: str | os.PathLike) -> Path:
    """Find a log: a bundled one by its name, a file, a bag, or the log in a folder of `jaxdrones fly`."""
    path = assets.flights().get(os.fspath(path), Path(path))
    if path.is_file() or (path / "metadata.yaml").is_file():
        return path
    found = [log for log in (path / "log.npz", path / "flight" / "log.npz") if log.is_file()]
    if not found:
        what = "has no log of a flight" if path.is_dir() else "does not exist"
        raise UserError(f"{path} {what}; fly first, `jaxdrones fly circle --output {path}`, or give another path")
    return found[0]


def read_log(path: str | os.PathLike) -> FlightLog:
    """Read the log of a flight.

    It is an .npz or .csv file, a ROS 2 bag, a folder of `jaxdrones fly`, or the name of a bundled log. Arrays are those
    of `FlightLog` by name; `gyro`, `ref_pos` and `ref_yaw` are aliases of `omega`, `target_pos` and `target_yaw`. The
    drone axis is optional for a single drone. Other arrays are ignored.

    Raises:
        UserError: no log, or a damaged one: an array is missing, has another shape, is not finite, or time does not
            increase.
        ImportError: a bag without rosbags.
    """
    file = find_log(path)
    arrays = read_bag(file) if file.is_dir() else _csv(file) if file.suffix == ".csv" else _npz(file)
    for alias, name in _ALIASES.items():
        if alias in arrays:
            arrays.setdefault(name, arrays.pop(alias))
    if "labels" in arrays:
        arrays["labels"] = np.ravel(arrays["labels"])
    columns = _columns(file.name, arrays)
    try:
        texts = {name: json.loads(str(arrays[name])) for name in ("conditions", "params", "scene") if name in arrays}
        params = {name: np.asarray(x, float) for name, x in texts["params"].items()} if "params" in texts else None
        log = FlightLog(
            **columns,
            labels=tuple(map(str, arrays.get("labels", ()))),
            conditions=LoggedConditions(texts.get("conditions", {}), str(arrays.get("about", file.name))),
            params=None if params is None else Params(**params),  # type: ignore[arg-type]  # names are the file's
            scene=scene_from_dict(texts["scene"]) if "scene" in texts else Scene(),
            images={
                kind: ImageSequence(*(arrays[f"{_IMAGES}{kind}/{name}"] for name in ImageSequence._fields))
                for kind in sorted({name.split("/")[1] for name in arrays if name.startswith(_IMAGES)})
            },
            name=file.name,
            file=file,
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        why = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) and error.args else error
        raise UserError(f"{file}: the log is damaged ({why}); record it again") from None
    _check(log)
    return log


def arrays_of(log: FlightLog, pwm: bool = False) -> dict[str, np.ndarray]:
    """Arrays of a log by name; conditions, parameters and scene are JSON; `pwm` adds the Crazyflie's PWM signals."""
    if pwm:
        check_pwm(log.conditions.vehicle)
    texts = {
        "conditions": log.conditions.as_dict(),
        "params": {name: np.asarray(x).tolist() for name, x in vars(log.params).items() if name != "aux"},
        "scene": scene_to_dict(log.scene),
    }
    arrays = {name: np.asarray(getattr(log, name)) for name in ("t", *STATE, "rpy")}
    arrays |= {name: np.asarray(getattr(log, name)) for name in OPTIONAL if log.has(name)}
    arrays |= {name: np.asarray(json.dumps(entries)) for name, entries in texts.items()}
    arrays |= {"labels": np.asarray(log.labels), "about": np.asarray(str(log.conditions))}
    for kind, images in log.images.items():
        arrays |= {f"{_IMAGES}{kind}/{name}": array for name, array in images._asdict().items()}
    return arrays | {"pwm": rpm_to_pwm(log.rpm)} if pwm else arrays


def save_npz(log: FlightLog, path: str | os.PathLike, pwm: bool = False) -> None:
    """Write a log as named arrays; missing folders are created."""
    arrays: dict[str, Any] = arrays_of(log, pwm)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with replaced(path) as new:
        np.savez_compressed(new, **arrays)


def save_csv(log: FlightLog, path: str | os.PathLike, pwm: bool = False) -> None:
    """Write a log with one line per time and drone; missing folders are created."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    arrays = {name: x for name, x in arrays_of(log, pwm).items() if name in (*_WIDTHS, "rpy")}
    names = [f"{name}_{axis}".rstrip("_") for name in arrays for axis in _AXES.get(name, "xyz")]
    rows = np.concatenate([x.reshape(len(log.t), len(log.labels), -1) for x in arrays.values()], axis=-1)
    with replaced(path) as new, new.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "drone", *names])
        writer.writerows([t, label, *rows[k, i]] for k, t in enumerate(log.t) for i, label in enumerate(log.labels))


def check_pwm(vehicle: str) -> None:
    """Raise `UserError` unless a vehicle has the motors of the Crazyflie, with known PWM."""
    if vehicle not in VEHICLES:
        raise UserError(
            f"PWM is requested for {vehicle!r}; it is known for {' and '.join(VEHICLES)} only, leave it out"
        )


def _npz(file: Path) -> dict[str, np.ndarray]:
    try:
        with file.open("rb") as content, np.load(content, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive}
    except (*_DAMAGE, TypeError, AttributeError, zipfile.BadZipFile, zlib.error):
        raise UserError(f"{file}: is not an .npz file of arrays; give the log of a flight") from None


def _csv(file: Path) -> dict[str, np.ndarray]:
    """Arrays of a table of `save_csv`; without the column `drone` it is of one drone."""
    try:
        with file.open(newline="", encoding="utf-8-sig") as lines:  # spreadsheets write a mark of the byte order
            reader = csv.DictReader(lines)
            reader.fieldnames = names = [name.strip() for name in reader.fieldnames or ()]
            table: dict[str, list[str]] = {name: [] for name in names}
            if len(table) < len(names):
                raise UserError("two columns have the same name")
            if any(";" in name for name in names):
                raise UserError("columns are separated by semicolons; separate them by commas")
            for row in reader:
                if None in row or None in row.values():
                    raise UserError(f"line {reader.line_num} has not {len(names)} entries, one for each column")
                for name, entries in table.items():
                    entries.append(row[name])
        if not any(table.values()):
            raise UserError("it has no rows below the names of the columns")
        drones = table.pop("drone", ["drone 0"])
        labels = list(dict.fromkeys(drones))
        read = {name: [_number(name, line, x) for line, x in enumerate(table[name], 2)] for name in table}
        numbers = {name: np.array(x).reshape(-1, len(labels)) for name, x in read.items()}
    except (*_DAMAGE, TypeError, csv.Error) as error:
        raise UserError(f"{file}: is not a table of numbers ({error}); give the log of a flight") from None
    t = numbers.pop("t", np.zeros((0, 1)))
    same_time = (t == t[:, :1]) | np.isnan(t).any(axis=1, keepdims=True)  # `_check` names a time that is not finite
    if drones != labels * (len(drones) // max(len(labels), 1)) or not same_time.all():
        raise UserError(f"{file.name}: has other drones at some times; give one row for each time and drone, in order")
    arrays = {"t": t.max(axis=1)} if len(t) else {}
    for name in (*_WIDTHS, *_ALIASES):
        axes = [f"{name}_{axis}".rstrip("_") for axis in _AXES.get(_ALIASES.get(name, name), "xyz")]
        missing = [axis for axis in axes if axis not in numbers]
        if 0 < len(missing) < len(axes):
            meaning = _MEANINGS[_ALIASES.get(name, name)]
            raise UserError(
                f"{file.name}: has only some columns of {name!r} ({meaning}); {', '.join(missing)} "
                f"{'is' if len(missing) == 1 else 'are'} missing"
            )
        if not missing:
            stacked = np.stack([numbers[axis] for axis in axes], axis=-1)
            arrays[name] = stacked if len(axes) > 1 else stacked[..., 0]
    return arrays | {"labels": np.array(labels)}


def _number(column: str, line: int, entry: str) -> float:
    try:
        return float(entry)
    except ValueError:
        raise UserError(f"column {column!r} has {entry[:30]!r} in line {line}") from None


def _columns(name: str, arrays: dict[str, Any]) -> dict[str, np.ndarray]:
    """Times and arrays (K, n, ...) of a log, with consistent shapes."""
    for column in ("t", *STATE):
        if column not in arrays:
            raise UserError(f"{name}: has no column {column!r}: {_MEANINGS[column]}; add it to the log")
    rows, drones = np.size(arrays["t"]), np.shape(arrays["pos"])[1] if np.ndim(arrays["pos"]) == 3 else 1
    if ("labels" in arrays and len(arrays["labels"]) != drones) or not (rows and drones):
        raise UserError(f"{name}: has {rows} times, {drones} drones and {len(arrays.get('labels', ()))} labels")
    columns = {}
    for column in ("t", *_WIDTHS):
        if column in arrays:
            x, width = np.asarray(arrays[column]), _WIDTHS.get(column, 0)
            single = x[:, None] if column != "t" and x.ndim == (2 if width else 1) else x  # no drone axis
            shape = (rows,) if column == "t" else (rows, drones, width) if width else (rows, drones)
            if single.shape != shape or x.dtype.kind not in "fiu":
                raise UserError(
                    f"{name}: {column} is {x.dtype} of shape {x.shape}; give numbers of shape {shape}, {rows} times "
                    f"and {drones} drones: {_MEANINGS[column]}"
                )
            columns[column] = single
    return columns


def _check(log: FlightLog) -> None:
    """Raise unless time increases, and states are finite up to a possible divergence."""
    rises = np.isfinite(log.t) & np.append(True, log.t[1:] > log.t[:-1])
    if not rises.all():
        row = int(np.argmin(rises))
        before = f"goes from {log.t[row - 1]:g} to" if row else "is"
        raise UserError(
            f"{log.name}: time {before} {log.t[row]:g} s in row {row}; sort the rows by time, and remove broken ones"
        )
    names = (*STATE, *["rpm"] * log.has("rpm"))
    finite = np.isfinite(np.concatenate([getattr(log, name) for name in names], axis=-1)).all(axis=-1)
    broken = np.argwhere(np.concatenate([~finite[:1], ~finite[:-1] & finite[1:]]))
    if len(broken):
        row, drone = broken[0].tolist()
        where = f"before row {row}" if row else "in row 0"
        raise UserError(f"{log.name}: the state of {log.labels[drone]} is not finite {where}; remove such rows")
    with np.errstate(over="ignore"):
        length = np.linalg.norm(log.quat.astype(float), axis=-1)
    if (np.abs(length - 1) > _MAX_STRETCH).any():
        row, drone = np.argwhere(np.abs(length - 1) > _MAX_STRETCH)[0].tolist()
        raise UserError(
            f"{log.name}: quat of {log.labels[drone]} has a length of {length[row, drone]:.4g} in row {row}, but "
            "a unit quaternion has a length of 1; give x, y, z, w"
        )
    n = len(log.labels)
    for field, x in vars(log.params).items():
        if field != "aux" and (np.ndim(x) < 1 or len(x) != n):
            raise UserError(f"{log.name}: params.{field} has shape {np.shape(x)}; give one entry for each drone, {n}")
    for kind, images in log.images.items():
        t, frames = images
        numbers = t.dtype.kind in "fiu" and frames.dtype.kind in "fiu"
        if not numbers or frames.ndim not in (4, 5) or frames.shape[:2] != (np.size(t), n):
            raise UserError(
                f"{log.name}: images {kind!r} are {frames.dtype} of shape {frames.shape} at {t.dtype} of shape "
                f"{t.shape}; give numbers (times, {n} drones, height, width) or with channels, and their times"
            )

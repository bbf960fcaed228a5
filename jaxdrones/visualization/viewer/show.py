"""Viewer pages of trajectories, logs and episodes of one or many worlds, and of the policies of a training."""

import dataclasses
import functools
import math
import os
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxdrones.arguments import checked, choice, number
from jaxdrones.checks import check_choice, check_number, check_params, check_sequence, short_repr
from jaxdrones.dynamics.model import PointMass
from jaxdrones.errors import UserError
from jaxdrones.flights.files import read_log
from jaxdrones.flights.log import STATE_AND_SPEEDS, FlightLog, ImageSequence, LoggedConditions, logged
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.sensing.scene import check_scene
from jaxdrones.state import State
from jaxdrones.visualization.viewer.page import Page
from jaxdrones.visualization.viewer.payload import check_size, encode

LAYOUTS = {"ghosts": "ghosts", "side by side": "grid", "hidden": "alone"}
"""Initial layouts of other worlds -> names in the page."""
CHANNELS = {"rgb": True, "depth": False, "segmentation": False}
"""Kinds of images -> whether a pixel has channels."""
_PIXELS = {
    "rgb": ("u", "uint8, from 0 to 255"),
    "depth": ("fiu", "numbers, m"),
    "segmentation": ("iu", "whole numbers"),
}


@checked
def show(
    flight: Any,
    params: Params | None = None,
    *,
    dt: float | None = None,
    scene: Scene | None = None,
    targets: ArrayLike | None = None,
    labels: Sequence[str] | None = None,
    images: Mapping[str, ArrayLike] | None = None,
    arrows: ArrayLike | None = None,
    others: Annotated[str, choice("layout of other worlds", LAYOUTS)] = "ghosts",
    title: str | None = None,
    height: Annotated[int, number("pixels", above=0)] = 600,
) -> Page:
    """Make a page that plays flights in 3D, for display in notebooks or `save`.

    Args:
        flight: a trajectory of `rollout`, a `State` of arrays (K, n, ...), or (W, K, n, ...) for W worlds; a
            `FlightLog`; an episode of `fly_episode`; the path of a log.npz or of its folder; or a list or dictionary of
            these, each of them a world.
        params: of the team, with a leading drone axis. Logs and episodes have their own.
        dt: time between the rows of a trajectory, s. Logs and episodes have their own.
        scene: obstacles and ground; by default the flight's, or a bare ground.
        targets: positions (n, 3), (K, n, 3) or (W, K, n, 3), m, world, of a trajectory; by default none.
        labels: names of the drones of a trajectory; by default `drone 0`, ...
        images: camera images at every row of a trajectory of one world, by kind: `rgb`
            (K, n, height, width, 3 or 4) uint8, `depth` (K, n, height, width) m, or `segmentation`.
        arrows: vectors (K, n, 3) at every row of one world, world axes, in any unit, such as the negative derivative of
            a cost with respect to commanded positions; drawn along the paths.
        others: initial layout of the other worlds: `ghosts`, `side by side` or `hidden`.
        title: title of the page; by default the conditions of the flight.
        height: height in a notebook, pixels.

    Raises:
        ValueError: an unsupported flight, inconsistent shapes, or too much data for a browser.
    """
    of_trajectory = {"params": params, "dt": dt, "targets": targets, "labels": labels, "images": images}
    if targets is not None:
        of_trajectory["targets"] = given = np.asarray(targets, float)
        with np.errstate(over="ignore"):
            if np.isinf(given.astype(np.float32)).any():
                raise UserError("targets are not finite, or too large for float32; give places, or NaN for no target")
    worlds = _worlds(flight, of_trajectory)
    records = list(worlds.values())
    if scene is not None:
        check_scene("scene", scene, files=True)
        records = [dataclasses.replace(record, scene=scene) for record in records]
    if arrows is not None and (len(records) > 1 or np.shape(arrows) != records[0].pos.shape):
        raise UserError(
            f"arrows have shape {np.shape(arrows)} beside {len(records)} worlds, the first of shape "
            f"{records[0].pos.shape}; give one world, and as many vectors as positions"
        )
    records = [_from_start(record) for record in records]
    arrows = None if arrows is None else np.nan_to_num(np.asarray(arrows, float))
    title = str(records[0].conditions) if title is None else title
    payload = encode(records, list(worlds), title, arrows, layout=LAYOUTS[others])
    return Page(title, payload, height)


def show_history(evaluated: Sequence[Any], best: int, label: str, title: str) -> Page:
    """Make a page that plays the flights of a training one after the other.

    Args:
        evaluated: policies of `training.episode.fly_history`.
        best: number of updates of the policy that the training kept.
        label: name of the value; `success` is a fraction, 0 to 1.
        title: title of the page.

    Raises:
        ValueError: too much data for a browser.
    """
    records = [record for policy in evaluated for record in records_of(policy.flight, {})]
    values = [f"{100 * x.value:.1f} %" if label == "success" else f"{x.value:.4g}" for x in evaluated]
    names = [f"update {x.update}: {label} {value}" for x, value in zip(evaluated, values, strict=True)]
    points = [[x.update, x.value if math.isfinite(x.value) else None] for x in evaluated]
    history = {"label": label, "points": points, "best": best}
    payload = encode(records, names, title, layout=LAYOUTS["hidden"], play=True, history=history)
    return Page(title, payload)


def _from_start(record: FlightLog) -> FlightLog:
    """Log with times from the start of the flight: a page begins at 0 s and has times in float32."""
    if not record.begin:
        return record
    images = {name: ImageSequence(x.t - record.begin, x.frames) for name, x in record.images.items()}
    return dataclasses.replace(record, t=record.t - record.begin, images=images)


def _worlds(flight: Any, of_trajectory: dict[str, Any]) -> dict[str, FlightLog]:
    """Worlds of one or several flights, by name."""
    if isinstance(flight, Mapping):
        named = {str(name): records_of(part, of_trajectory) for name, part in flight.items()}
    elif isinstance(flight, list | tuple) and not isinstance(flight, State):
        named = {f"flight {i}": records_of(part, of_trajectory) for i, part in enumerate(flight)}
    else:
        records = records_of(flight, of_trajectory)
        return {f"world {i}": record for i, record in enumerate(records)}
    if not named:
        raise UserError("there is no flight to show; give at least one")
    return {
        name if len(records) == 1 else f"{name}, world {i}": record
        for name, records in named.items()
        for i, record in enumerate(records)
    }


@functools.singledispatch
def records_of(flight: Any, of_trajectory: dict[str, Any]) -> list[FlightLog]:
    """Logs of the worlds of a flight. Other modules register kinds of flights, `@records_of.register`.

    Args:
        flight: argument of `show`.
        of_trajectory: arguments of `show` for a bare trajectory only, or `None`.
    """
    raise UserError(
        f"{short_repr(flight)} cannot be shown; give a trajectory of jaxdrones.rollout, a record, an episode, or the "
        "path of a log.npz"
    )


def refuse(of_trajectory: dict[str, Any]) -> None:
    """Raise for an argument that the flight has itself."""
    for name, value in of_trajectory.items():
        if value is not None:
            raise UserError(f"{name} is given beside a flight that has its own; leave it out")


@records_of.register
def _(flight: FlightLog, of_trajectory: dict[str, Any]) -> list[FlightLog]:
    refuse(of_trajectory)
    return [flight]


@records_of.register(str)
@records_of.register(os.PathLike)
def _(flight: str | os.PathLike, of_trajectory: dict[str, Any]) -> list[FlightLog]:
    refuse(of_trajectory)
    return [read_log(flight)]


@records_of.register
def _(flight: State, of_trajectory: dict[str, Any]) -> list[FlightLog]:
    params, dt = of_trajectory["params"], of_trajectory["dt"]
    for name, value, what in ("params", params, "the team's"), ("dt", dt, "seconds between two rows"):
        if value is None:
            raise UserError(
                f"{name} is left out; a trajectory needs {name}, {what}: jd.show(trajectory, params, dt=1 / 120)"
            )
    check_number("dt", dt, "s", above=0)
    check_params(params)
    check_size(flight.pos)
    loads = {name: x for name, x in flight.aux.items() if name == "payload" and isinstance(x, PointMass)}
    flight = jax.tree.map(np.asarray, flight.replace(aux=loads))
    if flight.pos.ndim not in (3, 4):
        raise UserError(
            f"pos of the trajectory has shape {flight.pos.shape}; give (K, n, 3) of K times and n drones, or "
            "(W, K, n, 3) of W worlds"
        )
    for name, width in STATE_AND_SPEEDS.items():
        shape = (*flight.pos.shape[:-1], width)
        if getattr(flight, name).shape != shape or not flight.pos.size:
            given = f"{name} of the trajectory has shape {getattr(flight, name).shape}"
            raise UserError(f"{given}; give {shape if flight.pos.size else 'at least one time, drone and world'}")
    if flight.pos.ndim == 4 and of_trajectory["images"] is not None:
        raise UserError("images are given beside many worlds; show one world, jax.tree.map(lambda x: x[0], trajectory)")
    if flight.pos.ndim == 3:
        return [_record(flight, params, of_trajectory)]

    def world(tree: Any, w: int, axes: int) -> Any:
        """One world of a tree; its first array has this number of axes with an axis of worlds."""
        leaves = jax.tree.leaves(tree)
        return jax.tree.map(lambda x: np.asarray(x)[w], tree) if leaves and np.ndim(leaves[0]) == axes else tree

    targets = of_trajectory["targets"]
    return [
        _record(world(flight, w, 4), world(params, w, 2), of_trajectory | {"targets": world(targets, w, 4)})
        for w in range(len(flight.pos))
    ]


def _record(flight: State, params: Params, of_trajectory: dict[str, Any]) -> FlightLog:
    """Log of one world of arrays (K, n, ...)."""
    steps, n = flight.pos.shape[:2]
    if np.shape(params.mass) != (n,):
        raise UserError(
            f"params are of a team of shape {np.shape(params.mass)} and the trajectory has {n} drones; give one drone "
            "axis, for example by jaxdrones.repeat"
        )
    labels = of_trajectory["labels"]
    labels = [f"drone {i}" for i in range(n)] if labels is None else check_sequence("labels", labels, "'left'")
    labels = tuple(map(str, labels))
    if len(labels) != n:
        raise UserError(f"labels are {len(labels)} names and there are {n} drones; give as many")
    targets = np.asarray(np.nan) if of_trajectory["targets"] is None else of_trajectory["targets"]
    try:
        targets = np.broadcast_to(targets, (steps, n, 3))
    except ValueError:
        raise UserError(
            f"targets have shape {targets.shape}; give (n, 3) or (K, n, 3) of {steps} times and {n} drones"
        ) from None
    dt = of_trajectory["dt"]
    return FlightLog(
        t=dt * np.arange(1, steps + 1),
        **logged(flight),
        target_pos=targets,
        labels=labels,
        conditions=LoggedConditions({}, f"{n} drone{'s' * (n > 1)}, {steps * dt:g} s"),
        params=params,
        images=_images(of_trajectory["images"] or {}, dt * np.arange(1, steps + 1), n),
    )


def _images(images: Mapping[str, ArrayLike], t: np.ndarray, n: int) -> dict[str, ImageSequence]:
    """Validated images at every row."""
    for name, frames in images.items():
        check_choice("kind of images", name, CHANNELS)
        shape = np.shape(frames)
        channels = shape[4:] in ((3,), (4,)) if CHANNELS[name] else shape[4:] == ()
        if shape[:2] != (len(t), n) or len(shape) < 4 or not channels or 0 in shape:
            axes = "(K, n, height, width" + (", 3 or 4)" if CHANNELS[name] else ")")
            raise UserError(f"images {name!r} have shape {shape}; give {axes} of {len(t)} times and {n} drones")
        kind, (kinds, what) = np.asarray(frames).dtype, _PIXELS[name]
        if kind.kind not in kinds or (name == "rgb" and kind != np.uint8):
            raise UserError(f"images {name!r} are of type {kind}; give {what}")
    return {name: ImageSequence(t, np.asarray(frames)) for name, frames in images.items()}

"""Options shared by several commands, with one meaning and one help text each."""

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from jaxdrones import assets
from jaxdrones.arguments import Check, choice, whole
from jaxdrones.cli.common import folder
from jaxdrones.envs import TASKS
from jaxdrones.errors import UserError
from jaxdrones.flights.conditions import BACKENDS


def option(
    group,
    name: str,
    text: str,
    kind: Any = str,
    default: Any = None,
    check: Check | None = None,
    known: Iterable[str] = (),
    **more: Any,
) -> None:
    """Add an option or argument such as `--speed X`, with its default in the help, and the range of its values.

    The `known` names take the place of `{}` in the help, and complete the option in a shell.
    """
    flag, _, metavar = name.partition(" ")
    text = text.replace("{}", ", ".join(known))
    if type(default) in (str, int, float):
        text += f" ({default:g})" if isinstance(default, float) else f" ({default})"
    added = group.add_argument(flag, type=kind, default=default, metavar=metavar, help=text, **more)
    vars(added)["known"] = list(known)
    if check is not None:
        group.set_defaults(ranges=(group.get_default("ranges") or {}) | {added.dest: check})


class Once(argparse.Action):
    """Value of an option that may be given once only, where a second value might be meant in addition."""

    def __call__(self, parser, namespace, values, option_string=None):  # noqa: D102
        if getattr(namespace, self.dest) != self.default:
            parser.error(f"argument {option_string}: {getattr(namespace, self.dest)} and {values} are given; give one")
        setattr(namespace, self.dest, values)


def switch(group, name: str, text: str) -> None:
    """Add an option without a value."""
    group.add_argument(name, action="store_true", help=text)


def add_drones(group, default: int | None = None) -> None:
    """Add --drones."""
    option(group, "--drones N", "number of drones", int, default, whole())


def add_vehicle(group, default: str | None = None, where: str = "") -> None:
    """Add --vehicle; `default` is `None` where the recipe of a run has the vehicle."""
    text = f"{where}{{}} or a .urdf file" + " (cf2x)" * (default is None)
    option(group, "--vehicle NAME|URDF", text, default=default, known=assets.vehicles())


def add_backend(group) -> None:
    """Add --backend."""
    option(group, "--backend NAME", "{}", default="explicit", check=choice("backend", BACKENDS), known=BACKENDS)


def add_task(group, text: str) -> None:
    """Add --task."""
    option(group, "--task TASK", text, known=TASKS)


def add_set(group, text: str) -> None:
    """Add --set, which may be repeated."""
    option(group, "--set NAME=VALUE", text, default=[], action="append")


def add_output(group, text: str, default: Path | None = None, metavar: str = "DIR") -> None:
    """Add -o and --output."""
    group.add_argument("-o", "--output", type=folder, default=default, metavar=metavar, help=text)


def add_no_figure(group) -> None:
    """Add --no-figure."""
    switch(group, "--no-figure", "write no figure; needs no matplotlib")


def split_names(text: str) -> list[str]:
    """Names of an option `A,B`."""
    return [name.strip() for name in text.split(",")]


def parse_pixels(option: str, text: str, example: str) -> tuple[int, int]:
    """Width and height of an option `WxH`, pixels."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise UserError(f"{option} is {text!r}; give width and height in pixels, for example {example}")
    return int(width), int(height)

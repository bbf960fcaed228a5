"""Options shared by several commands, with one meaning and one help text each."""

from pathlib import Path

from jaxdrones import assets
from jaxdrones.cli.common import folder
from jaxdrones.errors import UserError
from jaxdrones.flights.conditions import BACKENDS


def add_drones(group, default: int | None = None) -> None:
    """Add --drones."""
    text = "number of drones" + ("" if default is None else f" ({default})")
    group.add_argument("--drones", type=int, default=default, metavar="N", help=text)


def add_vehicle(group, default: str | None = None, where: str = "") -> None:
    """Add --vehicle; `default` is `None` where the recipe of a run has the vehicle."""
    text = f"{where}{', '.join(assets.vehicles())} or a .urdf file (cf2x)"
    group.add_argument("--vehicle", default=default, metavar="NAME|URDF", help=text)


def add_backend(group) -> None:
    """Add --backend."""
    group.add_argument("--backend", default="explicit", metavar="NAME", help=f"{', '.join(BACKENDS)} (explicit)")


def add_set(group, text: str) -> None:
    """Add --set, which may be repeated."""
    group.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help=text)


def add_output(group, text: str, default: Path | None = None, metavar: str = "DIR") -> None:
    """Add -o and --output."""
    group.add_argument("-o", "--output", type=folder, default=default, metavar=metavar, help=text)


def add_no_figure(group) -> None:
    """Add --no-figure."""
    group.add_argument("--no-figure", action="store_true", help="write no figure; needs no matplotlib")


def split_names(text: str) -> list[str]:
    """Names of an option `A,B`."""
    return [name.strip() for name in text.split(",")]


def parse_pixels(option: str, text: str, example: str) -> tuple[int, int]:
    """Width and height of an option `WxH`, pixels."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise UserError(f"{option} is {text!r}; give width and height in pixels, for example {example}")
    return int(width), int(height)

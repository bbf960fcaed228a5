"""`jaxdrones view`."""

import argparse
import sys
import webbrowser
import zipfile
from pathlib import Path

from jaxdrones.checks import check_choice, check_whole
from jaxdrones.cli.common import check_writable, folder
from jaxdrones.cli.report import as_json
from jaxdrones.errors import UserError
from jaxdrones.flights.files import find_log
from jaxdrones.visualization import video
from jaxdrones.visualization.viewer.film import CAMERAS, film
from jaxdrones.visualization.viewer.show import LAYOUTS, show


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "view",
        help="write a page that plays recorded flights in three dimensions",
        description="Write one page of HTML that plays the logs of `jaxdrones fly` in three dimensions, with drones, "
        "obstacles, targets and plots. Any browser opens it, without a network. Several logs are shown together.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "flights",
        type=folder,
        nargs="+",
        metavar="FLIGHT",
        help="a folder of `jaxdrones fly`, a run, or a log.npz; others of several are skipped",
    )
    parser.add_argument(
        "-o", "--output", type=folder, metavar="FILE", help="path of the page (flight.html beside the first log)"
    )
    parser.add_argument("--others", default="ghosts", help=f"how further flights are shown: {', '.join(LAYOUTS)}")
    parser.add_argument("--title", help="title of the page (the conditions of the first flight)")
    parser.add_argument("--video", type=folder, metavar="FILE", help="film the page too, .mp4 or .gif (needs Chromium)")
    parser.add_argument("--camera", default="orbit", help=f"of the film: {', '.join(CAMERAS)}")
    parser.add_argument("--size", default="1280x720", metavar="WxH", help="of the film, pixels")
    parser.add_argument("--fps", type=int, default=24, help="frames per second of the film")
    parser.add_argument("--open", action="store_true", help="open the page in the browser")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else on stdout")
    parser.set_defaults(run=_view)


def _view(options: argparse.Namespace) -> int:
    given, skipped = _flights(options.flights)
    names, logs = [*map(str, given)], [*given.values()]
    output = options.output or logs[0].with_name("flight.html")
    check_writable(output)
    size = _size(options.size)
    check_choice("camera", options.camera, CAMERAS)
    check_whole("fps", options.fps)
    if options.video:
        video.check_video(options.video)
        check_writable(options.video)
    if skipped:
        print(f"skipped, as no flights: {', '.join(map(str, skipped))}", file=sys.stderr)
    flights = logs[0] if len(logs) == 1 else dict(zip(names, logs, strict=True))
    page = show(flights, others=options.others, title=options.title)
    page.save(output)
    files = [output]
    if options.video:
        film(page, options.video, options.fps, size, options.camera)
        files.append(options.video)
    if options.open:
        webbrowser.open(output.absolute().as_uri())
    if options.json:
        print(as_json({"flights": names, "skipped": [*map(str, skipped)], "files": [*map(str, files)]}))
    else:
        print("wrote " + ", ".join(f"{file} ({file.stat().st_size / 1e6:.1f} MB)" for file in files))
    return 0


def _flights(paths: list[Path]) -> tuple[dict[Path, Path], list[Path]]:
    """The logs of flights by the paths that were given, and those of the paths, as of `runs/compare/*`, without a log.

    Raises:
        ValueError: none of them is a flight, or one is not there.
    """
    skipped = [path for path in paths if path.exists() and not _is_flight(path)]
    if len(skipped) == len(paths) > 1:
        raise UserError(f"none of {', '.join(map(str, paths))} is a flight; give the folders of `jaxdrones fly`")
    others = paths if len(paths) == 1 else [path for path in paths if path not in skipped]
    return {path: find_log(path) for path in others}, skipped if len(paths) > 1 else []


def _is_flight(path: Path) -> bool:
    """Whether a path leads to a log; a damaged .npz counts, so that it is not passed over."""
    try:
        log = find_log(path)
    except ValueError:
        return False
    if not zipfile.is_zipfile(log):
        return log.is_dir() or log.suffix in (".npz", ".csv")
    with zipfile.ZipFile(log) as archive:
        return "pos.npy" in archive.namelist()


def _size(text: str) -> tuple[int, int]:
    """Width and height of a text such as `1280x720`."""
    width, cross, height = text.partition("x")
    if not (cross and width.isdecimal() and height.isdecimal()) or int(width) % 2 or int(height) % 2:
        raise UserError(f"size of the film is {text!r}; give two even numbers of pixels, for example 1280x720")
    return int(width), int(height)

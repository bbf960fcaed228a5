"""`jaxdrones view`."""

import argparse
import functools
import sys
import webbrowser
import zipfile
from pathlib import Path
from typing import Any

from jaxdrones.arguments import choice, whole
from jaxdrones.cli.common import check_writable, folder, print_warning
from jaxdrones.cli.options import add_output, option, parse_pixels, switch
from jaxdrones.cli.policies import open_policy
from jaxdrones.cli.report import described, print_results
from jaxdrones.errors import UserError
from jaxdrones.flights.files import find_log
from jaxdrones.training.episode import fly_history
from jaxdrones.visualization import browser, films, video
from jaxdrones.visualization.viewer.page import Page
from jaxdrones.visualization.viewer.show import LAYOUTS, show, show_history


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "view",
        help="write a page with a 3D player of recorded flights",
        description="Write one HTML page that plays logs of `jaxdrones fly` in 3D, with drones, obstacles, targets and "
        "plots. It needs no network. Several logs are shown together.",
    )
    option(
        parser,
        "flights FLIGHT",
        "a folder of `jaxdrones fly`, a run, or a log.npz; of several paths, others are skipped",
        folder,
        nargs="+",
    )
    page = parser.add_argument_group("page and output")
    filmed = parser.add_argument_group("film")
    add_output(page, "path of the page (flight.html beside the first log; history.html)", metavar="FILE")
    option(page, "--others NAME", "layout of further flights: {}", default="ghosts", known=LAYOUTS)
    switch(page, "--history", "show the policies that a run of `train --keep-history` evaluated")
    page.add_argument("--title", help="title of the page (the conditions of the first flight)")
    switch(page, "--open", "open the page in the browser")
    option(filmed, "--video FILE", "film of the page, .mp4 or .gif; needs Chromium", folder)
    option(filmed, "--camera NAME", "{}", default="orbit", check=choice("camera", films.CAMERAS), known=films.CAMERAS)
    option(filmed, "--size WxH", "size, pixels", default="1280x720")
    option(filmed, "--fps N", "frames per second", int, 24, check=whole())
    parser.set_defaults(run=functools.partial(_view, parser))


def _view(parser: argparse.ArgumentParser, options: argparse.Namespace) -> int:
    for name in ("camera", "size", "fps") if options.video is None else ():
        if getattr(options, name) != parser.get_default(name):
            raise UserError(f"--{name} {getattr(options, name)} is given without --video FILE; give both or none")
    options.size = parse_pixels("--size", options.size, "1280x720")
    films.check_size("--size", options.size)
    if options.video:
        video.check_video(options.video, options.fps)
        browser.needed_browser()
    if options.history:
        return _view_history(options)
    given, skipped = _flights(options.flights)
    names, logs = [*map(str, given)], [*given.values()]
    output = options.output or logs[0].with_name("flight.html")
    check_writable(output, options.video)
    if skipped:
        print(f"skipped, as no flights: {', '.join(map(str, skipped))}", file=sys.stderr)
    flights = logs[0] if len(logs) == 1 else dict(zip(names, logs, strict=True))
    page = show(flights, others=options.others, title=options.title)
    return _write(options, page, output, {"flights": names, "skipped": [*map(str, skipped)]})


def _view_history(options: argparse.Namespace) -> int:
    if len(options.flights) > 1:
        raise UserError("--history shows one run; give one folder")
    output = options.output or options.flights[0] / "history.html"
    run = open_policy(options.flights[0], None, False, {})
    check_writable(output, options.video)
    recipe = run.recipe()
    with recipe.env() as env:
        evaluated = fly_history(run, env)
        label = "return" if env.task.success is None else "success"
    page = show_history(evaluated, run.sidecar_entry("best", "update"), label, options.title or described(recipe))
    return _write(options, page, output, {"run": str(run.folder), "policies": len(run.kept)})


def _write(options: argparse.Namespace, page: Page, output: Path, about: dict[str, Any]) -> int:
    page.save(output)
    files = [output]
    if options.video:
        films.film_page(page, options.video, options.fps, options.size, options.camera)
        files.append(options.video)
    if options.open and not webbrowser.open(output.absolute().as_uri()):
        print_warning("no browser was found; open the page in one")
    wrote = ", ".join(f"{file} ({file.stat().st_size / 1e6:.1f} MB)" for file in files)
    print_results(options, about | {"files": [*map(str, files)]}, f"wrote {wrote}")
    return 0


def _flights(paths: list[Path]) -> tuple[dict[Path, Path], list[Path]]:
    """Logs of flights by path, and paths without a log, as of `runs/compare/*`."""
    skipped = [path for path in paths if path.exists() and not _is_flight(path)]
    if len(skipped) == len(paths) > 1:
        raise UserError(f"none of {', '.join(map(str, paths))} is a flight; give the folders of `jaxdrones fly`")
    others = paths if len(paths) == 1 else [path for path in paths if path not in skipped]
    return {path: find_log(path) for path in others}, skipped if len(paths) > 1 else []


def _is_flight(path: Path) -> bool:
    """Whether a path is a log; a damaged .npz counts, to raise an error."""
    try:
        log = find_log(path)
    except ValueError:
        return False
    try:
        with zipfile.ZipFile(log) as archive:
            return "pos.npy" in archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return log.is_dir() or log.suffix in (".npz", ".csv")

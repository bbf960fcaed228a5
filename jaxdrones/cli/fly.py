"""`jaxdrones fly`."""

import argparse
import json
from pathlib import Path

from jaxdrones.cli.common import complain, table
from jaxdrones.cli.conditions import add_conditions, flown
from jaxdrones.conditions import BACKENDS
from jaxdrones.flights import scene_of
from jaxdrones.record import Record
from jaxdrones.render import plots, video
from jaxdrones.tasks.examples import FLIGHTS


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "fly",
        help="fly one of the paper's control examples",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Fly one of the paper's control examples; writes a log and a figure, prints a table of results.\n\n"
        + "\n".join(f"  {name:14} {flight.summary}" for name, flight in FLIGHTS.items()),
        epilog="What is left out is the flight's own. `jaxdrones list` shows the names to choose from.",
        allow_abbrev=False,
    )
    add_conditions(parser)
    parser.add_argument("--backend", default="explicit", help=f"{', '.join(BACKENDS)} (explicit)")
    parser.add_argument("--obstacles", action="store_true", help="put the paper's obstacles up (bullet)")
    parser.add_argument("--gui", action="store_true", help="watch in Bullet's window, with motor sliders (bullet)")
    parser.add_argument("--video", type=Path, metavar="FILE", help="film the flight as .mp4 or .gif; either backend")
    parser.add_argument("--cameras", action="store_true", help="write what each drone sees as PNG; either backend")
    parser.add_argument("--output", type=Path, metavar="DIR", help="folder of log and figure (runs/FLIGHT)")
    parser.add_argument("--csv", action="store_true", help="write the log as CSV too")
    parser.add_argument("--pwm", action="store_true", help="log the Crazyflie's PWM beside the RPM")
    parser.add_argument("--no-figure", action="store_true", help="write no figure; needs no matplotlib")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else on stdout")
    parser.set_defaults(run=_fly)


def _fly(options: argparse.Namespace) -> int:
    if not options.no_figure:
        plots.check_matplotlib()
    if options.video:
        video.check_video(options.video)
    output = options.output or Path("runs") / options.flight
    output.mkdir(parents=True, exist_ok=True)
    record = flown(options, backend=options.backend, obstacles=options.obstacles, gui=options.gui)
    files = _write(record, options, output)
    results = record.results(FLIGHTS[options.flight].settled)
    if options.json:
        print(json.dumps(record.conditions.as_dict() | {"results": results, "files": list(map(str, files))}))
    else:
        print(record.conditions)
        print(table(results))
        print("wrote " + ", ".join(map(str, files)))
    broken = record.first_not_finite()
    if broken:
        return complain(f"the state of {broken[1]} is not finite from t = {broken[0]:.3f} s on", 1)
    return 0


def _write(record: Record, options: argparse.Namespace, output: Path) -> list[Path]:
    """Log, figure, film and pictures, as asked for."""
    files = [output / "log.npz"]
    record.save_npz(files[0], options.pwm)
    if options.csv:
        files.append(output / "log.csv")
        record.save_csv(files[-1], options.pwm)
    if not options.no_figure:
        example = FLIGHTS[options.flight]
        files.append(output / "flight.png")
        plots.save_flight(record, files[-1], f"{options.flight}: {example.summary}", example.panels)
    if options.video or options.cameras:
        from jaxdrones.render import replay  # needs pybullet

        if options.video:
            replay.film(record, options.video, scene_of(record.conditions))
            files.append(options.video)
        if options.cameras:
            files.append(output / "cameras")
            replay.save_cameras(record, files[-1], scene_of(record.conditions))
    return files

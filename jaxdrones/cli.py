"""The command line: `jaxdrones fly`, `jaxdrones compare`, `jaxdrones list`."""

import argparse
import contextlib
import json
import sys
from pathlib import Path

from jaxdrones import assets
from jaxdrones.conditions import BACKENDS
from jaxdrones.control import CONTROLLERS
from jaxdrones.dynamics import EFFECTS, INTEGRATORS, PAIRS, ROTORS
from jaxdrones.envs import ACTIONS, OBSERVATIONS, TASKS
from jaxdrones.flights import fly, scene_of
from jaxdrones.record import Record, divergence
from jaxdrones.render import plots, video
from jaxdrones.tasks.examples import FLIGHTS

_COLUMNS = {  # result: (heading, format)
    "drone": ("drone", "{}"),
    "rms_error_m": ("rms (m)", "{:.4f}"),
    "peak_error_m": ("peak (m)", "{:.4f}"),
    "steady_error_m": ("steady (m)", "{:.4f}"),
    "rms_error_m_s": ("rms (m/s)", "{:.4f}"),
    "peak_error_m_s": ("peak (m/s)", "{:.4f}"),
    "steady_error_m_s": ("steady (m/s)", "{:.4f}"),
    "settled_after_s": ("settled (s)", "{:.2f}"),
    "lowest_z_m": ("z min (m)", "{:.4f}"),
    "highest_z_m": ("z max (m)", "{:.4f}"),
    "peak_vz_m_s": ("vz max (m/s)", "{:.4f}"),
    "peak_speed_m_s": ("|v| max (m/s)", "{:.4f}"),
    "rpm_std": ("RPM std", "{:.1f}"),
    "t_s": ("t (s)", "{:.2f}"),
    "pos_m": ("position (m)", "{:.2e}"),
    "vel_m_s": ("velocity (m/s)", "{:.2e}"),
    "angle_rad": ("attitude (rad)", "{:.2e}"),
    "omega_rad_s": ("rates (rad/s)", "{:.2e}"),
    "rpm": ("rotors (RPM)", "{:.2e}"),
}


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit code: 0 done, 1 the flight broke, 2 a mistake in what was asked."""
    parser = _parser()
    options = parser.parse_args(arguments)
    try:
        return options.run(options)
    except OSError as error:
        unwritable = f"{error.filename}: {error.strerror}; choose another --output"
        return _complain(unwritable if error.filename else str(error))
    except (ValueError, ImportError) as error:
        return _complain(str(error))


def _complain(message: str, code: int = 2) -> int:
    print(f"jaxdrones: error: {message}", file=sys.stderr)
    return code


class _Parser(argparse.ArgumentParser):
    def error(self, message):
        self.exit(2, f"jaxdrones: error: {message}; see {self.prog} --help\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="jaxdrones", description="Simulate teams of quadrotors.", allow_abbrev=False)
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)
    _add_fly(commands)
    _add_compare(commands)
    _add_list(commands)
    return parser


def _add_fly(commands) -> None:
    parser = commands.add_parser(
        "fly",
        help="fly one of the paper's control examples",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Fly one of the paper's control examples; writes a log and a figure, prints a table of results.\n\n"
        + "\n".join(f"  {name:14} {flight.summary}" for name, flight in FLIGHTS.items()),
        epilog="What is left out is the flight's own. `jaxdrones list` shows the names to choose from.",
        allow_abbrev=False,
    )
    _add_conditions(parser)
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


def _add_conditions(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("flight", metavar="FLIGHT", help=", ".join(FLIGHTS))
    parser.add_argument("--drones", type=int, metavar="N", help="number of drones")
    parser.add_argument("--vehicle", default="cf2x", help=f"{', '.join(assets.vehicles())} or a .urdf file (cf2x)")
    parser.add_argument("--effects", metavar="A,B", help=f"{', '.join(EFFECTS | PAIRS)}, or none")
    parser.add_argument("--controller", help=f"{', '.join(CONTROLLERS)} (the vehicle's own)")
    parser.add_argument("--control-hz", type=int, metavar="HZ", help="control rate; physics runs at 240 Hz or above")
    parser.add_argument("--duration", type=float, metavar="S", help="simulated time in seconds")
    parser.add_argument("--rotors", default="instant", help=f"{', '.join(ROTORS)} (instant)")
    parser.add_argument("--integrator", default="semi_implicit_euler", help=f"{', '.join(INTEGRATORS)}")
    parser.add_argument("--seed", type=int, help="start 1 cm (standard deviation) off, drawn with this seed")


def _add_compare(commands) -> None:
    parser = commands.add_parser(
        "compare",
        help="fly an example on both backends and print how they part",
        description="Fly an example on two backends from the same start and print their divergence over time.",
        allow_abbrev=False,
    )
    _add_conditions(parser)
    parser.add_argument("--backends", default="explicit,bullet", metavar="A,B", help="two of " + ", ".join(BACKENDS))
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else on stdout")
    parser.set_defaults(run=_compare)


def _add_list(commands) -> None:
    parser = commands.add_parser(
        "list", help="vehicles, effects, tasks, actions, ... to choose from", allow_abbrev=False
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=_list)


def _fly(options: argparse.Namespace) -> int:
    if not options.no_figure:
        plots.check_matplotlib()
    if options.video:
        video.check_video(options.video)
    output = options.output or Path("runs") / options.flight
    output.mkdir(parents=True, exist_ok=True)
    record = _flown(options, backend=options.backend, obstacles=options.obstacles, gui=options.gui)
    files = _write(record, options, output)
    results = record.results(FLIGHTS[options.flight].settled)
    if options.json:
        print(json.dumps(record.conditions.as_dict() | {"results": results, "files": list(map(str, files))}))
    else:
        print(record.conditions)
        print(_table(results))
        print("wrote " + ", ".join(map(str, files)))
    broken = record.first_not_finite()
    if broken:
        return _complain(f"the state of {broken[1]} is not finite from t = {broken[0]:.3f} s on", 1)
    return 0


def _flown(options: argparse.Namespace, **more) -> Record:
    with _progress() as progress:
        return fly(
            options.flight,
            vehicle=options.vehicle,
            drones=options.drones,
            effects=_names(options.effects),
            controller=options.controller,
            control_hz=options.control_hz,
            duration=options.duration,
            rotors=options.rotors,
            integrator=options.integrator,
            seed=options.seed,
            progress=progress,
            **more,
        )


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


def _compare(options: argparse.Namespace) -> int:
    names = options.backends.split(",")
    if len(names) != 2:
        raise ValueError(f"--backends is {options.backends!r}; give two, for example explicit,bullet")
    rows = divergence(*(_flown(options, backend=name) for name in names))
    if options.json:
        print(json.dumps({"flight": options.flight, "backends": names, "divergence": rows}))
    else:
        print(f"{options.flight}: {names[0]} against {names[1]}, largest difference over the drones")
        print(_table(rows))
    return 0


def _list(options: argparse.Namespace) -> int:
    names = {
        "flights": list(FLIGHTS),
        "vehicles": list(assets.vehicles()),
        "effects": list(EFFECTS | PAIRS),
        "controllers": list(CONTROLLERS),
        "rotors": list(ROTORS),
        "integrators": list(INTEGRATORS),
        "backends": list(BACKENDS),
        "tasks": list(TASKS),
        "actions": list(ACTIONS),
        "observations": list(OBSERVATIONS),
    }
    if options.json:
        print(json.dumps(names))
    else:
        for kind, known in names.items():
            print(f"{kind:12} {', '.join(known)}")
    return 0


def _names(text: str | None) -> list[str] | None:
    if text is None:
        return None
    return [] if text == "none" else [name.strip() for name in text.split(",")]


@contextlib.contextmanager
def _progress():
    """A progress bar on stderr, told of the share that is done; silent without tqdm or a terminal."""
    try:
        from tqdm import tqdm
    except ImportError:
        yield None
        return
    with tqdm(total=100, desc="flying", unit="%", leave=False, disable=None, file=sys.stderr) as bar:
        yield lambda share: bar.update(round(100 * share) - bar.n)


def _table(results: list[dict]) -> str:
    """Columns aligned under their headings, one line per drone."""
    names = list(results[0])
    rows = [[_COLUMNS[name][0] for name in names]]
    rows += [["-" if row[name] is None else _COLUMNS[name][1].format(row[name]) for name in names] for row in results]
    widths = [max(len(row[i]) for row in rows) for i in range(len(names))]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)

"""The command `jaxdrones fit`."""

import argparse
import sys
from pathlib import Path

from jaxdrones.cli.common import as_json, check_writable, folder

_FIGURE = "errors.png"


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "fit",
        help="identify a vehicle from recorded flights",
        description="Estimate parameters of a vehicle from flight logs (.npz with t, pos, quat, vel, omega and rpm, or "
        "pwm and vbat). Prints each with its standard error, and writes a folder with vehicle.urdf, report.json and a "
        "figure. Other commands take vehicle.urdf as --vehicle; `jaxdrones score` takes the folder.",
        allow_abbrev=False,
    )
    parser.add_argument("logs", nargs="+", type=Path, metavar="FLIGHT.npz", help="flights to fit")
    parser.add_argument(
        "--vehicle",
        default="cf2x",
        metavar="NAME|URDF",
        help="initial values: a bundled vehicle or URDF (cf2x)",
    )
    parser.add_argument(
        "--parameters",
        metavar="NAME,...",
        help="parameters to fit, such as kf,inertia,drag_coeff (those that such logs identify)",
    )
    parser.add_argument(
        "--validate",
        nargs="+",
        type=Path,
        default=[],
        metavar="FLIGHT.npz",
        help="flights that are not fitted, on which the best round is chosen",
    )
    parser.add_argument(
        "--propellers", default="2.1+", metavar="NAME", help="propellers of the Crazyflie, for logs with PWM (2.1+)"
    )
    parser.add_argument("--output", type=folder, default=Path("runs/fit"), metavar="FOLDER", help="(runs/fit)")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else on stdout")
    parser.set_defaults(run=_fit)


def _fit(options: argparse.Namespace) -> int:
    from jaxdrones.dynamics import crazyflie_motors
    from jaxdrones.identification import FlightLog, fit
    from jaxdrones.identification.files import REPORT, report_as_dict, write_vehicle
    from jaxdrones.urdf import load_params
    from jaxdrones.visualization.residuals import save_errors

    params = load_params(options.vehicle)
    motors = crazyflie_motors(options.propellers)
    names = [name.strip() for name in (options.parameters or "").split(",") if name.strip()]
    logs, validate = ([FlightLog.load(file) for file in files] for files in (options.logs, options.validate))
    check_writable(options.output / REPORT)
    report = fit(logs, params, names, validate, motors, progress=lambda line: print(line, file=sys.stderr))
    write_vehicle(options.output, report, options.vehicle)
    save_errors(report.errors, options.output / _FIGURE)
    if options.json:
        print(as_json(report_as_dict(report) | {"output": str(options.output)}))
    else:
        print(parameter_table(report))
        print(f"{options.output}: vehicle.urdf, {REPORT}, {_FIGURE}")
    return 0


def parameter_table(report) -> str:
    """Lines of text with the estimate and standard error of each parameter."""
    width = max(map(len, report.parameters))
    lines = [
        f"  {name.ljust(width)}  {e.value: .4g} +- {e.std_error:.2g}"
        f"{'' if e.identifiable else '  (not identifiable from these flights)'}"
        for name, e in report.parameters.items()
    ]
    return "\n".join(lines)

"""`jaxdrones fit`."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from jaxdrones.cli.common import check_writable, folder, print_warning
from jaxdrones.cli.options import add_no_figure, add_output, add_vehicle, option, split_names, switch
from jaxdrones.cli.report import print_results
from jaxdrones.control import firmware_pid
from jaxdrones.dynamics.propulsion import crazyflie_motors
from jaxdrones.envs.explanation import aligned
from jaxdrones.errors import UserError
from jaxdrones.flights import fit, inconsistencies, load_flights
from jaxdrones.flights.files import find_log
from jaxdrones.flights.report import check_no_fit, report_as_dict, write_vehicle
from jaxdrones.flights.vehicle import REPORT, URDF
from jaxdrones.urdf import load_params
from jaxdrones.visualization.plots import check_matplotlib
from jaxdrones.visualization.residuals import save_errors

_FIGURE = "errors.png"


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "fit",
        help="identify a vehicle from recorded flights",
        description="Estimate parameters of a vehicle from flights: logs of `jaxdrones fly`, .npz or .csv files with "
        "t, pos, quat, vel, omega and rpm (or pwm and vbat), or bags of ROS 2. Print the estimates with standard "
        "errors, and write a folder with vehicle.urdf, report.json and a figure. Other commands take vehicle.urdf as "
        "--vehicle; `jaxdrones score` takes the folder.",
    )
    option(parser, "logs FLIGHT", "flights to fit", folder, nargs="+")
    model = parser.add_argument_group("model and data")
    files = parser.add_argument_group("files and output")
    add_vehicle(model, "cf2x", "initial values: ")
    option(
        model,
        "--parameters A,B",
        "parameters to fit, such as kf,inertia,drag_coeff (those identifiable from such logs)",
    )
    option(model, "--validate FLIGHT", "held-out flights to choose the best round of the fit", folder, [], nargs="+")
    add_log_options(model)
    add_output(files, "folder of the fit, without an earlier fit (runs/fit)", Path("runs/fit"))
    add_no_figure(files)
    parser.set_defaults(run=_fit)


def _fit(options: argparse.Namespace) -> int:
    params = load_params(options.vehicle)
    motors, gains = crazyflie_motors(options.propellers), firmware_pid.gains(propellers=options.propellers)
    names = split_names(options.parameters) if options.parameters else []
    check_no_fit(options.output)
    check_writable(options.output / REPORT)
    logs = load_logs([*options.logs, *options.validate], options.allow_inconsistent)
    kept = {find_log(file) for file in options.validate}
    fitted, validate = ([log for log in logs if (log.file in kept) is given] for given in (False, True))
    report = fit(fitted, params, names, validate, motors, lambda line: print(line, file=sys.stderr), gains)
    write_vehicle(options.output, report, options.vehicle)
    print_results(options, report_as_dict(report) | {"output": str(options.output)}, parameter_table(report))
    try:
        load_params(options.output / URDF)
    except UserError as error:  # estimates without physical meaning, such as a negative drag
        print_warning(f"no command accepts the fitted vehicle ({error}); leave such parameters out of --parameters")
    files = [URDF, REPORT]
    if not options.no_figure:
        try:
            check_matplotlib()
            save_errors(report.errors, options.output / _FIGURE)
            files.append(_FIGURE)
        except UserError as error:
            print_warning(f"no {_FIGURE}: {error}")
    if not options.json:
        print(f"{options.output}: {', '.join(files)}")
    return 0


def add_log_options(group) -> None:
    """Add --propellers and --allow-inconsistent."""
    option(group, "--propellers NAME", "propellers of the Crazyflie, for logs with PWM", default="2.1+")
    switch(
        group,
        "--allow-inconsistent",
        "accept logs with contradictory columns (wrong clock, axes, order of motors), with a warning",
    )


def load_logs(files: Sequence[Path], allow_inconsistent: bool) -> list:
    """Load the drones of logs with unique names; warn of allowed contradictions."""
    logs = load_flights(*files, allow_inconsistent=allow_inconsistent)
    for log in logs if allow_inconsistent else ():
        for found in inconsistencies(log):
            print_warning(f"{log.name}: {found}")
    return logs


def parameter_table(report) -> str:
    """Table of the estimate and standard error of each parameter."""
    doubt = "  (not identifiable from these flights)"
    estimates = report.parameters.values()
    texts = [f"{e.value: .4g} +- {e.std_error:.2g}{'' if e.identifiable else doubt}" for e in estimates]
    return f"SI units (kg, m, s, N, rad, V, RPM)\n{aligned(list(zip(report.parameters, texts, strict=True)))}"

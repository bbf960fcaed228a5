"""`jaxdrones score`."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from jaxdrones.cli.common import bar, check_writable, folder
from jaxdrones.cli.fit import add_log_options, load_logs
from jaxdrones.cli.options import option
from jaxdrones.cli.report import print_results
from jaxdrones.control import firmware_pid
from jaxdrones.dynamics.propulsion import crazyflie_motors
from jaxdrones.errors import UserError
from jaxdrones.flights import errors_as_dict, hold_errors, load_vehicle, open_loop_errors, simulate_closed_loop
from jaxdrones.visualization.plots import SUFFIXES
from jaxdrones.visualization.residuals import save_paths

_NOMINAL = "cf2x"


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "score",
        help="compare a vehicle with recorded flights",
        description="Simulate a vehicle from every state of flight logs on the recorded inputs (open loop), and print "
        "its errors after 0.1, 0.25 and 0.5 s, beside those of a constant state and of the nominal vehicle. A log with "
        "set-points is also simulated as a whole, with the firmware's PID (closed loop).",
    )
    option(parser, "logs FLIGHT", "logs, see `jaxdrones fit`", folder, nargs="+")
    option(parser, "--vehicle NAME|URDF|DIR", "a bundled vehicle, URDF, or folder of `jaxdrones fit`", required=True)
    option(parser, "--nominal NAME|URDF", "nominal vehicle, for comparison", default=_NOMINAL)
    add_log_options(parser)
    option(parser, "--figure FILE", "draw recorded and simulated paths (.png or .pdf)", Path)
    parser.set_defaults(run=_score)


def _score(options: argparse.Namespace) -> int:
    motors = crazyflie_motors(options.propellers)
    vehicles = {"nominal": load_vehicle(options.nominal), "vehicle": load_vehicle(options.vehicle)}
    logs = load_logs(options.logs, options.allow_inconsistent)
    gains = firmware_pid.gains(propellers=options.propellers)
    with_setpoints = [log for log in logs if log.has("target_pos", "target_yaw", "pwm")]
    if options.figure:
        _check_figure(options.figure, bool(with_setpoints))
    flights = len(logs) + len(vehicles) * (len(logs) + len(with_setpoints))
    with bar(flights, "score", " flights") as shown:

        def counted(result):
            if shown is not None:
                shown.update()
            return result

        errors = {"hold": np.mean([counted(hold_errors(log)) for log in logs], axis=0)}
        for name, vehicle in vehicles.items():
            errors[name] = np.mean([counted(open_loop_errors(log, vehicle, motors)) for log in logs], axis=0)
        simulated = {
            name: [counted(simulate_closed_loop(log, vehicle, motors, gains)) for log in with_setpoints]
            for name, vehicle in vehicles.items()
        }
    titles = {"nominal": f"{options.nominal} (nominal)", "vehicle": options.vehicle}

    def named(models: dict[str, Any]) -> dict[str, Any]:
        return {titles.get(name, name): found for name, found in models.items()}

    closed_loop = {name: [result.as_dict() for result in flights] for name, flights in simulated.items()}
    if options.figure:
        save_paths(named(simulated), options.figure)
    results: dict[str, Any] = {
        "vehicle": options.vehicle,
        "flights": [log.name for log in logs],
        "open_loop": {name: errors_as_dict(table) for name, table in errors.items()},
        "closed_loop": closed_loop["vehicle"],
        "closed_loop_nominal": closed_loop["nominal"],
    }
    open_loop = open_loop_table(named(results["open_loop"]))
    print_results(options, results, open_loop, closed_loop_table(named(closed_loop)) if with_setpoints else None)
    return 0


def _check_figure(file: Path, has_paths: bool) -> None:
    if not has_paths:
        raise UserError("no log has set-points, so there are no paths to draw; leave --figure out")
    if file.suffix not in SUFFIXES:
        raise UserError(f"--figure is {str(file)!r}; give a name that ends in {' or '.join(SUFFIXES)}")
    check_writable(file)


def open_loop_table(models: dict[str, Any]) -> str:
    """Table of the open-loop errors of each model after each horizon."""
    width = max(map(len, (*models, "vehicle")))
    lines = [f"{'vehicle':{width}}  after (s)  position (m)  velocity (m/s)  attitude (rad)  rates (rad/s)"]
    for model, horizons in models.items():
        for rows, e in horizons.items():
            numbers = f"{e['pos']:12.4f}  {e['vel']:14.3f}  {e['rot']:14.4f}  {e['omega']:13.3f}"
            lines.append(f"{model:{width}}  {int(rows) / 100:9.2f}  {numbers}")
    return "\n".join(lines)


def closed_loop_table(models: dict[str, list[dict[str, Any]]]) -> str:
    """Table of path distances, tracking errors and mean PWM of each vehicle in each flight."""
    width = max(map(len, (*models, "vehicle")))
    lines = [
        f"{'vehicle':{width}}  flight                            xy (m)  xyz (m)  tracking real, sim (m)  PWM real, sim"
    ]
    for model, flights in models.items():
        for e in flights:
            distances = f"{e['xy_rms_m']:6.3f}  {e['xyz_rms_m']:7.3f}"
            tracking = f"{e['tracking_real_m']:14.3f}, {e['tracking_sim_m']:6.3f}"
            pwm = f"{e['pwm_real']:7.0f}, {e['pwm_sim']:5.0f}{' (at its limit)' * e['saturated']}"
            lines.append(f"{model:{width}}  {e['flight'][:32]:32}  {distances}  {tracking}  {pwm}")
    return "\n".join(lines)

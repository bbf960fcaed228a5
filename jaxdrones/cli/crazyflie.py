"""`jaxdrones crazyflie`."""

import argparse
from pathlib import Path

from jaxdrones.arguments import number, whole
from jaxdrones.cli.common import check_writable, print_error, until_interrupted
from jaxdrones.cli.options import add_output, add_vehicle, option
from jaxdrones.cli.report import listed, print_results
from jaxdrones.firmware.crazyflie import Crazyflie, Server, Vehicle
from jaxdrones.firmware.crazyflie.server import PORT
from jaxdrones.firmware.drone import Recorder
from jaxdrones.flights.files import save_npz

_PORT = whole("port", limit=65535)
_EXAMPLE = "export CFLIB_URI=udp://127.0.0.1:19850"


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "crazyflie",
        help="simulate a Crazyflie to which cflib connects",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Simulate a Crazyflie in real time, flown by the PID of its firmware. Scripts of cflib\n"
        "connect to udp://127.0.0.1:PORT; those that use `uri_from_env` run unchanged after\n"
        f"{_EXAMPLE}\n\n"
        "It supports parameters, log blocks, set-points of all kinds, the high-level commander with uploaded\n"
        "trajectories, arming and emergency stops. Ctrl-C ends the flight and writes its log.",
    )
    add_vehicle(parser, "cf2x")
    option(parser, "--port PORT", "UDP port, on 127.0.0.1", int, PORT, check=_PORT)
    option(parser, "--duration S", "simulated time, s (until Ctrl-C)", float, check=number("s", above=0))
    option(parser, "--speed X", "real-time factor; scripts keep their own clock", float, 1.0, check=number(above=0))
    add_output(parser, "folder of the log (runs/crazyflie)", Path("runs") / "crazyflie")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    file = options.output / "log.npz"
    check_writable(file)
    recorder, vehicle = Recorder(), Vehicle(options.vehicle)
    with Server(Crazyflie(vehicle), options.port) as server:
        if not options.json:
            print(f"a Crazyflie ({options.vehicle}) is at udp://127.0.0.1:{server.port}; Ctrl-C ends it", flush=True)
        failed = until_interrupted(
            lambda: server.run(options.duration, options.speed, lambda t, now, target: recorder.add(t, now))
        )
    report = vars(server.flown) | {"real_time_factor": round(server.flown.real_time_factor, 3)}
    files = [str(file)] if len(recorder) else []
    if files:
        conditions = {"vehicle": options.vehicle, "controller": "firmware_pid"}
        save_npz(recorder.log(vehicle.params, conditions, f"crazyflie: {options.vehicle}, flown by cflib"), file)
    print_results(options, report | {"files": files}, listed(report), f"wrote {file}" if files else "nothing was flown")
    return print_error(*failed) if failed else 0

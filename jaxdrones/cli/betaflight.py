"""`jaxdrones betaflight`."""

import argparse
import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jaxdrones.arguments import number, whole
from jaxdrones.cli.common import check_writable, folder, print_error, print_warning, until_interrupted
from jaxdrones.cli.options import add_output, add_vehicle, option, switch
from jaxdrones.cli.policies import open_policy
from jaxdrones.cli.report import listed, print_results
from jaxdrones.errors import UserError
from jaxdrones.firmware import betaflight
from jaxdrones.firmware.betaflight.joystick import AXES, Joystick
from jaxdrones.firmware.betaflight.link import connect_msp
from jaxdrones.firmware.betaflight.pilots import PERIOD, Pilot
from jaxdrones.firmware.betaflight.process import build
from jaxdrones.firmware.drone import Recorder
from jaxdrones.flights.files import save_npz
from jaxdrones.flights.log import FlightLog
from jaxdrones.training.betaflight_pilot import PolicyPilot

_TARGET, _AXES = "0,0,1.5", ",".join(map(str, AXES))
_RATE = whole("rate of the physics (Hz)", limit=8000)
_TAKE_OFF = 4.0  # s after arming from which the distance to the target counts, and a policy flies


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "betaflight",
        help="fly with Betaflight itself in the loop",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Simulate a drone whose motors Betaflight commands. Betaflight's program (SITL) exchanges packets\n"
        "with the simulation on 127.0.0.1. The command starts the program, or uses one that is already running (its\n"
        "MSP port 5761 answers), configures and arms it by MSP, and flies in acro mode by the sticks of a pilot: the\n"
        "outer loop of the controller `rates`, a policy, or a joystick. Ctrl-C ends the flight and writes its log.\n\n"
        "`jaxdrones betaflight --build` downloads the source (GPL-3.0; package `betaflight`) and compiles it once,\n"
        "with gcc and make, into ~/.cache/jaxdrones/betaflight. BETAFLIGHT_SITL=PATH selects another program.",
    )
    switch(parser, "--build", "download and compile Betaflight, then exit")
    switch(parser, "--if-missing", "with --build: do nothing if the program exists")
    add_vehicle(parser, "racer")
    pilots = parser.add_argument_group("pilot")
    clock = parser.add_argument_group("clock")
    files = parser.add_argument_group("files and output")
    option(pilots, "--target X,Y,Z", "position to fly to, m", default=_TARGET)
    option(pilots, "--flip S", "time of a flip after arming, s", float, check=number("s", at_least=0))
    option(pilots, "--policy RUN", "fly a policy, with action=thrust_and_rates", folder)
    option(pilots, "--joystick DEVICE", "fly by hand, such as /dev/input/js0", Path)
    option(
        pilots,
        "--axes R,P,T,Y",
        "axes of roll, pitch, throttle, yaw; -1 is axis 0 reversed, -2 is axis 1 reversed, ...",
        default=_AXES,
    )
    option(clock, "--duration S", "simulated time after arming, s (until Ctrl-C)", float, check=number("s", above=0))
    option(clock, "--physics-hz HZ", "states per second, a multiple of 100", int, 1000, _RATE)
    switch(clock, "--real-time", "follow the clock; by default each step waits for motor outputs")
    option(clock, "--wait S", "longest time to arm Betaflight, s", float, 30.0, check=number("s", above=0))
    add_output(files, "folder of the log (runs/betaflight)", Path("runs") / "betaflight")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    say: Callable[[str], None] = (lambda text: None) if options.json else (lambda text: print(text, flush=True))
    if options.build:
        existing = None
        if options.if_missing:
            with contextlib.suppress(UserError):  # there is none
                existing = betaflight.find_program()
        path = existing or build(say)
        text = f"{path} exists" if existing else f"built {path}"
        print_results(options, {"program": str(path), "built": not existing}, text)
        return 0
    if options.if_missing:
        raise UserError("--if-missing is given without --build; give both or none")
    _check(options)
    file = options.output / "log.npz"
    check_writable(file)
    running = connect_msp()
    program = None if running else betaflight.find_program()
    if running:
        running.close()
    with contextlib.ExitStack() as stack:
        link = stack.enter_context(betaflight.Link())
        simulation = betaflight.Simulation(options.vehicle, options.physics_hz)
        pilot, target = _pilot(options, simulation, stack)
        say("using the running Betaflight" if program is None else f"starting {program}")
        process = None if program is None else stack.enter_context(betaflight.Process(program))
        recorder = Recorder()
        flight = betaflight.Flight(
            simulation,
            link,
            pilot,
            process=process,
            lockstep=not options.real_time,
            wait=options.wait,
            on_row=lambda t, now, sticks: recorder.add(t, now, target() if target else None),
            warn=print_warning,
        )
        failed = until_interrupted(lambda: flight.run(options.duration), betaflight.BetaflightLost)
    report: dict[str, Any] = vars(flight.flown) | {"real_time_factor": round(flight.flown.real_time_factor, 3)}
    if len(recorder):
        about = f"betaflight: {options.vehicle}{', real time' if options.real_time else ''}"
        log = recorder.log(simulation.params, {"vehicle": options.vehicle, "controller": "betaflight"}, about)
        save_npz(log, file)
        settled = log.t > log.t[-1] - (flight.flown.armed_s - _TAKE_OFF)
        if options.flip is None:
            report |= errors_of(log, settled)
        say(f"wrote {file}")
    report = {name: round(x, 4) if isinstance(x, float) else x for name, x in report.items()}
    print_results(options, report, listed(report))
    return print_error(*failed) if failed else 0


def errors_of(log: FlightLog, rows: np.ndarray) -> dict[str, float]:
    """Mean and largest distance from the target in those of the rows with a target, m; nothing without one."""
    error = log.error[rows & np.isfinite(log.target_pos).all(axis=(1, 2))]
    return {"mean_error_m": float(error.mean()), "peak_error_m": float(error.max())} if error.size else {}


def _check(options: argparse.Namespace) -> None:
    if options.policy is not None and options.joystick is not None:
        raise UserError("--policy and --joystick are given; give one of them")
    if options.joystick is not None and options.flip is not None:
        raise UserError("--flip is given beside --joystick; leave it out")
    if options.physics_hz % round(1 / PERIOD):
        raise UserError(
            f"--physics-hz is {options.physics_hz}; give a multiple of {1 / PERIOD:g}, the rate of the sticks"
        )
    target, axes = _numbers("target", options.target, 3, float), _numbers("axes", options.axes, 4, int)
    if options.target != _TARGET and (options.policy or options.joystick):
        raise UserError("--target is given beside --policy or --joystick, which flies elsewhere; leave it out")
    if options.axes != _AXES and options.joystick is None:
        raise UserError("--axes is given without --joystick; leave it out, or give both")
    options.target, options.axes = target, axes


def _numbers(name: str, text: str, count: int, kind: Callable[[str], Any]) -> tuple[Any, ...]:
    try:
        found = tuple(map(kind, text.split(",")))
    except ValueError:
        found = ()
    if len(found) != count or not np.isfinite(found).all():
        raise UserError(f"--{name} is {text!r}; give {count} numbers with commas between them")
    return found


def _pilot(
    options: argparse.Namespace, simulation: betaflight.Simulation, stack: contextlib.ExitStack
) -> tuple[Pilot, Callable[[], np.ndarray] | None]:
    """Pilot, and the function that returns its target position; `None` for a joystick."""
    if options.joystick is not None:
        return stack.enter_context(Joystick(options.joystick, options.axes)), None
    if options.policy is not None:
        run = open_policy(options.policy, None, False, {})
        env = stack.enter_context(run.recipe().env(drones=1))
        if env.vehicle != options.vehicle:
            raise UserError(f"the policy flies {env.vehicle}, not {options.vehicle}; give --vehicle {env.vehicle}")
        policy = PolicyPilot(env, run.policy(env=env))
        x, y, z = map(float, policy.target)
        pilot = betaflight.TakeOff(_hover(simulation, (x, y, z)), policy, _TAKE_OFF)  # policies were trained in the air
        return _with_flip(options, simulation, pilot), lambda: policy.target
    hover = _hover(simulation, options.target)
    return _with_flip(options, simulation, hover), lambda: np.array(options.target)


def _hover(simulation: betaflight.Simulation, target: tuple[float, float, float]) -> Pilot:
    hover = betaflight.Hover(simulation.params, target)
    hover(0.0, simulation.sample)  # compiles it
    return hover


def _with_flip(options: argparse.Namespace, simulation: betaflight.Simulation, pilot: Pilot) -> Pilot:
    return pilot if options.flip is None else betaflight.Flip(simulation.params, pilot, options.flip)

"""`jaxdrones ros2`."""

import argparse
import contextlib
import functools
import math
import time
from typing import Any

from jaxdrones.arguments import choice, number, whole
from jaxdrones.cli.common import folder, print_error, print_warning, until_interrupted
from jaxdrones.cli.options import add_backend, add_drones, add_vehicle, option, parse_pixels, switch
from jaxdrones.cli.report import listed, print_results
from jaxdrones.dynamics.contact import drone_contact, ground_contact
from jaxdrones.engine.explicit import make_step
from jaxdrones.errors import UserError
from jaxdrones.flights.conditions import PHYSICS_HZ
from jaxdrones.params import repeat
from jaxdrones.ros2 import bag, topics
from jaxdrones.ros2.command import CONTROLLERS
from jaxdrones.ros2.failsafe import ACTIONS, Failsafe, PeerLost
from jaxdrones.ros2.node import Node
from jaxdrones.ros2.simulation import Simulation
from jaxdrones.sensing import Camera
from jaxdrones.state import State
from jaxdrones.urdf import load_params

_SPACING = 0.5  # m between drones at the start, along y
_CAMERA_HZ = 10.0
_RATE = whole("control rate (Hz)", limit=20_000)
_OF_REPLAY = ("bag", "speed", "json", "run", "ranges", "debug")


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser("ros2", help="simulate a team with ROS 2 topics")
    team = parser.add_argument_group("team")
    add_drones(team, 1)
    add_vehicle(team, "cf2x")
    add_backend(team)
    text, check = "of positions, velocities: {} (the vehicle's)", choice("controller", CONTROLLERS)
    option(team, "--controller NAME", text, check=check, known=CONTROLLERS)
    option(team, "--control-hz HZ", "control and message rate", int, 100, _RATE)
    option(team, "--height M", "initial height, m", float, 1.0, check=number("m", above=0))
    watch = parser.add_argument_group("clock and failsafe")
    wire = parser.add_argument_group("messages")
    pace = watch.add_mutually_exclusive_group()
    switch(pace, "--lockstep", "one step for each call of the service /step")
    switch(pace, "--real-time", "follow the clock (default)")
    option(watch, "--speed X", "real-time factor", float, 1.0, check=number(above=0))
    option(watch, "--duration S", "simulated time, s (until Ctrl-C)", float, check=number("s", at_least=0))
    option(wire, "--camera WxH", "resolution of a camera on every drone, pixels (none)")
    option(wire, "--camera-hz HZ", "images per second", float, _CAMERA_HZ)
    option(watch, "--timeout S", "seconds without a command before the failsafe acts", float, 1.0)
    option(watch, "--wait S", "the same timeout before the first command", float, 30.0)
    option(watch, "--failsafe NAME", "{}", default="hover", known=ACTIONS)
    option(wire, "--record BAG", "write all messages to this new folder, as MCAP", folder)
    parser.set_defaults(run=_run)
    commands = parser.add_subparsers(metavar="[replay]", title="commands")
    replay = commands.add_parser("replay", help="publish the messages of a bag")
    option(replay, "bag BAG", "folder of a bag; nothing is simulated", folder)
    text = "real-time factor (1)"  # of `ros2`, too: without a default of its own, which would replace that one
    replay.add_argument("--speed", type=float, default=argparse.SUPPRESS, metavar="X", help=text)
    for name in ("--json", "--debug"):  # as before `replay`
        replay.add_argument(name, action="store_true", default=argparse.SUPPRESS, help=argparse.SUPPRESS)
    replay.set_defaults(run=functools.partial(_replay, parser))


def join() -> topics.Transport:
    """Start a node of rclpy."""
    from jaxdrones.ros2.rclpy_transport import RclpyTransport  # optional

    return RclpyTransport()


def _run(options: argparse.Namespace) -> int:
    with contextlib.closing(join()) as transport:
        failsafe, camera = Failsafe(options.failsafe, options.timeout, options.wait), _camera(options)
        with contextlib.ExitStack() as stack:
            simulation = _simulation(options, stack)
            recorder = stack.enter_context(bag.Recorder(options.record)) if options.record else None
            node = Node(
                simulation,
                transport,
                lockstep=options.lockstep,
                failsafe=failsafe,
                speed=options.speed,
                camera=camera,
                recorder=recorder,
                warn=print_warning,
            )
            failed = until_interrupted(lambda: node.run(options.duration), PeerLost)
        _print(options, vars(node.flown) | {"simulated_s": simulation.ns / 1e9})
    return print_error(*failed) if failed else 0


def _print(options: argparse.Namespace, report: dict[str, Any]) -> None:
    print_results(options, report, listed({name.replace("_s", " (s)"): x for name, x in report.items()}))


def _simulation(options: argparse.Namespace, stack: contextlib.ExitStack) -> Simulation:
    """Team in hover, side by side."""
    n, hz = options.drones, options.control_hz
    params = repeat(load_params(options.vehicle), n)
    state = State.at_rest([[0.0, _SPACING * (i - (n - 1) / 2), options.height] for i in range(n)])
    substeps = math.ceil(PHYSICS_HZ / hz)
    dt = 1 / (hz * substeps)
    if options.backend == "explicit":
        pairs = (drone_contact,) if n > 1 else ()
        step: Any = make_step((ground_contact,), pairs, dt=dt, substeps=substeps)
    else:
        from jaxdrones.engine import bullet  # optional

        step = stack.enter_context(bullet.make_step(dt=dt, substeps=substeps))
    return Simulation(step, params, state, hz, controller=options.controller)


def _camera(options: argparse.Namespace) -> Camera | None:
    if options.camera is None:
        if options.camera_hz != _CAMERA_HZ:
            raise UserError(f"--camera-hz {options.camera_hz:g} is given without --camera; give both or none")
        return None
    return Camera(resolution=parse_pixels("--camera", options.camera, "64x48"), rate=options.camera_hz)


def _replay(parser: argparse.ArgumentParser, options: argparse.Namespace) -> int:
    for name in vars(options):
        if name not in _OF_REPLAY and getattr(options, name) != parser.get_default(name):
            raise UserError(f"--{name.replace('_', '-')} is an option of flights; leave it out of `replay`")
    with contextlib.closing(join()) as transport:
        report = _published(options, transport)
    _print(options, report)
    return 0


def _published(options: argparse.Namespace, transport: topics.Transport) -> dict[str, Any]:
    known = {**topics.OUTPUTS, **topics.COMMANDS}
    publishers: dict[str, Any] = {}
    begin, published, ns = time.monotonic(), 0, 0
    first: int | None = None
    for name, ns, message in bag.read(options.bag):
        first = ns if first is None else first
        if name not in publishers:
            qos = known.get(name.partition("/")[2], (None, topics.CLOCK.qos))[1]
            publishers[name] = transport.publisher(topics.Topic(name, message.NAME, qos))
        while (left := begin + (ns - first) / 1e9 / options.speed - time.monotonic()) > 0:
            transport.spin(left)
        publishers[name](message)
        published += 1
    transport.flush(2.0)
    return {"published": published, "simulated_s": (ns - (first or 0)) / 1e9}

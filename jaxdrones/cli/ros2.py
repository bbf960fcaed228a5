"""`jaxdrones ros2`."""

import argparse
import contextlib
import functools
import math
import time
from typing import Any

from jaxdrones.arguments import choice, number, whole
from jaxdrones.cli.common import folder, print_error, print_warning, until_interrupted
from jaxdrones.cli.options import add_backend, add_drones, add_vehicle, parse_pixels
from jaxdrones.cli.report import listed, print_results
from jaxdrones.dynamics.contact import drone_contact, ground_contact
from jaxdrones.engine.explicit import make_step
from jaxdrones.errors import UserError
from jaxdrones.flights.conditions import BACKENDS, PHYSICS_HZ
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
_MAX_HZ = 20_000
_OF_REPLAY = ("bag", "speed", "json", "run", "ranges", "debug")


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser("ros2", help="simulate a team with ROS 2 topics")
    team = parser.add_argument_group("team")
    add_drones(team, 1)
    add_vehicle(team, "cf2x")
    add_backend(team)
    team.add_argument(
        "--controller", metavar="NAME", help=f"of positions, velocities: {', '.join(CONTROLLERS)} (the vehicle's)"
    )
    team.add_argument("--control-hz", type=int, default=100, metavar="HZ", help="control and message rate (100)")
    team.add_argument("--height", type=float, default=1.0, metavar="M", help="initial height, m (1)")
    watch = parser.add_argument_group("clock and failsafe")
    wire = parser.add_argument_group("messages")
    pace = watch.add_mutually_exclusive_group()
    pace.add_argument("--lockstep", action="store_true", help="one step for each call of the service /step")
    pace.add_argument("--real-time", action="store_true", help="follow the clock (default)")
    watch.add_argument("--speed", type=float, default=1.0, metavar="X", help="real-time factor (1)")
    watch.add_argument("--duration", type=float, metavar="S", help="simulated time, s (until Ctrl-C)")
    wire.add_argument("--camera", metavar="WxH", help="resolution of a camera on every drone, pixels (none)")
    wire.add_argument("--camera-hz", type=float, default=10.0, metavar="HZ", help="images per second (10)")
    watch.add_argument(
        "--timeout", type=float, default=1.0, metavar="S", help="seconds without a command before the failsafe acts (1)"
    )
    watch.add_argument(
        "--wait", type=float, default=30.0, metavar="S", help="the same timeout before the first command (30)"
    )
    watch.add_argument("--failsafe", default="hover", metavar="NAME", help=f"{', '.join(ACTIONS)} (hover)")
    wire.add_argument("--record", type=folder, metavar="BAG", help="write all messages to this new folder, as MCAP")
    numbers = dict(drones=whole(), speed=number(above=0), duration=number("s", at_least=0), height=number("m", above=0))
    names = dict(backend=choice("backend", BACKENDS), controller=choice("controller", CONTROLLERS))
    ranges = numbers | names | dict(control_hz=whole("control rate (Hz)", limit=_MAX_HZ))
    parser.set_defaults(run=_run, ranges=ranges)
    commands = parser.add_subparsers(metavar="[replay]", title="commands")
    replay = commands.add_parser("replay", help="publish the messages of a bag")
    replay.add_argument("bag", type=folder, metavar="BAG", help="folder of a bag; nothing is simulated")
    replay.add_argument("--speed", type=float, default=1.0, metavar="X", help="real-time factor (1)")
    for name in ("--json", "--debug"):  # as before `replay`
        replay.add_argument(name, action="store_true", default=argparse.SUPPRESS, help=argparse.SUPPRESS)
    replay.set_defaults(run=functools.partial(_replay, parser), ranges=dict(speed=number(above=0)))


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

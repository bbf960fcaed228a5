"""`jaxdrones demo`."""

import argparse
import shlex
import webbrowser
from pathlib import Path

from jaxdrones import assets
from jaxdrones.checks import look_up
from jaxdrones.cli import fly
from jaxdrones.cli.common import check_writable, folder
from jaxdrones.cli.live import add_live
from jaxdrones.cli.options import add_drones, add_output
from jaxdrones.cli.policies import open_policy
from jaxdrones.cli.report import print_results
from jaxdrones.errors import UserError
from jaxdrones.visualization.viewer.gallery import Exhibit, gallery, read_exhibits
from jaxdrones.writing import write

_FIRST = "forest"
_SIMULATED = ("fly it yourself", "fly twenty")  # in the page, listed after the first flight


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "demo",
        help="open a page of flights by bundled policies",
        description="Open a page in the browser that plays recorded flights of the bundled policies: through a forest, "
        "through gates, in a crowd, and others. One drone is simulated in the page, in another flight twenty; push "
        "them. It needs no network.",
        epilog="`jaxdrones demo forest --live` flies one of them now, `jaxdrones eval forest` evaluates its policy.",
    )
    parser.add_argument("flight", nargs="?", default=_FIRST, metavar="FLIGHT", help=f"flight to show first ({_FIRST})")
    parser.add_argument(
        "--policy",
        type=folder,
        metavar="RUN",
        help="simulate --drones drones with this policy first: a run of hover for one drone; needs casadi",
    )
    add_drones(parser, 1)
    add_live(parser, "fly FLIGHT now, in place of the page, and show it in the browser in real time")
    add_output(parser, "path of the page (runs/demo.html)", metavar="FILE")
    parser.add_argument("--no-open", action="store_true", help="write the page and do not open it")
    parser.set_defaults(run=_demo)


def _demo(options: argparse.Namespace) -> int:
    exhibits = {exhibit.name: exhibit for exhibit in read_exhibits(assets.folder() / "demo")}
    flight = look_up("flight", options.flight, exhibits)
    if options.drones != 1 and options.policy is None:
        raise UserError(f"--drones {options.drones} is given without --policy; 'fly twenty' simulates twenty drones")
    if options.live is not None:
        return _fly(flight, options)
    if options.policy is not None:
        flight = _own(options.policy, options.drones)
    output = options.output or Path("runs") / "demo.html"
    check_writable(output)
    exhibits = dict(sorted(exhibits.items(), key=lambda named: named[0] not in _SIMULATED))
    exhibits = {flight.name: flight} | exhibits
    write(output, gallery(list(exhibits.values())).encode())
    size = f"{output.stat().st_size / 1e6:.1f} MB"
    print_results(options, {"flights": [*exhibits], "files": [str(output)]}, f"wrote {output} ({size})")
    if not options.no_open and not webbrowser.open(output.absolute().as_uri()):
        print("no browser was found; open the page in one")
    return 0


def _fly(exhibit: Exhibit, options: argparse.Namespace) -> int:
    """Fly the flight of a bundled policy by its command."""
    words = shlex.split(exhibit.command)
    if words[1] != "fly":
        raise UserError(f"no bundled policy flies {exhibit.name!r}; give --live with forest, for example")
    if options.policy is not None or options.output is not None:
        raise UserError("--live flies a bundled policy and writes no page; leave out --policy and --output")
    commands = argparse.ArgumentParser().add_subparsers()
    fly.add(commands)
    flight = commands.choices["fly"].parse_args([*words[2:], *([str(options.live)] if options.live else [])])
    flight.json = options.json
    return flight.run(flight)


def _own(policy: Path, drones: int) -> Exhibit:
    from jaxdrones.export import simulation  # needs casadi

    run = open_policy(policy, None, False, {})
    with run.recipe().env() as env:
        page = simulation.page(run.policy(env=env), env, str(policy), drones)
    about = f"Simulated in this page, and flown by the policy of {policy}. Push it."
    return Exhibit(str(policy), about, f"jaxdrones fly --policy {policy} --live", page.payload)

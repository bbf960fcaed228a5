"""`jaxdrones demo`."""

import argparse
import shlex
import webbrowser
from pathlib import Path

from jaxdrones import assets
from jaxdrones.checks import look_up
from jaxdrones.cli import fly
from jaxdrones.cli.common import check_writable, folder, print_warning
from jaxdrones.cli.live import add_live
from jaxdrones.cli.options import add_drones, add_output, add_set, add_task, option, switch
from jaxdrones.cli.policies import is_user_policy, open_policy
from jaxdrones.cli.report import print_results
from jaxdrones.cli.settings import parse_settings
from jaxdrones.errors import UserError
from jaxdrones.visualization.viewer.page import Exhibit, gallery, read_exhibits
from jaxdrones.writing import write

_FIRST = "forest"
_NEXT = ("fly it yourself", "fly twenty", "gates", "race", "recovery", "swap-goals", "thousand drones", "real flight")
"""Flights that are listed after the first, in this order; the others follow by name."""


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "demo",
        help="open a page of flights by bundled policies",
        description="Open a page in the browser that plays recorded flights of the bundled policies: through a forest, "
        "through gates, in a crowd, and others. It also simulates one or twenty drones interactively. It needs no "
        "network.",
        epilog="`jaxdrones demo forest --live` simulates a new flight, `jaxdrones eval forest` evaluates its policy.",
    )
    option(parser, "flight FLIGHT", "flight to show first", default=_FIRST, nargs="?")
    option(
        parser,
        "--policy RUN",
        "policy of the interactive simulation of --drones drones: a run of hover for one drone; or file.py:name, "
        "whose code is executed; needs casadi",
        folder,
    )
    add_task(parser, "with file.py:name: task (hover), as for `jaxdrones train`")
    add_set(parser, "with file.py:name: option of the environment (action, observation, ...)")
    add_drones(parser, 1)
    add_live(parser, "instead of the page, simulate FLIGHT and show it in the browser in real time")
    add_output(parser, "path of the page (runs/demo.html)", metavar="FILE")
    switch(parser, "--no-open", "write the page and do not open it")
    parser.set_defaults(run=_demo)


def _demo(options: argparse.Namespace) -> int:
    exhibits = {exhibit.name: exhibit for exhibit in read_exhibits(assets.folder() / "demo")}
    flight = look_up("flight", options.flight, exhibits)
    if options.drones != 1 and options.policy is None:
        raise UserError(f"--drones {options.drones} is given without --policy; 'fly twenty' simulates twenty drones")
    if (options.task or options.set) and not (options.policy and is_user_policy(options.policy)):
        raise UserError("--task or --set is given without --policy file.py:name; leave it out, or give both")
    if options.live is not None:
        return _fly(flight, options)
    if options.policy is not None:
        flight = _own(options)
    output = options.output or Path("runs") / "demo.html"
    check_writable(output)
    order = {name: place for place, name in enumerate(_NEXT)}
    exhibits = dict(sorted(exhibits.items(), key=lambda named: order.get(named[0], len(order))))
    exhibits = {flight.name: flight} | exhibits
    write(output, gallery(list(exhibits.values())).encode())
    size = f"{output.stat().st_size / 1e6:.1f} MB"
    print_results(options, {"flights": [*exhibits], "files": [str(output)]}, f"wrote {output} ({size})")
    if not options.no_open and not webbrowser.open(output.absolute().as_uri()):
        print_warning("no browser was found; open the page in one")
    return 0


def _fly(exhibit: Exhibit, options: argparse.Namespace) -> int:
    words = shlex.split(exhibit.command)
    if words[1] != "fly":
        raise UserError(f"{exhibit.name!r} has no bundled policy for --live; give another flight, for example forest")
    if options.policy is not None or options.output is not None:
        raise UserError("--live flies a bundled policy and writes no page; leave out --policy and --output")
    commands = argparse.ArgumentParser().add_subparsers()
    fly.add(commands)
    flight = commands.choices["fly"].parse_args([*words[2:], *([str(options.live)] if options.live else [])])
    flight.json = options.json
    return flight.run(flight)


def _own(options: argparse.Namespace) -> Exhibit:
    """Drones that the page simulates with the policy of a user."""
    from jaxdrones.export import simulation  # needs casadi

    policy, own = options.policy, is_user_policy(options.policy)
    task = (options.task or "hover") if own else None
    run = open_policy(policy, task, False, parse_settings(options.set))
    words = ["jaxdrones", "fly", "--policy", str(policy), *(["--task", task] if task else [])]
    command = shlex.join([*words, *(word for x in options.set for word in ("--set", x)), "--live"])
    with run.recipe().env() as env:
        try:
            page = simulation.page(run.policy(env=env), env, str(policy), options.drones)
        except NotImplementedError as error:
            raise UserError(f"{policy} cannot be simulated in a page: {error}; `{command}` flies it") from None
    about = f"Simulated in this page, and flown by the policy {'' if own else 'of '}{policy}. Push it."
    return Exhibit(str(policy), about, command, page.payload)

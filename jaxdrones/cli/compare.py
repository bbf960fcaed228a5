"""`jaxdrones compare`."""

import argparse

from jaxdrones.checks import check_choice
from jaxdrones.cli.common import as_json, table
from jaxdrones.cli.flight_options import add_conditions, fly_options, warn
from jaxdrones.flights.conditions import BACKENDS
from jaxdrones.flights.examples import FLIGHTS
from jaxdrones.flights.record import divergence


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "compare",
        help="fly an example on both backends and print how they diverge",
        description="Fly an example on two backends from the same start and print their divergence over time.",
        allow_abbrev=False,
    )
    parser.add_argument("flight", metavar="FLIGHT", help=", ".join(FLIGHTS))
    add_conditions(parser)
    parser.add_argument("--backends", default="explicit,bullet", metavar="A,B", help="two of " + ", ".join(BACKENDS))
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else on stdout")
    parser.set_defaults(run=_compare)


def _compare(options: argparse.Namespace) -> int:
    names = [name.strip() for name in options.backends.split(",")]
    if len(set(names)) != 2 or len(names) != 2:
        raise ValueError(f"--backends is {options.backends!r}; give two different ones, for example explicit,bullet")
    for name in names:
        check_choice("backend", name, BACKENDS)
    first, second = records = [fly_options(options, backend=name) for name in names]
    rows = divergence(first, second)
    diverged = {name: record.diverged() for name, record in zip(names, records, strict=True)}
    if options.json:
        print(as_json({"flight": options.flight, "backends": names, "divergence": rows, "diverged": diverged}))
    else:
        print(f"{options.flight}: {names[0]} against {names[1]}, largest difference over the drones")
        print(table(rows))
    return warn(diverged[names[0]] or diverged[names[1]])

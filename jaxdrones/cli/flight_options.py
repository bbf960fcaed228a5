"""Options of `jaxdrones fly` and `jaxdrones compare` for the conditions of a flight."""

import argparse
import contextlib
from typing import Any

from jaxdrones.arguments import seed
from jaxdrones.cli.common import bar, print_error
from jaxdrones.cli.options import add_drones, add_vehicle, option, split_names
from jaxdrones.dynamics import EFFECTS, INTEGRATORS, PAIRS, ROTORS
from jaxdrones.errors import UserError
from jaxdrones.flights.conditions import CONTROLLERS, Conditions
from jaxdrones.flights.controllers import module_of
from jaxdrones.flights.fly import fly
from jaxdrones.flights.log import FlightLog
from jaxdrones.urdf import load_params
from jaxdrones.user_code import is_reference

CONDITIONS = ("effects", "controller", "feedforward", "control_hz", "duration", "rotors", "integrator")
"""Options of an example; with a policy they are those of its task."""


def add_conditions(parser: argparse.ArgumentParser) -> None:
    """Add the options of a flight."""
    group = parser.add_argument_group("flight")
    add_drones(group)
    add_vehicle(group, "cf2x")
    option(group, "--effects A,B", f"{', '.join(EFFECTS | PAIRS)}, or none")
    option(group, "--controller NAME|FILE", "{}, or your own in a .py file (the vehicle's own)", known=CONTROLLERS)
    group.add_argument(
        "--feedforward",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="feed velocity and acceleration of the target to the controller (yes; for pid only in a comparison of "
        "controllers)",
    )
    option(group, "--control-hz HZ", "control rate; physics runs at 240 Hz or above", int)
    option(group, "--duration S", "simulated time, s", float)
    option(group, "--rotors NAME", "{}", default="instant", known=ROTORS)
    option(group, "--integrator NAME", "{}", default="semi_implicit_euler", known=INTEGRATORS)
    option(group, "--seed K", "seed of a random start, 1 cm standard deviation, or of an episode", int, check=seed)


def fly_options(options: argparse.Namespace, **more: Any) -> FlightLog:
    """Fly with the options of the command line, `more` arguments of `fly`, and a progress bar; return the log."""
    with progress() as report:
        return fly(options.flight, progress=report, **_conditions(options), **more)


def check_conditions(options: argparse.Namespace, **more) -> None:
    """Raise `ValueError` for invalid options of a flight."""
    conditions = Conditions(options.flight, **_conditions(options), **more)
    load_params(conditions.vehicle)
    if is_reference(controller := str(conditions.controller)):
        module_of(controller)


def _conditions(options: argparse.Namespace) -> dict[str, Any]:
    given = {name: getattr(options, name) for name in ("vehicle", "drones", "seed", *CONDITIONS)}
    effects = None if options.effects is None else split_names(options.effects)
    if effects is not None and len(effects) > 1 and "none" in effects:
        raise UserError(f"--effects is {options.effects!r}; give none alone, or leave it out")
    return given | {"effects": [] if effects == ["none"] else effects}


def warn(diverged: dict[str, str], name: str = "") -> int:
    """Write a warning for a diverged flight, one of several with a name, to stderr; return the exit code."""
    if not diverged:
        return 0
    others = f" (and {len(diverged) - 1} more)" if len(diverged) > 1 else ""
    flight = f"the flight of {name}" if name else "the flight"
    what = f"{flight} diverged: {next(iter(diverged.values()))}{others}"
    return print_error(f"{what}; try a higher --control-hz, another --controller, or fewer --effects", 1)


@contextlib.contextmanager
def progress(what: str = "flying"):
    """Progress bar as a function of the completed fraction; `None` without tqdm, silent without a terminal."""
    with bar(100, what, "%") as shown:
        yield None if shown is None else lambda share: shown.update(round(100 * share) - shown.n)

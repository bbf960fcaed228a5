"""`jaxdrones list`."""

import argparse

from jaxdrones import assets
from jaxdrones.cli.report import print_results
from jaxdrones.dynamics import EFFECTS, INTEGRATORS, PAIRS, ROTORS
from jaxdrones.envs import ACTIONS, OBSERVATIONS, TASKS
from jaxdrones.flights.conditions import BACKENDS, CONTROLLERS
from jaxdrones.flights.examples import FLIGHTS
from jaxdrones.learning.policies import POLICIES
from jaxdrones.training.algorithms import ALGORITHMS


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser("list", help="print the names of vehicles, effects, tasks, actions, ...")
    parser.set_defaults(run=_list)


def _list(options: argparse.Namespace) -> int:
    names = {
        "flights": list(FLIGHTS),
        "vehicles": list(assets.vehicles()),
        "effects": list(EFFECTS | PAIRS),
        "controllers": list(CONTROLLERS),
        "rotors": list(ROTORS),
        "integrators": list(INTEGRATORS),
        "backends": list(BACKENDS),
        "tasks": list(TASKS),
        "actions": list(ACTIONS),
        "observations": list(OBSERVATIONS),
        "algorithms": list(ALGORITHMS),
        "policies": [*assets.policies(), *POLICIES],
    }
    print_results(options, names, *(f"{kind:12} {', '.join(known)}" for kind, known in names.items()))
    return 0

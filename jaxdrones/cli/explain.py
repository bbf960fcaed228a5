"""`jaxdrones explain`."""

import argparse

from jaxdrones import assets
from jaxdrones.cli.report import as_json
from jaxdrones.cli.settings import add_realistic, asked_settings, user_mistakes
from jaxdrones.envs import TASKS, explain, make
from jaxdrones.flights.conditions import BACKENDS


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "explain",
        help="what every number of a task's observation and action is, its rewards, ends and physics",
        description="Print what every number of the observation and action of an environment is (name, unit, frame, "
        "range, what -1, 0 and 1 stand for), what is rewarded, when an episode ends, and what is simulated.",
        allow_abbrev=False,
    )
    parser.add_argument("task", metavar="TASK", help=f"{', '.join(TASKS)}, or file.py:function")
    parser.add_argument("--vehicle", help=f"{', '.join(assets.vehicles())} or a .urdf file (cf2x)")
    parser.add_argument("--backend", default="explicit", help=f"{', '.join(BACKENDS)} (explicit)")
    add_realistic(parser)
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="option of the environment (vehicle, action, observation, drones, period, ...)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=_explain)


def _explain(options: argparse.Namespace) -> int:
    settings = asked_settings(options)
    with (
        user_mistakes(settings, options.task),
        make(options.task, backend=options.backend, realistic=options.realistic, **settings) as env,
    ):
        explanation = explain(env)
    print(as_json(explanation.as_dict()) if options.json else explanation)
    return 0

"""`jaxdrones explain`."""

import argparse

from jaxdrones.cli.options import add_backend, add_drones, add_set, add_vehicle, option
from jaxdrones.cli.report import print_results
from jaxdrones.cli.settings import add_realistic, given_settings, user_mistakes
from jaxdrones.envs import TASKS, explain, make


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "explain",
        help="describe the observation, action, rewards, terminations and physics of a task",
        description="Print a table of every entry of observation and action (name, unit, frame, range, meaning of -1, "
        "0 and 1), the rewards, the terminations, and the simulation of an environment.",
    )
    option(parser, "task TASK", "{}, or file.py:function", known=TASKS)
    add_drones(parser)
    add_vehicle(parser)
    add_realistic(parser)
    add_backend(parser)
    add_set(parser, "option of the environment (action, observation, period, ...)")
    parser.set_defaults(run=_explain)


def _explain(options: argparse.Namespace) -> int:
    settings = given_settings(options)
    with (
        user_mistakes(settings, options.task),
        make(options.task, backend=options.backend, realistic=options.realistic, **settings) as env,
    ):
        explanation = explain(env)
    print_results(options, explanation.as_dict(), explanation)
    return 0

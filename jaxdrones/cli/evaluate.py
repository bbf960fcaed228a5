"""`jaxdrones eval`."""

import argparse
import math
from typing import Any

import jax

from jaxdrones import arguments
from jaxdrones.arguments import number
from jaxdrones.cli.common import DIVERGED, print_error
from jaxdrones.cli.options import add_backend, add_drones, option, switch
from jaxdrones.cli.policies import add_policy, open_policy, policy_of, team_of_run
from jaxdrones.cli.report import evaluation_table, percent, print_results
from jaxdrones.cli.settings import given_settings
from jaxdrones.errors import UserError
from jaxdrones.learning import evaluate
from jaxdrones.training.run import report_as_dict

_FIRST_SEED = 1_000_000  # distinct from the seeds of trainings


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "eval",
        help="evaluate a trained policy over many episodes",
        description="Fly many episodes with the best policy of a run, your own policy (file.py:name), or a policy for "
        "all vehicles. Print the success rate with its 95 % interval over distinct episodes, errors, and terminations.",
    )
    add_policy(parser, "any-vehicle or raptor; ")
    evaluation = parser.add_argument_group("evaluation")
    add_drones(evaluation)
    add_backend(evaluation)
    option(evaluation, "--episodes N", "number of episodes", int, 1000, check=arguments.count)
    option(evaluation, "--seed K", "seed of starts and noise", int, 0, check=arguments.seed)
    rate = number(name="fail-below", above=0, at_most=1)
    option(evaluation, "--fail-below RATE", "exit code 1 if the success rate is lower, such as 0.9", float, check=rate)
    switch(evaluation, "--last", "evaluate the newest policy instead of the best")
    parser.set_defaults(run=_evaluate)


def _evaluate(options: argparse.Namespace) -> int:
    settings = given_settings(options)
    team = team_of_run(options, settings)
    run = open_policy(options.policy, options.task, options.realistic, settings, options.last)
    recipe, title, make_policy, place = policy_of(run, options)
    about: dict[str, Any] = {"run": str(options.policy), "seed": options.seed, "backend": options.backend, **place}
    title += f", on the {options.backend} backend" * (options.backend != "explicit")
    key = jax.random.key(_FIRST_SEED + options.seed)
    with recipe.env(backend=options.backend, **team) as env:
        if options.fail_below is not None and env.task.success is None:
            raise UserError(
                f"--fail-below {options.fail_below:g} is given, and the task has no criterion of success; leave it out"
            )
        report = report_as_dict(evaluate(env, make_policy(env), key, options.episodes))
    print_results(options, about | {"recipe": recipe.as_dict(), "evaluation": report}, title, evaluation_table(report))
    if not math.isfinite(report["mean_return"]):
        what = "the mean return is not finite, so actions, states or rewards are not"
        return print_error(f"{what}; call the policy with an observation, and test the task by check_env", DIVERGED)
    if options.fail_below is not None and report["success"] < options.fail_below:
        rate = percent(report["success"], report["trials"])
        return print_error(f"the success rate is {rate}, below --fail-below {options.fail_below:g}", DIVERGED)
    return 0

"""`jaxdrones eval`."""

import argparse
import functools
import math
from typing import Any

from jaxdrones.checks import check_choice
from jaxdrones.cli.common import as_json, folder
from jaxdrones.cli.policies import is_user_policy, open_policy
from jaxdrones.cli.settings import add_realistic, asked_settings
from jaxdrones.flights.conditions import BACKENDS
from jaxdrones.training.presets import realism

_FIRST_SEED = 1_000_000  # so that episodes differ from those of the training


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "eval",
        help="evaluate a trained policy over many episodes",
        description="Fly many episodes with the best policy of a run, or with a policy of your own (file.py:name). "
        "Prints the success rate with its 95 % interval, which counts repetitions of a flight once, errors, and how "
        "episodes ended.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "policy",
        type=folder,
        metavar="RUN",
        help="folder of `jaxdrones train`, for example runs/hover; or file.py:name, whose code is executed",
    )
    parser.add_argument("--task", metavar="TASK", help="with file.py:name: the task to fly, as for `jaxdrones train`")
    add_realistic(parser, "with file.py:name: ")
    parser.add_argument("--vehicle", help="with file.py:name: a bundled vehicle or a .urdf file (cf2x)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="with file.py:name: option of the environment (action, observation, drones, ...)",
    )
    parser.add_argument("--backend", default="explicit", help=f"{', '.join(BACKENDS)} (explicit)")
    parser.add_argument("--episodes", type=int, default=1000, metavar="N", help="number of episodes (1000)")
    parser.add_argument("--seed", type=int, default=0, metavar="K", help="seed of starts and noise (0)")
    parser.add_argument("--last", action="store_true", help="evaluate the newest policy instead of the best")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else on stdout")
    parser.set_defaults(run=_evaluate)


def _evaluate(options: argparse.Namespace) -> int:
    import jax

    from jaxdrones.learning import evaluate
    from jaxdrones.limits import LARGEST_COUNT, check_at_most, check_seed
    from jaxdrones.training.run import report_as_dict

    check_at_most("episodes", options.episodes, LARGEST_COUNT)
    check_seed("seed", options.seed)
    check_choice("backend", options.backend, BACKENDS)
    run = open_policy(options.policy, options.task, options.realistic, asked_settings(options), options.last)
    about: dict[str, Any] = {"run": str(options.policy), "seed": options.seed, "backend": options.backend}
    if is_user_policy(options.policy):
        recipe, make_policy = run.recipe(), run.policy
        title = described(recipe)
    else:
        name = "last" if options.last else "best"
        recipe, update = run.recipe(name), run.sidecar_entry(name, "update")
        make_policy = functools.partial(run.policy, name)
        title = f"{described(recipe)}: policy of update {update}"
        about |= {"policy": name, "update": update}
    title += f", on the {options.backend} backend" * (options.backend != "explicit")
    key = jax.random.key(_FIRST_SEED + options.seed)
    with recipe.env(backend=options.backend) as env:
        report = report_as_dict(evaluate(env, make_policy(env), key, options.episodes))
    if options.json:
        print(as_json(about | {"recipe": recipe.as_dict(), "evaluation": report}))
    else:
        print(title)
        print(evaluation_table(report))
    return 0


def described(recipe) -> str:
    """The task, the learner and the options that differ from their defaults, such as `hover by bptt`."""
    options = "".join(f", {name} {x}" for name, x in recipe.options.items())
    return f"{recipe.task} by {recipe.algorithm}{realism(recipe.realistic)}{options}"


def evaluation_table(report: dict) -> str:
    """The entries of `report_as_dict` as lines of text."""
    episodes, error = report["episodes"], report["final_error_percentiles"]
    ends = ", ".join(f"{name} {percent(share, episodes)}" for name, share in report["end_rates"].items()) or "none"
    others = ", ".join(f"{name} {x:.3g}" for name, x in report["final_metrics"].items() if name not in ("error",))
    rows = [
        ["episodes", f"{_counted(report)}, {report['mean_length']:.2f} s long on average"],
        ["success", success(report)],
        [
            "final error",
            f"median {_length(error['50'])}, 95 % {_length(error['95'])}, 99 % {_length(error['99'])}",
        ],
        ["rms error", f"{_length(report['rms_error'])} over the last four fifths"],
        ["return", f"{report['mean_return']:.2f}"],
        ["ended early", ends],
        ["final metrics", others],
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"  {name.ljust(width)}  {text}" for name, text in rows if text)


def success(report: dict) -> str:
    """Success rate, count and interval, such as `99.99 %, 9,999 of 10,000, 95 % interval 99.943 to 99.998 %`."""
    if report["success"] is None:
        return "the task has no criterion"
    episodes, interval = report["episodes"], report["success_interval"]
    rate = f"{percent(report['success'], episodes)}, {round(report['success'] * episodes):,} of {episodes:,}"
    if interval is None:
        return f"{rate}, no interval of one distinct episode"
    low, high = (100 * x for x in interval)
    digits = _digits(episodes) + 1
    return f"{rate}, 95 % interval {low:.{digits}f} to {high:.{digits}f} %"


def _counted(report: dict) -> str:
    """The number of episodes, and of distinct ones if some are repetitions."""
    episodes, distinct = report["episodes"], report["distinct_episodes"]
    if distinct == episodes:
        return f"{episodes:,}"
    repeated = "deterministic: 1 distinct episode" if distinct == 1 else f"{distinct:,} of them distinct"
    return f"{episodes:,}, {repeated}"


def percent(share: float, episodes: int) -> str:
    """A fraction of the episodes in percent, with enough digits to tell all of them from all but one."""
    return f"{100 * share:.{_digits(episodes)}f} %"


def _digits(episodes: int) -> int:
    """Decimals of a percentage with which one episode is at least one unit of the last digit."""
    return max(1, math.ceil(math.log10(episodes)) - 2)


def _length(x: float) -> str:
    return f"{100 * x:.2f} cm" if x < 1 else f"{x:.2f} m"

"""`jaxdrones eval`."""

import argparse
import math

from jaxdrones.cli.common import as_json, folder


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "eval",
        help="evaluate a trained policy over many episodes",
        description="Fly the best policy of a run for many episodes: success with its 95 % interval, errors, ends.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "policy", type=folder, metavar="RUN", help="folder of `jaxdrones train`, for example runs/hover"
    )
    parser.add_argument("--episodes", type=int, default=1000, metavar="N", help="(1000)")
    parser.add_argument("--seed", type=int, default=0, metavar="K", help="of starts and noise (0)")
    parser.add_argument("--last", action="store_true", help="the newest policy in place of the best")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else on stdout")
    parser.set_defaults(run=_evaluate)


def _evaluate(options: argparse.Namespace) -> int:
    import jax

    from jaxdrones.learning import evaluate
    from jaxdrones.limits import LARGEST_COUNT, check_at_most, check_seed
    from jaxdrones.training.runs import as_dict, run_in

    check_at_most("episodes", options.episodes, LARGEST_COUNT)
    check_seed("seed", options.seed)
    run, name = run_in(options.policy), "last" if options.last else "best"
    recipe, update = run.recipe(name), run.told(name, "update")
    env = recipe.env()
    report = as_dict(evaluate(env, run.policy(name, env), jax.random.key(1_000_000 + options.seed), options.episodes))
    if options.json:
        kept = {"run": str(options.policy), "policy": name, "update": update, "seed": options.seed}
        print(as_json(kept | {"recipe": recipe.as_dict(), "evaluation": report}))
    else:
        print(f"{described(recipe)}: policy of update {update}")
        print(evaluation_table(report))
    return 0


def described(recipe) -> str:
    """`hover by bptt`, with what was changed."""
    options = "".join(f", {name} {x}" for name, x in recipe.options.items())
    return f"{recipe.task} by {recipe.learner}{', realistic' * recipe.realistic}{options}"


def evaluation_table(report: dict) -> str:
    """What `runs.as_dict` made of an evaluation, in lines."""
    episodes, error = report["episodes"], report["error_percentiles"]
    ends = ", ".join(f"{name} {percent(share, episodes)}" for name, share in report["ends"].items()) or "none"
    others = ", ".join(f"{name} {x:.3g}" for name, x in report["metrics"].items() if name not in ("error",))
    rows = [
        ["episodes", f"{episodes:,}, {report['length']:.2f} s long on average"],
        ["success", success(report)],
        [
            "error in the end",
            f"median {_length(error['50'])}, 95 % {_length(error['95'])}, 99 % {_length(error['99'])}",
        ],
        ["rms error", f"{_length(report['rms_error'])} over the last four fifths"],
        ["return", f"{report['returned']:.2f}"],
        ["ended early", ends],
        ["in the end", others],
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"  {name.ljust(width)}  {text}" for name, text in rows if text)


def success(report: dict) -> str:
    """Share, count and interval, such as `99.99 %, 9,999 of 10,000, 95 % interval 99.943 to 99.998 %`."""
    episodes = report["episodes"]
    low, high = (100 * x for x in report["interval"])
    digits = _digits(episodes) + 1
    count = f"{round(report['success'] * episodes):,} of {episodes:,}"
    return f"{percent(report['success'], episodes)}, {count}, 95 % interval {low:.{digits}f} to {high:.{digits}f} %"


def percent(share: float, episodes: int) -> str:
    """A share of the episodes, with so many digits that all but one of them do not read as all."""
    return f"{100 * share:.{_digits(episodes)}f} %"


def _digits(episodes: int) -> int:
    """After the point of a percentage: one episode is at least one unit of the last digit."""
    return max(1, math.ceil(math.log10(episodes)) - 2)


def _length(x: float) -> str:
    return f"{100 * x:.2f} cm" if x < 1 else f"{x:.2f} m"

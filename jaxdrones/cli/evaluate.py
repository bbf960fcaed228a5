"""`jaxdrones eval`."""

import argparse
import json
from pathlib import Path


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "eval",
        help="evaluate a trained policy over many episodes",
        description="Fly the best policy of a run for many episodes: success with its 95 % interval, errors, ends.",
        allow_abbrev=False,
    )
    parser.add_argument("policy", type=Path, metavar="RUN", help="folder of `jaxdrones train`, for example runs/hover")
    parser.add_argument("--episodes", type=int, default=1000, metavar="N", help="(1000)")
    parser.add_argument("--seed", type=int, default=0, metavar="K", help="of starts and noise (0)")
    parser.add_argument("--last", action="store_true", help="the newest policy in place of the best")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else on stdout")
    parser.set_defaults(run=_evaluate)


def _evaluate(options: argparse.Namespace) -> int:
    import jax

    from jaxdrones.checks import check_whole
    from jaxdrones.learning import evaluate
    from jaxdrones.learning.runs import as_dict, run_in

    check_whole("episodes", options.episodes)
    run, name = run_in(options.policy), "last" if options.last else "best"
    recipe, about = run.recipe(), run.about(name)
    env = recipe.env()
    report = as_dict(evaluate(env, run.policy(name, env), jax.random.key(1_000_000 + options.seed), options.episodes))
    if options.json:
        kept = {"run": str(options.policy), "policy": name, "update": about["update"], "seed": options.seed}
        print(json.dumps(kept | {"recipe": recipe.as_dict(), "evaluation": report}))
    else:
        print(f"{described(recipe)}: policy of update {about['update']}")
        print(evaluation_table(report))
    return 0


def described(recipe) -> str:
    """`hover by bptt`, with what was changed."""
    options = "".join(f", {name} {x}" for name, x in recipe.options.items())
    return f"{recipe.task} by {recipe.learner}{', realistic' * recipe.realistic}{options}"


def evaluation_table(report: dict) -> str:
    """What `runs.as_dict` made of an evaluation, in lines."""
    low, high = report["interval"]
    error = report["error_percentiles"]
    ends = ", ".join(f"{name} {100 * share:.1f} %" for name, share in report["ends"].items()) or "none"
    others = ", ".join(f"{name} {x:.3g}" for name, x in report["metrics"].items() if name not in ("error",))
    rows = [
        ["episodes", f"{report['episodes']}, {report['length']:.2f} s long on average"],
        ["success", f"{100 * report['success']:.1f} %, 95 % interval {100 * low:.1f} to {100 * high:.1f} %"],
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


def _length(x: float) -> str:
    return f"{100 * x:.2f} cm" if x < 1 else f"{x:.2f} m"

"""Option --live of `jaxdrones fly` and `jaxdrones train`: a live view in the browser."""

import argparse
import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

import jax

from jaxdrones.cli.options import option
from jaxdrones.cli.report import percent
from jaxdrones.training.episode import fly_episode
from jaxdrones.visualization.viewer.live import Live

Progress = Callable[[int, dict[str, float]], None]

WAIT = 60.0
"""Wait of a flight for the first viewer, s."""


def add_live(parser: argparse._ActionsContainer, what: str) -> None:
    """Add --live, with an optional port; the default of 0 is any free port."""
    text = f"{what}; prints its local address (at a free PORT)"
    option(parser, "--live PORT", text, int, nargs="?", const=0)


@contextlib.contextmanager
def live_server(port: int | None, quiet: bool, title: str | None = None) -> Iterator[Live | None]:
    """Context with a server, or `None` without a port; prints the address, on stderr if `quiet`."""
    if port is None:
        yield None
        return

    def say(line: str) -> None:
        print(line, file=sys.stderr if quiet else sys.stdout, flush=True)

    with Live(port, title, WAIT, say) as live:
        say(f"open {live.url} in a browser on this machine")
        yield live


def show_training(live: Live, trainer: Any, run: Any, what: str, then: Progress) -> Progress:
    """Progress of a training that shows its curve and an episode of the newest policy after every evaluation.

    `what` is the title, and `then` receives the progress afterwards.
    """
    env, curve = trainer.env, []
    name = "success" if env.task.success is not None else "return"

    def update(count: int, now: dict[str, float]) -> None:
        if "evaluated_return" in now:
            score = now["success" if name == "success" else "evaluated_return"]
            curve.append((count, score))
            result = percent(score, trainer.episodes) if name == "success" else f"{score:.1f}"
            title = f"{what}, update {count} of {trainer.recipe.config.updates}: {name} {result}"
            live.show(fly_episode(env, run.policy("last", env), jax.random.key(0)), title, curve, name)
        then(count, now)

    return update

"""Option --live of `jaxdrones fly` and `jaxdrones train`: a live view in the browser."""

import argparse
import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

import jax

from jaxdrones.cli.report import percent
from jaxdrones.training.episode import fly_episode
from jaxdrones.visualization.viewer.live import Live

WAIT = 60.0
"""Wait of a flight for the first viewer, s."""


def add_live(parser: argparse._ActionsContainer, what: str) -> None:
    """Add --live, with an optional port; the default of 0 is any free port."""
    text = f"{what}; prints its local address (at a free PORT)"
    parser.add_argument("--live", type=int, nargs="?", const=0, metavar="PORT", help=text)


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


class LiveTraining:
    """Live view of a training: learning curve and an episode of the newest policy after every evaluation."""

    def __init__(self, live: Live, trainer: Any, run: Any, what: str, then: Callable[[int, dict[str, float]], None]):
        """Prepare, without a flight; `what` is the title, and `then` receives the progress afterwards."""
        self._live, self._trainer, self._run, self._what = live, trainer, run, what
        self._then = then
        self._name = "success" if trainer.env.task.success is not None else "return"
        self._curve: list[tuple[float, float]] = []

    def update(self, count: int, now: dict[str, float]) -> None:
        """Forward the progress; fly and show an episode after an evaluation."""
        if "evaluated_return" in now:
            self._show(count, now)
        self._then(count, now)

    def _show(self, count: int, now: dict[str, float]) -> None:
        env, score = self._trainer.env, now["success" if self._name == "success" else "evaluated_return"]
        self._curve.append((count, score))
        episode = fly_episode(env, self._run.policy("last", env), jax.random.key(0))
        result = percent(score, self._trainer.episodes) if self._name == "success" else f"{score:.1f}"
        title = f"{self._what}, update {count} of {self._trainer.recipe.config.updates}: {self._name} {result}"
        self._live.show(episode, title, self._curve, self._name)

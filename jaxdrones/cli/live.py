"""Option --live of `jaxdrones fly` and `jaxdrones train`: the browser shows what happens while it happens."""

import argparse
import contextlib
import sys
from collections.abc import Iterator

from jaxdrones.visualization.viewer.live import Live

WAIT = 60.0
"""How long a flight waits for the first viewer, s."""


def add_live(parser: argparse.ArgumentParser, what: str) -> None:
    """Add the option, which gives the port: 0, which is any free one, where it is given alone."""
    text = f"{what}; prints the address, which only this machine reaches (at a free PORT)"
    parser.add_argument("--live", type=int, nargs="?", const=0, metavar="PORT", help=text)


@contextlib.contextmanager
def live_server(options: argparse.Namespace, title: str | None = None) -> Iterator[Live | None]:
    """A context with a server whose address is printed; with `None` unless --live is given.

    Raises:
        ValueError: the port is taken.
    """
    if options.live is None:
        yield None
        return

    def say(line: str) -> None:
        print(line, file=sys.stderr if options.json else sys.stdout, flush=True)

    with Live(options.live, title, WAIT, say) as live:
        say(f"open {live.url} in a browser on this machine")
        yield live

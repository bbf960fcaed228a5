"""What `jaxdrones train` does to train on several hosts."""

import argparse
import contextlib
import functools
import io
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

HELP = (
    "All devices share the worlds. A CPU counts as N with XLA_FLAGS=--xla_force_host_platform_device_count=N.\n"
    "On several hosts start the same command on each, with another --host; host 0 writes the files, and a folder to\n"
    "--resume must be there for all:\n"
    "  jaxdrones train hover --hosts 2 --host 0 --coordinator 127.0.0.1:9911"
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Who the hosts are."""
    parser.add_argument("--hosts", type=int, metavar="N", help="processes that train together (1)")
    parser.add_argument("--host", type=int, metavar="I", help="which of them this is, from 0")
    parser.add_argument("--coordinator", metavar="ADDRESS:PORT", help="of host 0, a port that is free there")


def together(train: Callable[[argparse.Namespace], int]) -> Callable[[argparse.Namespace], int]:
    """The command on one host or several; all but the first write to a folder that is thrown away, and say nothing."""
    return functools.partial(_together, train)


def _together(train: Callable[[argparse.Namespace], int], options: argparse.Namespace) -> int:
    asked = (options.hosts, options.host, options.coordinator)
    if asked == (None, None, None):
        return train(options)
    if None in asked:
        raise ValueError("give all of --hosts, --host and --coordinator, or none; see jaxdrones train --help")
    if options.library == "sb3":
        raise ValueError("--library sb3 trains on one host; leave out --hosts, --host and --coordinator")
    from jaxdrones.training import hosts

    with contextlib.ExitStack() as stack:
        stack.enter_context(hosts.together(*asked))
        if options.host > 0:
            stack.enter_context(contextlib.redirect_stdout(io.StringIO()))
            copy = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "run"
            output = options.output or Path("runs") / options.task
            if options.resume and output.is_dir():
                shutil.copytree(output, copy)
            options.output, options.no_figure = copy, True
        hosts.meet("copied")
        return train(options)

"""Options of `jaxdrones train` for a training on several hosts."""

import argparse
import contextlib
import functools
import io
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from jaxdrones.cli.common import run_folder
from jaxdrones.errors import UserError

HELP = (
    "All devices share the worlds. A CPU counts as N devices with\n"
    "XLA_FLAGS=--xla_force_host_platform_device_count=N. On several hosts, start the same command on each, with a\n"
    "different --host. Host 0 writes the files; to --resume, each host needs a copy of the folder:\n"
    "  jaxdrones train hover --hosts 2 --host 0 --coordinator 127.0.0.1:9911"
)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("--hosts", type=int, metavar="N", help="number of processes that train together (1)")
    parser.add_argument("--host", type=int, metavar="I", help="number of this process, from 0")
    parser.add_argument(
        "--coordinator", metavar="ADDRESS:PORT", help="address of host 0, and a port that is free there"
    )


def on_hosts(train: Callable[[argparse.Namespace], int]) -> Callable[[argparse.Namespace], int]:
    """The command on one host or several; all but the first print nothing and write to a temporary folder."""
    return functools.partial(_on_hosts, train)


def _on_hosts(train: Callable[[argparse.Namespace], int], options: argparse.Namespace) -> int:
    asked = (options.hosts, options.host, options.coordinator)
    if asked == (None, None, None):
        return train(options)
    if None in asked:
        raise UserError("give all of --hosts, --host and --coordinator, or none; see jaxdrones train --help")
    if options.live is not None:
        raise UserError("--live is given with --hosts, whose trainings are not shown; leave one of them out")
    from jaxdrones.training import distributed

    with contextlib.ExitStack() as stack:
        stack.enter_context(distributed.join_hosts(*asked))
        if options.host > 0:
            stack.enter_context(contextlib.redirect_stdout(io.StringIO()))
            copy = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "run"
            output = options.output or run_folder(options.task)
            if options.resume and output.is_dir():
                shutil.copytree(output, copy)
            options.output, options.no_figure = copy, True
        distributed.wait_for_hosts("copied")
        return train(options)

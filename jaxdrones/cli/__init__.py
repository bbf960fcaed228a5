"""The command line: `jaxdrones fly`, `train`, `eval` and the others; a file per command."""

import argparse
import sys

from jaxdrones.checks import UnexpectedKeyword
from jaxdrones.cli import (
    bench,
    compare,
    completion,
    doctor,
    evaluate,
    explain,
    fit,
    fly,
    names,
    ros2,
    score,
    train,
    view,
)
from jaxdrones.cli.common import INTERRUPTED, Parser, print_error
from jaxdrones.cli.settings import task_first


def main(arguments: list[str] | None = None) -> int:
    """Run one command.

    Returns:
        The exit code: 0 done, 1 the flight broke or training diverged, 2 a mistake in what was asked, 130 interrupted.
    """
    parser = _parser()
    options = parser.parse_args(task_first(sys.argv[1:] if arguments is None else arguments))
    try:
        return options.run(options)
    except KeyboardInterrupt:
        return print_error("interrupted", INTERRUPTED)
    except OSError as error:
        unwritable = f"{error.filename}: {error.strerror}; choose another --output"
        return print_error(unwritable if error.filename else str(error))
    except (ValueError, ImportError, UnexpectedKeyword) as error:
        return print_error(str(error))


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="jaxdrones", description="Simulate teams of quadrotors.", allow_abbrev=False)
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=Parser)
    for command in (fly, train, evaluate, compare, view, fit, score, ros2, explain, names, doctor, bench):
        command.add(commands)
    completion.add(commands, parser)
    return parser

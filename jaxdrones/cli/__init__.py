"""Command line: `jaxdrones fly`, `train`, `eval` and others; a file per command."""

import argparse
import gc
import sys

from jaxdrones.cli import (
    bench,
    betaflight,
    compare,
    completion,
    crazyflie,
    demo,
    doctor,
    evaluate,
    explain,
    export,
    fit,
    fly,
    machine,
    names,
    ros2,
    score,
    train,
    view,
)
from jaxdrones.cli.common import Parser, check_options, lasting_interrupts, print_failure
from jaxdrones.cli.settings import task_first, with_config


def main(arguments: list[str] | None = None) -> int:
    """Run one command; return the exit code, see `EXIT_CODES`."""
    gc.set_threshold(50_000)  # tracing makes many objects and little garbage
    parser, debug = make_parser(), False
    try:
        arguments = with_config(sys.argv[1:] if arguments is None else arguments, parser.commands["train"])
        options = parser.parse_args(task_first(arguments))
        debug = options.debug
        machine.keep_programs()
        check_options(options)
        with lasting_interrupts():
            code = options.run(options)
            sys.stdout.flush()  # here, not at exit, where an error could not be handled
            return code
    except BaseException as error:
        return print_failure(error, debug)


def make_parser() -> Parser:
    """Parser of the command line."""
    parser = Parser(prog="jaxdrones", description="Simulate teams of quadrotors.")
    text = "show the traceback of every error"
    parser.add_argument("--debug", action="store_true", help=text)
    parser.add_argument("--version", action="version", version=f"jaxdrones {machine.version('jaxdrones')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=Parser)
    flights = (demo, fly, train, evaluate, compare, view, fit, score)
    tools = (ros2, crazyflie, betaflight, export, explain, names, doctor, bench)
    for command in flights + tools:
        command.add(commands)
    for each in commands.choices.values():
        each.add_argument("--json", action="store_true", help="print one JSON object and nothing else on stdout")
    completion.add(commands, parser)
    parser.commands = commands.choices
    for each in commands.choices.values():  # --debug may stand before the command or after it
        each.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help=text)
    return parser

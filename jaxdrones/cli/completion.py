"""`jaxdrones completion`."""

import argparse
import functools
from collections.abc import Iterator

from jaxdrones.arguments import choice
from jaxdrones.cli.options import option
from jaxdrones.errors import UserError, needs

SHELLS = ("bash", "zsh", "fish")
_FOLDERS, _FILES = ("DIR", "RUN", "BAG"), ("FILE",)  # metavars


def add(commands, root: argparse.ArgumentParser) -> None:
    """Add the command, with completions for all commands of `root`."""
    parser = commands.add_parser(
        "completion",
        help="print a completion script for a shell",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Print a script for the completion of commands, options and names by the tab key.\n\n"
        "  bash   source <(jaxdrones completion bash)     in ~/.bashrc\n"
        "  zsh    jaxdrones completion zsh > ~/.zfunc/_jaxdrones     with ~/.zfunc in $fpath before compinit\n"
        "  fish   jaxdrones completion fish > ~/.config/fish/completions/jaxdrones.fish",
    )
    option(parser, "shell SHELL", "{}", check=choice("shell", SHELLS), known=SHELLS)
    parser.set_defaults(run=functools.partial(_completion, root))


def _completion(root: argparse.ArgumentParser, options: argparse.Namespace) -> int:
    with needs("shtab", "cli", UserError):
        import shtab
    for action in _actions(root):
        if known := getattr(action, "known", ()):
            action.choices = known
        elif action.metavar in (*_FOLDERS, *_FILES):
            vars(action)["complete"] = shtab.DIRECTORY if action.metavar in _FOLDERS else shtab.FILE
    print(shtab.complete(root, options.shell))
    return 0


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _actions(command)
        else:
            yield action

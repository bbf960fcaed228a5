"""Settings shared by several commands: --set, --drones, --vehicle, --realistic and --config."""

import argparse
import ast
import contextlib
import inspect
import itertools
import tomllib
from pathlib import Path
from typing import Any

from jaxdrones.checks import check_choice
from jaxdrones.cli.options import option, split_names
from jaxdrones.envs import TASKS
from jaxdrones.envs.named_tasks import task_function
from jaxdrones.errors import UserError
from jaxdrones.user_code import blame, is_reference

# Arguments of `Recipe.of` with their own options.
_NO_SETTINGS = ("cls", "task", "algorithm", "realistic")
# Settings that are sequences of names, separated by commas at the shell.
_NAMES = ("observation", "vision", "effects", "pairs")


def add_realistic(parser: argparse._ActionsContainer, where: str = "") -> None:
    """Add --realistic, with the optional argument `any`; `where` is a prefix of its help."""
    option(
        parser,
        "--realistic any",
        f"{where}simulate rotor lag, drag, delay, sensor noise and random parameters; with `any` a random vehicle "
        "of 20 g to 3 kg in every episode",
        _any,
        False,
        known=("any",),
        nargs="?",
        const=True,
    )


def _any(text: str) -> str:
    if text != "any":
        raise argparse.ArgumentTypeError(f"{text!r} is given; give --realistic alone, or --realistic any")
    return text


def task_first(arguments: list[str]) -> list[str]:
    """Reorder `--realistic TASK` to `TASK --realistic`."""
    arguments = list(arguments)
    for i, (given, word) in enumerate(itertools.pairwise(arguments)):
        if given == "--realistic" and (word in TASKS or is_reference(word)):
            arguments[i : i + 2] = word, given
    return arguments


def with_config(arguments: list[str], train: argparse.ArgumentParser) -> list[str]:
    """Insert the options of `train --config FILE`; options of the command line override them.

    `train` is the parser of that command.
    """
    arguments = [x for word in arguments for x in (word.split("=", 1) if word.startswith("--config=") else [word])]
    command = next((i for i, word in enumerate(arguments) if not word.startswith("-")), None)
    if command is None or arguments[command] != "train" or "--config" not in arguments[:-1]:
        return arguments
    i = arguments.index("--config")
    file, rest = Path(arguments[i + 1]), [*arguments[:i], *arguments[i + 2 :]]
    if "--config" in rest:
        raise UserError("--config is given twice; give one file")
    try:
        entries = tomllib.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"--config {file} cannot be read: {error}") from None
    task = [entries.pop("task")] if "task" in entries else []
    if not all(isinstance(x, str) for x in task):
        raise UserError(f"--config {file}: task is {task[0]!r}; give a name in quotation marks")
    _check_entries(file, entries, train)
    if any(_is_positional(words) for words in itertools.pairwise(rest[command:])):
        task = []
    options, overridden = [], _settings_in(rest)
    for name, x in entries.items():
        if isinstance(x, dict):  # set and sweep
            x = {key: value for key, value in x.items() if key not in overridden}
            lists = {key: value if isinstance(value, list) else [value] for key, value in x.items()}
            values = {key: ",".join(map(str, value)) for key, value in lists.items()} if name == "sweep" else x
            options += [f"--{name}={key}={value}" for key, value in values.items()]
        elif x is not False:
            options.append(f"--{name}" if x is True else f"--{name}={x}")
    first = next((k for k in range(command + 1, len(rest)) if rest[k].startswith("-")), len(rest))
    return [*rest[:first], *task, *options, *rest[first:]]


def _check_entries(file: Path, entries: dict[str, Any], train: argparse.ArgumentParser) -> None:
    """Raise unless the entries of a file are options of the command, and true only those without a value."""
    options = {word[2:]: action for action in train._actions for word in action.option_strings if word[:2] == "--"}
    for name, x in entries.items():
        check_choice(f"option in --config {file}:", name, options.keys() - {"help", "config"})
        if x is True and options[name].nargs is None:
            raise UserError(f"--config {file}: {name} is true; give its value")


def _settings_in(arguments: list[str]) -> set[str]:
    """Names of the settings of --set and --sweep."""
    words = [
        x for word in arguments for x in (word.split("=", 1) if word.startswith(("--set=", "--sweep=")) else [word])
    ]
    return {word.partition("=")[0] for option, word in itertools.pairwise(words) if option in ("--set", "--sweep")}


def _is_positional(words: tuple[str, str]) -> bool:
    """Whether the second of two words is neither an option nor its value."""
    before, word = words
    return not word.startswith("-") and (not before.startswith("-") or "=" in before)


def parse_settings(texts: list[str]) -> dict[str, Any]:
    """Name and value of every --set; the last value of a repeated name."""
    changes: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise UserError(f"--set is {text!r}; give NAME=VALUE, for example worlds=512")
        if name in _NO_SETTINGS:
            raise UserError(
                f"--set {name} is not a setting of a learner or of an environment; see jaxdrones train --help"
            )
        changes[name] = parse_value(value)
        if name in _NAMES and isinstance(changes[name], str):
            changes[name] = tuple(split_names(value.removesuffix(",")))
    return changes


def given_settings(options: argparse.Namespace) -> dict[str, Any]:
    """Settings of --set, --drones and --vehicle."""
    changes = parse_settings(options.set)
    given = {name: getattr(options, name) for name in ("drones", "vehicle") if getattr(options, name) is not None}
    for name in given:
        if name in changes:
            raise UserError(f"--set {name}={changes[name]} is given beside --{name}; give one of them")
    return changes | given


def parse_value(text: str) -> Any:
    """Python literal, or else a string; `nan` and `inf` are numbers."""
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, RecursionError, MemoryError):
        return float(text) if text.strip("+-") in ("nan", "inf") else text


@contextlib.contextmanager
def user_mistakes(changes: dict[str, Any], task: str):
    """Context that converts the overflow of an integer among the options of a task to a `UserError` with their names.

    Tasks check their options themselves, so any other error is internal.
    """
    try:
        yield
    except OverflowError as error:
        known = inspect.signature(task_function(task)).parameters
        given = ", ".join(f"{name}={x}" for name, x in changes.items() if name in known)
        if not given or blame(error):
            raise
        raise UserError(f"--set {given} does not fit {task}: {error}") from error

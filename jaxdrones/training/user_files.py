"""User files in a recipe: the Python file of a task, the URDF of a vehicle.

A recipe has their names without folders, and their text. A run is thus independent of the original files. The text of a
task is executed when its run is opened.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from jaxdrones import user_code
from jaxdrones.envs.named_tasks import task_function
from jaxdrones.errors import UserError
from jaxdrones.tasks.task import Task
from jaxdrones.urdf import parse_params

Files = dict[str, str]
"""Name of a file without its folder -> its text."""


def take_task(task: str, kept: Mapping[str, str] | None = None) -> tuple[str, Files]:
    """Name of a task or `folder/file.py:function` for a recipe, and its file; `kept` files replace missing ones."""
    if not user_code.is_reference(task):
        return task, {}
    file, name = user_code.split_reference(task)
    return f"{file.name}:{name}", _read(file, kept)


def take_vehicle(options: dict[str, Any], kept: Mapping[str, str] | None = None) -> tuple[dict[str, Any], Files]:
    """Options of `jaxdrones.make` for a recipe, and the file of their vehicle; see `take_task` for `kept`."""
    vehicle = options.get("vehicle")
    if not (isinstance(vehicle, str) and vehicle.endswith(".urdf")):
        return options, {}
    file = Path(vehicle)
    return options | {"vehicle": file.name}, _read(file, kept)


def task_of(task: str, files: Mapping[str, str]) -> str | Callable[..., Task]:
    """Task of a recipe for `jaxdrones.make`: a name, or the function of a file."""

    def load(reference: str) -> Any:
        file, name = user_code.split_reference(reference)
        return user_code.definition(file.name, _text(file.name, files), name)

    return task_function(task, load) if user_code.is_reference(task) else task


def options_of(options: dict[str, Any], files: Mapping[str, str]) -> dict[str, Any]:
    """Options of a recipe for `jaxdrones.make`, with the constants of a vehicle file."""
    vehicle = options.get("vehicle")
    if not (isinstance(vehicle, str) and vehicle.endswith(".urdf")):
        return options
    return options | {"vehicle": parse_params(vehicle, _text(vehicle, files))}


def check_unchanged(folder: Path, kept: Mapping[str, str], found: Mapping[str, str]) -> None:
    """Raise if files have changed since the start of a run."""
    for name, text in found.items():
        if kept.get(name, text) != text:
            raise UserError(
                f"{name} has changed since {folder} was started; undo the change to --resume (best.json there has the "
                "old text), or train again with --overwrite or in another --output"
            )


def _read(file: Path, kept: Mapping[str, str] | None) -> Files:
    if kept and file.name in kept and not file.exists():
        return {file.name: kept[file.name]}
    return {file.name: user_code.read_text(file)}


def _text(name: str, files: Mapping[str, str]) -> str:
    if name not in files:
        raise UserError(f"the recipe lacks the text of {name}; train again")
    return files[name]

"""Recipes of trainings: task, learner and settings."""

import dataclasses
import inspect
from collections.abc import Callable, Collection
from typing import Any, Self

import numpy as np

from jaxdrones import user_code
from jaxdrones.checks import check_choice
from jaxdrones.envs import Env, make
from jaxdrones.envs.named_tasks import task_function
from jaxdrones.errors import UserError
from jaxdrones.limits import check_memory
from jaxdrones.tasks.task import Task
from jaxdrones.training import user_files
from jaxdrones.training.algorithms import learner
from jaxdrones.training.presets import preset

_DRONE_BYTES = 256  # memory of the parameters and the state of a drone


@dataclasses.dataclass(frozen=True)
class Recipe:
    """Task, learner and settings of a training."""

    task: str
    """A name of `jaxdrones.envs.TASKS`, or `file.py:function` of a file in `files`."""
    algorithm: str
    realistic: bool | str
    """As in `jaxdrones.make`."""
    options: dict[str, Any]
    """Options of `jaxdrones.make`."""
    config: Any
    """Settings of the learner, its `Config`."""
    files: user_files.Files = dataclasses.field(default_factory=dict)
    """Texts of the user's files of task and vehicle."""
    stop_at: float | None = None
    """Lower bound of the success rate to stop at; `None` for all updates."""
    start_from: str | None = None
    """Folder or name of the run whose best policy the training starts from; `None` for random parameters."""

    @classmethod
    def of(
        cls,
        task: str,
        algorithm: str = "bptt",
        realistic: bool | str = False,
        **changes: Any,
    ) -> Self:
        """Preset of a task, by name or `file.py:function`, with changes.

        These are settings of the learner (worlds, horizon, ...), and options of `jaxdrones.make` (period, ...).
        """
        changes = {name: x.item() if isinstance(x, np.generic) else x for name, x in changes.items()}
        task, files = user_files.take_task(task)
        function = user_files.task_of(task, files)
        settings_type = learner(algorithm).Config
        fields = dataclasses.fields(settings_type)
        known = {field.name for field in fields if field.default is not None}  # JSON holds no functions
        options, settings = split_changes(function, changes, known)
        options, vehicle = user_files.take_vehicle(options)
        _, config = checked_preset(function, algorithm, realistic, user_files.options_of(options, vehicle))
        settings = {name: convert_setting(name, x, getattr(config, name)) for name, x in settings.items()}
        config = dataclasses.replace(config, **settings)
        return cls(task, algorithm, realistic, options, config, files | vehicle)

    def env(self, practice: bool = False, **options: Any) -> Env:
        """Environment of flight or of training; options of `jaxdrones.make` override those of the recipe."""
        task = user_files.task_of(self.task, self.files)
        options = user_files.options_of(self.options | options, self.files)
        return preset(task, self.algorithm, self.realistic, practice, **options)[0]

    def as_dict(self) -> dict[str, Any]:
        """Entries for JSON."""
        config = {name: x for name, x in dataclasses.asdict(self.config).items() if x is not None}
        entries = dataclasses.asdict(self) | {"config": config}
        return entries if self.files else {name: x for name, x in entries.items() if name != "files"}

    @classmethod
    def from_dict(cls, entries: dict[str, Any]) -> Self:
        """Recipe from the entries of `as_dict`."""
        try:
            user_files.task_of(entries["task"], entries.get("files", {}))
            config = {name: tuple(x) if isinstance(x, list) else x for name, x in entries["config"].items()}
            settings_type = learner(entries["algorithm"]).Config
            return cls(**entries | {"config": settings_type(**config)})
        except (AttributeError, KeyError, TypeError) as error:
            raise UserError(f"the recipe is not one of this version ({error!r}); train again") from error


def split_changes(
    task: str | Callable[..., Task], changes: dict[str, Any], known: Collection[str]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split changes into options of the environment and settings of the learner, with names `known`."""
    options = {*inspect.signature(make).parameters, *inspect.signature(task_function(task)).parameters}
    options -= {"task", "backend", "realistic", "options", "vision"}
    for name in changes:
        check_choice("setting", name, options.union(known))
        if name in options and name in known:
            raise UserError(
                f"{name} is an option of the environment and a setting of the learner; give the option another name"
            )
    settings = {name: x for name, x in changes.items() if name in known}
    return {name: x for name, x in changes.items() if name not in known}, settings


def checked_preset(
    task: str | Callable[..., Task], algorithm: str, realistic: bool | str, options: dict[str, Any]
) -> tuple[Env, Any]:
    """Result of `preset`; options of wrong types raise a `ValueError`."""
    drones = options.get("drones")
    if isinstance(drones, int):
        check_memory(f"a team of {drones:,} drones", drones * _DRONE_BYTES, "give fewer drones")
    try:
        return preset(task, algorithm, realistic, **options)
    except TypeError as error:
        if user_code.blame(error):
            raise
        name = task if isinstance(task, str) else task.__name__
        raise UserError(f"options {options} do not fit {name}: {error}") from None


def convert_setting(name: str, value: Any, current: Any) -> Any:
    """Convert a setting to the type of its current value, if lossless."""
    if isinstance(current, float) and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if isinstance(current, tuple) and isinstance(value, list):
        value = tuple(value)
    if current is not None and type(value) is not type(current):
        raise UserError(f"{name} is {value!r}; give a value such as {current!r}")
    return value

"""A recipe: the task, the learner and the settings of a training."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Collection
from typing import Any

from jaxdrones.checks import check_choice
from jaxdrones.envs import TASKS, Env, make
from jaxdrones.limits import LARGEST_COUNT, check_at_most, check_memory
from jaxdrones.training.algorithms import learner
from jaxdrones.training.presets import preset

_DRONE_BYTES = 256  # memory that the parameters and the state of a drone take


@dataclasses.dataclass(frozen=True)
class Recipe:
    """The task, the learner and the settings of a training."""

    task: str
    algorithm: str
    realistic: bool
    options: dict[str, Any]
    """Options of `jaxdrones.make`."""
    config: Any
    """Settings of the learner, its `Config`."""

    @classmethod
    def of(cls, task: str, algorithm: str = "bptt", realistic: bool = False, **changes: Any) -> Recipe:
        """A preset with changes.

        Args:
            task: a name of `jaxdrones.envs.TASKS`.
            algorithm: a name of `jaxdrones.training.algorithms.ALGORITHMS`.
            realistic: see `presets.preset`.
            **changes: settings of the learner (worlds, horizon, ...), and options of `jaxdrones.make` (period, ...).

        Raises:
            ValueError: an unknown name, or a value of the wrong type.
        """
        check_choice("task", task, TASKS)
        fields = dataclasses.fields(learner(algorithm).Config)
        known = {field.name for field in fields if field.default is not None}  # JSON holds no functions
        options, settings = split_changes(task, changes, known)
        _, config = checked_preset(task, algorithm, realistic, options)
        settings = {name: convert_setting(name, x, getattr(config, name)) for name, x in settings.items()}
        config = dataclasses.replace(config, **settings)
        for name in ("updates", "worlds", "horizon"):
            check_at_most(name, getattr(config, name), LARGEST_COUNT)
        return cls(task, algorithm, realistic, options, config)

    @property
    def trained_by(self) -> str:
        """Name of the learner for titles."""
        return self.algorithm

    def env(self, practice: bool = False, **options: Any) -> Env:
        """The environment to fly in or to train in; options of `jaxdrones.make` replace those of the recipe."""
        return preset(self.task, self.algorithm, self.realistic, practice, **self.options | options)[0]

    def as_dict(self) -> dict[str, Any]:
        """The recipe for JSON."""
        config = {name: x for name, x in dataclasses.asdict(self.config).items() if x is not None}
        return dataclasses.asdict(self) | {"config": config}

    @classmethod
    def from_dict(cls, entries: dict[str, Any]) -> Recipe:
        """The recipe of which `as_dict` gave the entries.

        Raises:
            ValueError: they are damaged, or of another version of this library.
        """
        try:
            check_choice("task", entries["task"], TASKS)
            config = {name: tuple(x) if isinstance(x, list) else x for name, x in entries["config"].items()}
            return cls(**entries | {"config": learner(entries["algorithm"]).Config(**config)})
        except (AttributeError, KeyError, TypeError) as error:
            raise ValueError(f"the recipe is not one of this version ({error!r}); train anew") from error


def split_changes(task: str, changes: dict[str, Any], known: Collection[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Options of the environment, and settings of the learner, whose names are `known`.

    Raises:
        ValueError: a name is neither; lists both.
    """
    options = {*inspect.signature(make).parameters, *inspect.signature(TASKS[task]).parameters}
    options -= {"task", "backend", "realistic", "options", "vision"}
    for name in changes:
        check_choice("setting", name, options.union(known))
    settings = {name: x for name, x in changes.items() if name in known}
    return {name: x for name, x in changes.items() if name not in known}, settings


def checked_preset(task: str, algorithm: str, realistic: bool, options: dict[str, Any]) -> tuple[Env, Any]:
    """The result of `preset`; options of wrong types raise a `ValueError`."""
    drones = options.get("drones")
    if isinstance(drones, int):
        check_memory(f"a team of {drones:,} drones", drones * _DRONE_BYTES, "give fewer drones")
    try:
        return preset(task, algorithm, realistic, **options)
    except TypeError as error:
        raise ValueError(f"options {options} do not fit {task}: {error}") from None


def convert_setting(name: str, value: Any, current: Any) -> Any:
    """A setting converted to the type of its current value, where that loses nothing.

    Raises:
        ValueError: it is of another type.
    """
    if isinstance(current, float) and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if isinstance(current, tuple) and isinstance(value, list):
        value = tuple(value)
    if current is not None and type(value) is not type(current):
        raise ValueError(f"{name} is {value!r}; give something like {current!r}")
    return value

"""Tasks by name, from functions and from users' files."""

import inspect
from collections.abc import Callable, Collection
from typing import Any

from jaxdrones import user_code
from jaxdrones.checks import UnexpectedKeyword, check_function, check_keyword, hint, look_up, short_repr
from jaxdrones.errors import UserError
from jaxdrones.tasks import (
    crowd,
    follow,
    forest,
    gates,
    gym_pybullet_drones,
    hover,
    payload,
    race,
    room,
    swap,
    tracking,
    wake,
)
from jaxdrones.tasks.task import Task

TASKS: dict[str, Callable[..., Task]] = {
    "hover": hover.hover,
    "recovery": hover.recovery,
    "landing": hover.landing,
    "tracking": tracking.tracking,
    "gates": gates.gates,
    "forest": forest.forest,
    "room": room.room,
    "follow": follow.follow,
    "swap-goals": swap.swap_goals,
    "crowd": crowd.crowd,
    "race": race.race,
    "wake": wake.wake,
    "sling": payload.sling,
    "transport": payload.transport,
    "hover-2021": gym_pybullet_drones.hover,
    "takeoff": gym_pybullet_drones.takeoff,
    "fly-through-gate": gym_pybullet_drones.fly_through_gate,
    "tune": gym_pybullet_drones.tune,
    "leader-follower": gym_pybullet_drones.leader_follower,
    "flock": gym_pybullet_drones.flock,
    "meetup": gym_pybullet_drones.meetup,
    "hover-2x": gym_pybullet_drones.hover_2x,
    "multi-hover": gym_pybullet_drones.multi_hover,
}


def task_function(task: str | Callable[..., Task], load: Callable[[str], Any] = user_code.load) -> Callable[..., Task]:
    """Function of a task: by a name of `TASKS`, from `file.py:function` by `load`, or the function itself."""
    if callable(task):
        return task
    if not (isinstance(task, str) and user_code.is_reference(task)):
        return look_up("task", task, TASKS)
    function = load(task)
    check_function(task, function, example="a function that returns a jaxdrones.tasks.Task")
    return function


def make_task(task: str | Task | Callable[..., Task], options: dict[str, Any], others: Collection[str]) -> Task:
    """Task for the arguments of `jaxdrones.make`; `others` are the names of its other options, for messages."""
    if isinstance(task, Task):
        if options:
            option = next(iter(options))
            raise UnexpectedKeyword(
                f"make() got an unexpected keyword argument {option!r} beside a task{hint(option, others)}; give "
                "options of the task to the task"
            )
        return task
    function = task_function(task)
    name = task if isinstance(task, str) else getattr(task, "__name__", "task")
    parameters = inspect.signature(function).parameters
    if all(parameter.kind is not parameter.VAR_KEYWORD for parameter in parameters.values()):
        for option in options:
            check_keyword(f"make({name!r})", option, {*others, *parameters})
    lacking = [
        parameter.name
        for parameter in parameters.values()
        if parameter.default is parameter.empty and parameter.name not in options
        if parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
    ]
    if lacking:
        words = ", ".join(lacking)
        raise UserError(f"{name} takes {words} without a default; give defaults in the file, or values as options")
    made = function(**options)
    if not isinstance(made, Task):
        raise UserError(f"{name} returned {short_repr(made)}; return a jaxdrones.tasks.Task")
    return made

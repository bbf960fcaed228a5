"""Checks of the arguments of an environment."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from jaxdrones.checks import (
    check_callable,
    check_number,
    check_params,
    check_positive,
    check_sequence,
    check_shape,
    shown,
)
from jaxdrones.envs.action import Action
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.tasks.task import ObservationTerm, Task

_BOUNDS = 2  # of a drawn delay
_MAX_STEPS = 1e9  # control steps of an episode, which are counted by an integer of 32 bits


def check_team(task: Task, params: Params, action: Action, dt: float) -> None:
    """Raise `ValueError` unless these are a task, the parameters of its team, an action type and a control period."""
    for name, given, kind in ("task", task, Task), ("params", params, Params), ("action", action, Action):
        if not isinstance(given, kind):
            raise UserError(f"{name} is {shown(given)}; give an object of {kind.__name__}, or use jaxdrones.make")
    check_positive("dt", dt, "s")
    check_params(params)
    check_shape("params.mass", params.mass, (task.drones,), f"the task {task.name} has {task.drones} drones")


def check_terms(observation: Sequence[ObservationTerm]) -> tuple[ObservationTerm, ...]:
    """The terms of an observation, or an error if there is none or something else among them."""
    terms = check_sequence("observation", observation, "OBSERVATIONS['position_error']")
    if not terms:
        raise UserError("observation is empty; name at least one observation term")
    for term in terms:
        if not isinstance(term, ObservationTerm):
            raise UserError(
                f"observation: {shown(term)} is not an observation term; give one or a name of OBSERVATIONS"
            )
    return terms


def check_randomizations(randomize: Sequence[Callable]) -> tuple[Callable, ...]:
    """A sequence of randomizations, or an error if something else is among them."""
    randomize = check_sequence("randomize", randomize, "scaled('mass', 0.9, 1.1)")
    for randomization in randomize:
        check_callable("randomize", randomization, "scaled('mass', 0.9, 1.1)")
    return randomize


def check_draws(
    randomize: Sequence[Callable], noise: Callable | None, disturbance: Callable | None
) -> tuple[Callable, ...]:
    """The randomizations, or an error if one of them, the noise or the disturbance is no function."""
    if noise is not None:
        check_callable("noise", noise, "sensor_noise()")
    if disturbance is not None:
        check_callable("disturbance", disturbance, "random_pushes(0.3)")
    return check_randomizations(randomize)


def delay_steps(task: Task, delay: float | tuple[float, float], dt: float) -> tuple[float, float]:
    """The shortest and the longest delay in control steps; 0.02 s at 100 Hz are two, whatever the rounding.

    Raises:
        ValueError: a negative delay, one that is longer than an episode, or bounds in the wrong order.
    """
    drawn = isinstance(delay, tuple | list)
    bounds = check_sequence("delay", delay, "(0.0, 0.04)") if drawn else (delay, delay)
    if len(bounds) != _BOUNDS:
        raise UserError(f"delay is {shown(delay)}; give a number, or the shortest and the longest of an episode")
    for bound in bounds:
        check_number("delay", bound, "s, less than an episode", at_least=0, below=task.duration)
    if bounds[0] > bounds[1]:
        raise UserError(f"delay is {shown(delay)}; give the shortest first")

    def steps(bound: float) -> float:
        steps = bound / dt
        return float(round(steps)) if math.isclose(steps, round(steps), abs_tol=1e-6) else steps

    return steps(bounds[0]), steps(bounds[1])


def episode_steps(task: Task, dt: float) -> int:
    """Number of control steps of an episode.

    Raises:
        ValueError: none, or too many.
    """
    steps = task.duration / dt
    if not 0.5 < steps < _MAX_STEPS:
        raise UserError(
            f"duration is {task.duration} s, {steps:.3g} control steps of {dt:.4g} s; give 1 to {_MAX_STEPS:.0e}"
        )
    return round(steps) + task.extra_steps

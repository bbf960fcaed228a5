"""Environments by name."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any

from jaxdrones.backends.explicit import Step, make_step
from jaxdrones.checks import check_choice, check_positive, check_whole
from jaxdrones.dynamics import EFFECTS, INTEGRATORS, PAIRS, ROTORS, drone_contact, external_push, ground_contact
from jaxdrones.envs.actions import ACTIONS, Action
from jaxdrones.envs.env import Env
from jaxdrones.envs.observations import OBSERVATIONS
from jaxdrones.envs.randomize import REALISTIC_DELAY, REALISTIC_LAWS, Disturbance, Law, Noise, sensor_noise
from jaxdrones.envs.vision import IMAGES, Vision
from jaxdrones.params import Params, repeat
from jaxdrones.tasks import gates, hover, paper, swap, tracking
from jaxdrones.tasks.task import Part, Task
from jaxdrones.urdf import load_params

TASKS: dict[str, Callable[..., Task]] = {
    "hover": hover.hover,
    "recovery": hover.recovery,
    "landing": hover.landing,
    "tracking": tracking.tracking,
    "gates": gates.gates,
    "swap-goals": swap.swap_goals,
    "paper-hover": paper.hover,
    "takeoff": paper.takeoff,
    "fly-through-gate": paper.fly_through_gate,
    "tune": paper.tune,
    "leader-follower": paper.leader_follower,
    "flock": paper.flock,
    "meetup": paper.meetup,
    "hover-v2": paper.hover_v2,
    "multi-hover": paper.multi_hover,
}
BACKENDS = ("explicit", "bullet")


def make(
    task: str | Task,
    *,
    backend: str = "explicit",
    vehicle: str | os.PathLike | Params = "cf2x",
    action: str | Action | None = None,
    observation: Sequence[str | Part] | None = None,
    vision: Sequence[str] = (),
    vision_hz: float | None = None,
    realistic: bool = False,
    effects: Sequence[str | Callable] | None = None,
    pairs: Sequence[str | Callable] = (),
    rotors: str | None = None,
    integrator: str = "semi_implicit_euler",
    control_hz: float | None = None,
    substeps: int | None = None,
    laws: Sequence[Law] | None = None,
    noise: Noise | None = None,
    disturb: Disturbance | None = None,
    delay: float | None = None,
    **options: Any,
) -> Env:
    """Make an environment.

    Args:
        task: a name of `TASKS`, or a task.
        backend: `explicit` or `bullet`, which must be closed: use the environment in a `with` block.
        vehicle: a bundled vehicle, the path of a URDF, or the parameters of one drone.
        action: a name of `ACTIONS` or an action type; the task's own when left out.
        observation: names of `OBSERVATIONS` or parts, put side by side; the task's own when left out.
        vision: which of `rgb`, `depth`, `segmentation` to see beside the rest; with the Bullet backend.
        vision_hz: pictures per second; one per control step when left out.
        realistic: lagging rotors, drag, 20 ms of delay, sensor noise and parameter ranges, where not given here.
        effects: names of `EFFECTS` or functions.
        pairs: names of `PAIRS` or functions.
        rotors: `instant` or `lagging`.
        integrator: a name of `INTEGRATORS`; Bullet has its own.
        control_hz: control steps per second; the task's own when left out.
        substeps: physics steps per control step; the task's own when left out.
        laws: draw each episode's parameters from the nominal ones.
        noise: of the sensors.
        disturb: pushes.
        delay: between action and command, s.
        **options: of the task, for example `drones`.

    Raises:
        ValueError: an unknown name, a number out of range, an option that the task does not have.
        ImportError: the Bullet backend is asked for and pybullet is not installed.
    """
    check_choice("backend", backend, BACKENDS)
    task = _task(task, options)
    control_hz = task.control_hz if control_hz is None else control_hz
    substeps = task.substeps if substeps is None else substeps
    check_positive("control_hz", control_hz, "1/s")
    check_whole("substeps", substeps)
    dt = 1 / control_hz
    nominal = repeat(vehicle if isinstance(vehicle, Params) else load_params(vehicle), task.drones)

    preset = _REALISTIC if realistic else _PLAIN
    rotors = _named("rotors", preset["rotors"] if rotors is None else rotors, ROTORS)
    effects = [_named("effect", effect, EFFECTS) for effect in (preset["effects"] if effects is None else effects)]
    if disturb is not None:
        effects = [*effects, external_push]
    pairs = [_named("pair effect", pair, PAIRS) for pair in pairs]
    physics: dict[str, Any] = dict(effects=effects, pairs=pairs, rotors=rotors, dt=dt / substeps, substeps=substeps)
    step: Step
    if backend == "bullet":
        from jaxdrones.backends import bullet  # an optional library behind it

        if integrator != "semi_implicit_euler":
            raise ValueError(f"integrator is {integrator!r}; the bullet backend integrates by itself, leave it out")
        step = bullet.make_step(**physics, scene=task.scene)
    else:
        if "ground" in task.contact:
            physics["effects"] = [*effects, ground_contact]
        if "drones" in task.contact:
            physics["pairs"] = [*pairs, drone_contact]
        step = make_step(**physics, integrator=_named("integrator", integrator, INTEGRATORS))

    chosen = _named("action", task.action if action is None else action, ACTIONS)
    parts = [_part(name, task) for name in (task.observation if observation is None else observation)]
    return Env(
        task,
        nominal,
        step,
        dt=dt,
        action=chosen if isinstance(chosen, Action) else chosen(),
        observation=parts,
        laws=(*task.laws, *(preset["laws"] if laws is None else laws)),
        noise=preset["noise"] if noise is None else noise,
        disturb=disturb,
        delay=preset["delay"] if delay is None else delay,
        vision=_vision(step, backend, vision, vision_hz, control_hz),
    )


_PLAIN: dict[str, Any] = dict(rotors="instant", effects=(), laws=(), noise=None, delay=0.0)
_REALISTIC: dict[str, Any] = dict(
    rotors="lagging", effects=("drag",), laws=REALISTIC_LAWS, noise=sensor_noise(), delay=REALISTIC_DELAY
)


def _task(task: str | Task, options: dict) -> Task:
    if isinstance(task, Task):
        if options:
            raise ValueError(f"options {', '.join(options)} are given beside a task; give them to the task")
        return task
    check_choice("task", task, TASKS)
    known = TASKS[task].__annotations__.keys() - {"return"}
    for option in options:
        check_choice(f"option of {task}", option, known)
    return TASKS[task](**options)


def _named(kind: str, value: Any, table: dict[str, Any]) -> Any:
    if not isinstance(value, str):
        return value
    check_choice(kind, value, table)
    return table[value]


def _part(name: str | Part, task: Task) -> Part:
    return _named("observation", name, OBSERVATIONS | dict(task.senses))


def _vision(step, backend: str, images: Sequence[str], hz: float | None, control_hz: float) -> Vision | None:
    for image in images:
        check_choice("image", image, IMAGES)
    if not images:
        return None
    if backend != "bullet":
        raise ValueError("vision is asked for; the explicit backend has no cameras, take backend='bullet'")
    every = control_hz / (hz or control_hz)
    if abs(every - round(every)) > 1e-6 or every < 1:
        raise ValueError(f"vision_hz is {hz}; give a divisor of the control rate, {control_hz:g}")
    return Vision(step, round(every), tuple(images))

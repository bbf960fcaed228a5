"""`make`: environments by name."""

import dataclasses
import functools
import inspect
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

from jaxdrones.arguments import Count, Hertz, checked, choice, function, sequence
from jaxdrones.checks import check_number, check_switch, check_vehicle, look_up, short_repr
from jaxdrones.dynamics import EFFECTS, INTEGRATORS, PAIRS, ROTORS
from jaxdrones.dynamics.aero import external_force
from jaxdrones.dynamics.contact import drone_contact, ground_contact, obstacle_contact
from jaxdrones.dynamics.model import Model
from jaxdrones.dynamics.needs import needs_of
from jaxdrones.engine.explicit import ExplicitStep, make_step
from jaxdrones.engine.physics import Physics
from jaxdrones.engine.step import Step
from jaxdrones.engine.wrenches import TeamEffect
from jaxdrones.envs.action_checks import check_action, check_command
from jaxdrones.envs.actions import ACTIONS, Action
from jaxdrones.envs.disturbances import Disturbance
from jaxdrones.envs.env import Env
from jaxdrones.envs.episode import has_solid
from jaxdrones.envs.functions import DrawScene, check_process, equipped, scene_example
from jaxdrones.envs.named_tasks import make_task
from jaxdrones.envs.observations import OBSERVATIONS, reading
from jaxdrones.envs.randomize import (
    REALISTIC_DELAY,
    REALISTIC_RANDOMIZATION,
    AnyVehicle,
    Noise,
    Randomization,
    all_randomizations,
    delay_bounds,
    nominal_params,
    sensor_noise,
    with_random_lags,
)
from jaxdrones.envs.start_checks import check_free_starts, check_starts
from jaxdrones.envs.vision import Vision, make_vision
from jaxdrones.errors import UserError
from jaxdrones.params import Params, check_single, repeat
from jaxdrones.sensing import Camera, Scene
from jaxdrones.sensing.sensor import Sensor, check_sensors
from jaxdrones.tasks.task import ObservationTerm, Task
from jaxdrones.urdf import load_params

BACKENDS = ("explicit", "bullet")
_SCALED = "scaled('mass', 0.9, 1.1)"


@checked
def make(
    task: str | Task | Callable[..., Task],
    *,
    backend: Annotated[str, choice("backend", BACKENDS)] = "explicit",
    vehicle: str | os.PathLike | Params | None = None,
    action: str | Action | None = None,
    observation: Annotated[Sequence[str | ObservationTerm] | None, sequence("'position_error'")] = None,
    vision: Annotated[Sequence[str] | None, sequence("'depth'")] = None,
    camera: Camera | None = None,
    realistic: Annotated[bool | str, functools.partial(check_switch, others=("any",))] = False,
    effects: Annotated[Sequence[str | Callable] | None, sequence("'drag'")] = None,
    pairs: Annotated[Sequence[str | Callable] | None, sequence("'downwash'")] = None,
    team_effects: Sequence[TeamEffect] = (),
    models: Sequence[Model] = (),
    rotors: str | Callable | None = None,
    integrator: str | Callable = "semi_implicit_euler",
    control_hz: Hertz | None = None,
    substeps: Count | None = None,
    randomize: Annotated[
        Sequence[Randomization] | None, sequence(_SCALED, function(_SCALED, ("key", "params")))
    ] = None,
    noise: Annotated[Noise | None, function("sensor_noise()", ("key", "state"))] = None,
    disturbance: Annotated[Disturbance | None, function("random_pushes(0.3)", ("key", "params", "dt"))] = None,
    delay: float | tuple[float, float] | None = None,
    sensors: Sequence[Sensor] = (),
    scene: Scene | DrawScene | None = None,
    **options: Any,
) -> Env:
    """Make an environment.

    Args:
        task: a name of `TASKS`; `file.py:function` of a function that returns a task, or this function; or a task.
        backend: `explicit` or `bullet`; use a Bullet environment in a `with` block, which closes it.
        vehicle: a bundled vehicle, the path of a URDF, or the parameters of one drone; by default `cf2x`.
        action: a name of `ACTIONS` or an action type; by default the task's.
        observation: names of `OBSERVATIONS` or of sensors, or observation terms, concatenated; by default the task's.
        vision: images to observe, any of `rgb`, `depth`, `segmentation`, from a camera on every drone; by default the
            task's.
        camera: that camera, with its rate, latency and noise; by default the task's, or else `Camera()`.
        realistic: defaults with lagging rotors, drag, a random delay, sensor noise and random parameters; `any` draws a
            vehicle of 20 g to 3 kg for every episode in place of random parameters.
        effects: names of `EFFECTS` or functions.
        pairs: names of `PAIRS` or functions; by default the task's.
        team_effects: functions `(params, state) -> Wrench` of the whole team.
        models: additional differential equations, such as a battery.
        rotors: `instant`, `lagging`, or a function as for `make_step`.
        integrator: a name of `INTEGRATORS`, or a function; Bullet has its own.
        control_hz: control steps per second; by default the task's.
        substeps: physics steps per control step; by default the task's.
        randomize: randomizations of each episode's parameters.
        noise: noise of the observed state.
        disturbance: wind or external force for every control step, for example `random_pushes`.
        delay: delay between action and command, s, or the range of a uniform distribution, drawn per episode.
        sensors: sensors of every drone; their names are observations too.
        scene: obstacles and ground, or a function `(key) -> Scene` for random scenes; by default the task's. On the
            explicit backend `obstacle_contact` makes obstacles solid, unless another effect uses the scene or the task
            ends at contact.
        **options: options of the task, for example `drones`.

    Raises:
        ValueError: an unknown name, a number out of range, a vehicle that cannot hover, or an action type with a
            controller that is unstable with the vehicle, its rotors or the control rate.
        TypeError: an unknown option.
        ImportError: the Bullet backend without pybullet.
    """
    check_process()
    task = make_task(task, options, _OWN_OPTIONS)
    control_hz = task.control_hz if control_hz is None else control_hz
    substeps = task.substeps if substeps is None else substeps
    dt = 1 / float(control_hz)
    preset = _REALISTIC if realistic else _PLAIN
    if randomize is None and realistic != "any":
        randomize = preset["randomize"]
    randomize = all_randomizations(realistic == "any", task.randomize, randomize or (), vehicle)
    vehicle = "cf2x" if vehicle is None else vehicle
    nominal = load_params(vehicle) if not isinstance(vehicle, Params) else vehicle
    check_single("vehicle.mass", nominal, "vehicle is a single drone, and all drones of the task are equal to it")
    nominal = repeat(nominal, task.drones)
    check_vehicle(nominal)
    nominal = equipped(task, nominal_params(randomize, nominal))
    if "payload" in nominal.aux and any(isinstance(one, AnyVehicle) for one in randomize):
        raise UserError(
            f"{task.name} has loads for one vehicle, and every episode draws another; give a vehicle in place of "
            "realistic='any' or AnyVehicle"
        )
    rotors = _named("rotors", preset["rotors"] if rotors is None else rotors, ROTORS)
    effects = _all_named("effects", preset["effects"] if effects is None else effects, EFFECTS, others=PAIRS)
    effects = [*effects, *(effect for effect in task.effects if effect not in effects)]
    if disturbance is not None and external_force not in effects:
        effects = [*effects, external_force]
    pairs = _all_named("pairs", task.pairs if pairs is None else pairs, PAIRS, others=EFFECTS)
    action = _action(task.action if action is None else action, nominal, rotors, dt)
    sensors = check_sensors(sensors, dt)
    physics: dict[str, Any] = dict(
        effects=effects, pairs=pairs, team_effects=team_effects, models=(*models, *task.models), rotors=rotors
    )
    physics |= dict(dt=dt / substeps, substeps=substeps)
    given_scene, scene = scene, task.scene if scene is None else scene
    example = scene_example(scene)
    check_starts(randomize, task, nominal, example)
    step: Step
    if backend == "bullet":
        from jaxdrones.engine import bullet  # needs an optional library

        if integrator != "semi_implicit_euler":
            raise UserError(f"integrator is {integrator!r}; the bullet backend integrates by itself, leave it out")
        step = bullet.make_step(**physics, scene=scene if isinstance(scene, Scene) else None)
    else:
        touched = {needs_of(function).contact for function in (*effects, *pairs)}
        if "ground" in task.contact and "ground" not in touched:
            physics["effects"] = [*physics["effects"], ground_contact]
        if has_solid(task, example) and not Physics(physics["effects"]).takes_scene:
            physics["effects"] = [*physics["effects"], obstacle_contact]
        if "drones" in task.contact and "drones" not in touched:
            physics["pairs"] = [*pairs, drone_contact]
        step = make_step(**physics, integrator=_named("integrator", integrator, INTEGRATORS))
        step.check_lag(nominal)

    observation = task.observation if observation is None else observation
    known = _known_terms(task, sensors)
    made = Env(
        task,
        nominal,
        step,
        dt=dt,
        action=action,
        terms=_terms(observation, known),
        randomize=randomize,
        noise=preset["noise"] if noise is None else noise,
        disturbance=disturbance,
        delay=delay_bounds(preset["delay"] if delay is None else delay, task.duration),
        vision=_vision(task, step, vision, camera, scene),
        sensors=sensors,
        scene=scene,
        vehicle=_name(vehicle, randomize),
    )
    if not 0 < made.steps < _MAX_STEPS:
        raise UserError(
            f"duration is {task.duration} s, {task.duration / dt:.3g} control steps of {dt:.4g} s; give 1 to "
            f"{_MAX_STEPS:.0e}"
        )
    check_command(made)
    _ = made.term_sizes  # checks the functions of the task
    if isinstance(given_scene, Scene):
        check_free_starts(task, nominal, given_scene)
    if isinstance(step, ExplicitStep) and step.physics.rotors_lag:
        step.check_lag(with_random_lags(randomize, nominal))
    return made


_MAX_STEPS = 1e9  # control steps of an episode, which are counted by an integer of 32 bits
_PLAIN: dict[str, Any] = dict(rotors="instant", effects=(), randomize=(), noise=None, delay=0.0)
_REALISTIC: dict[str, Any] = dict(
    rotors="lagging", effects=("drag",), randomize=REALISTIC_RANDOMIZATION, noise=sensor_noise(), delay=REALISTIC_DELAY
)


_OWN_OPTIONS = {name for name in inspect.signature(make).parameters if name not in ("task", "options")}


def _terms(observation: Sequence[str | ObservationTerm], known: dict[str, ObservationTerm]) -> tuple:
    terms = tuple(_named("observation", term, known) for term in observation)
    if not terms:
        raise UserError("observation is empty; name at least one observation term")
    for term in terms:
        if not isinstance(term, ObservationTerm):
            raise UserError(
                f"observation: {short_repr(term)} is not an observation term; give one or a name of OBSERVATIONS"
            )
    return terms


def _name(vehicle: str | os.PathLike | Params, randomize: Sequence[Randomization]) -> str:
    if any(isinstance(one, AnyVehicle) for one in randomize):
        return "any vehicle"
    return "drones of own parameters" if isinstance(vehicle, Params) else Path(vehicle).stem


def _all_named(kind: str, values, table: dict, others: dict) -> list:
    """Functions by name from a table; a name of the table of `others` is an error with a hint."""
    for value in values:
        if isinstance(value, str) and value not in table and value in others:
            other = "pairs" if kind == "effects" else "effects"
            raise UserError(f"{value!r} is given as one of {kind}; it is one of {other}, give {other}=({value!r},)")
    return [_named("effect" if kind == "effects" else "pair effect", value, table) for value in values]


def _named(kind: str, value: Any, table: dict[str, Any]) -> Any:
    return look_up(kind, value, table) if isinstance(value, str) else value


def _action(action: str | Action, nominal: Params, rotors: Any, dt: float) -> Action:
    """Action type for the vehicle; raise if its controller is unstable with it."""
    kind = _named("action", action, ACTIONS)
    kind = kind() if isinstance(action, str | type) else kind
    if not isinstance(kind, Action):
        raise UserError(
            f"action is {short_repr(kind)}; give an object of Action, or a name of ACTIONS: {', '.join(ACTIONS)}"
        )
    check_action(action if isinstance(action, str) else None, kind, nominal, rotors, dt)
    return dataclasses.replace(kind, name=action if isinstance(action, str) else kind.name).fitted(nominal)


def _known_terms(task: Task, sensors: Sequence[Sensor]) -> dict[str, ObservationTerm]:
    """Observation terms by name: those of all tasks, of this task, and one for every sensor."""
    terms = OBSERVATIONS | dict(task.observations)
    for sensor in sensors:
        if sensor.name in terms:
            raise UserError(f"a sensor is named {sensor.name!r}, like an observation term; give it another name")
    terms |= {sensor.name: reading(sensor.name, sensor.bound, sensor.entries) for sensor in sensors}
    return {name: dataclasses.replace(term, name=name) for name, term in terms.items()}


def _vision(
    task: Task,
    step: Step,
    images: Sequence[str] | None,
    camera: Camera | None,
    scene: Scene | DrawScene,
) -> Vision | None:
    images = task.vision if images is None else images
    if images:
        made = make_vision(step, images, camera or task.camera or Camera(), scene)
        check_number("latency of the camera", made.camera.latency, "s, less than an episode", below=task.duration)
        return made
    if camera is not None:
        raise UserError("camera is given without vision; give for example vision=('depth',), or leave it out")
    return None

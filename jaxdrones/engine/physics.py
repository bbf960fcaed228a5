"""Sum of wrenches and models of a team, shared by the backends."""

import dataclasses
import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.accelerate import compiler
from jaxdrones.arguments import checked, sequence
from jaxdrones.checks import bind, check_function, is_concrete, takes
from jaxdrones.dynamics.model import Model
from jaxdrones.dynamics.needs import layers, needs_of
from jaxdrones.dynamics.propulsion import pwm_rotors
from jaxdrones.dynamics.rotors import instant_rotors, lagging_rotors, rotor_reaction, rotor_wrench, with_rotor_speed
from jaxdrones.engine.neighbors import NeighborGrid
from jaxdrones.engine.wrenches import (
    Effect,
    Pair,
    TeamEffect,
    check_wrench,
    describe,
    explained_key_errors,
    from_others,
    side_by_side,
)
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.state import State
from jaxdrones.wrench import Wrench

Rotors = Callable[[Params, State, Float[Array, "4"]], tuple[Float[Array, "4"], Float[Array, "4"]]]

Contact = Callable[[Params, State], Wrench]
"""`(params, state)` of a team of n drones -> wrench of obstacles on each."""

_EXAMPLE = {
    "effects": "jaxdrones.drag",
    "pairs": "jaxdrones.downwash",
    "team_effects": "a function (params, state) -> Wrench of the team",
    "rotors": "jaxdrones.instant_rotors",
    "integrator": "jaxdrones.rk4",
}
_ARGUMENTS = {
    "effects": ("params", "state"),
    "pairs": ("params", "state", "other", "other_state"),
    "team_effects": ("params", "state"),
    "rotors": ("params", "state", "command"),
    "integrator": ("derivative", "state", "dt"),
}
_ELSEWHERE = {
    "effects": "; wrenches by another drone belong to pairs, wrenches on the team to team_effects",
    "pairs": "; wrenches on one drone alone belong to effects",
}


class Loads(NamedTuple):
    """Wrenches and rates of a team at an instant; every array has a leading drone axis."""

    state: State
    """With the rotor speeds of this instant."""
    wrench: Wrench
    rpm_rate: Float[Array, "n 4"]
    aux_rate: dict[str, Any]


def check_function_of_step(name: str, function: Any) -> None:
    """Raise unless this is a function for the argument `name` of `make_step`."""
    given = bind(function, scene=None) if name == "effects" else function
    check_function(name, given, _ARGUMENTS[name], example=_EXAMPLE[name], hint=_ELSEWHERE.get(name, ""))
    if needs_of(function).contact == "obstacles" and not takes(function, "scene"):
        raise UserError(
            f"{name}: {describe([function])} has a bound scene; give that to make_step(scene=...), and the effect "
            "without it"
        )
    if contact := _undeclared_contact(function):
        called, wrapped = describe([function]), describe([contact])
        raise UserError(
            f"{name}: {called} calls {wrapped} and does not declare it, so long steps and fast drones would not be "
            f"detected; give functools.wraps({wrapped})({called})"
        )


def _check_functions(name: str, functions: Any) -> None:
    if callable(functions):
        example = f"({_EXAMPLE[name]},)"
        raise UserError(f"{name} is a single function, {functions!r}; give a sequence, for example {example}")
    sequence(_EXAMPLE[name], check_function_of_step)(name, functions)


def _check_model(name: str, model: Any) -> None:
    if not isinstance(model, Model):
        raise UserError(f"{name}: {model!r} is not a model; give jaxdrones.Model(name, init, rate)")


@checked
@dataclasses.dataclass(frozen=True)
class Physics:
    """Effects, models and rotors of a team, shared by both `make_step`."""

    effects: Annotated[Sequence[Effect], _check_functions] = ()
    pairs: Annotated[Sequence[Pair], _check_functions] = ()
    team_effects: Annotated[Sequence[TeamEffect], _check_functions] = ()
    models: Annotated[Sequence[Model], sequence("jaxdrones.Model(name, init, rate)", _check_model)] = ()
    rotors: Annotated[Rotors, check_function_of_step] = instant_rotors
    neighbors: NeighborGrid | None = None

    def __post_init__(self):
        names = [model.name for model in self.models]
        if len(set(names)) < len(names):
            raise UserError(f"models are named {', '.join(names)}; give each a name of its own")
        for name in "effects", "pairs", "team_effects", "models":
            functions = tuple(getattr(self, name))
            object.__setattr__(self, name, functions)
            if len({*map(id, functions)}) < len(functions):
                raise UserError(f"{name} are {describe(functions)}, one of them twice; give each once")
        if self.neighbors is not None and not self.pairs:
            raise UserError("neighbors is given without pairs, which it limits to nearby drones; leave it out")
        if not (self.neighbors is None or isinstance(self.neighbors, NeighborGrid)):
            raise UserError(
                f"neighbors is {self.neighbors!r}; give for example jaxdrones.NeighborGrid(cutoff=3.0), or leave it out"
            )

    def __str__(self) -> str:
        text = f"{describe([self.rotors])}, effects: {describe(self.effects)}, pairs: {describe(self.pairs)}"
        text += f", team effects: {describe(self.team_effects)}" if self.team_effects else ""
        text += f", models: {', '.join(model.name for model in self.models)}" if self.models else ""
        return text + (f", {self.neighbors}" if self.neighbors else "")

    @property
    def rotors_lag(self) -> bool:
        """Whether the rotors have the lag of `lagging_rotors`, also as a part of `pwm_rotors`."""
        return inspect.unwrap(self.rotors) in map(inspect.unwrap, (lagging_rotors, pwm_rotors))

    @property
    def takes_pwm(self) -> bool:
        """Whether commands are the PWM of `pwm_rotors`, also inside `failing`, in place of rotor speeds."""
        return inspect.unwrap(self.rotors) is inspect.unwrap(pwm_rotors)

    def check_lag(self, params: Params, dt: float) -> None:
        """Raise for rotors that lag by less than half a physics step (s): their speed would swing ever wider."""
        times = params.rotor_rise_time, params.rotor_fall_time
        lags = self.rotors_lag and all(map(is_concrete, times))
        if lags and dt > (largest := 2 * min(float(np.asarray(time).min()) for time in times)):
            raise UserError(
                f"the physics step is {dt:.4g} s and rotors that lag by {largest / 2:.2g} s are stable up to "
                f"{largest:.2g} s; give a shorter dt or more substeps, or rotors without a lag"
            )

    @functools.cached_property
    def _acting(self) -> set[str]:
        """Fields of wind and force on which the loads are known to depend."""
        return set()

    def check_acts(
        self, params: Params, state: State, scene: Scene, is_random: Callable[[str], Any] = lambda field: False
    ) -> None:
        """Raise for a wind or external force of a team, constant or random, on which no effect depends.

        Traced values that are not random pass; the scene may have shapes in place of arrays.
        """
        for field, example in ("wind", "drag"), ("external_force", "external_force"):
            value, random = getattr(params, field), bool(is_random(field))
            if field in self._acting or not (random or (is_concrete(value) and np.any(np.asarray(value)))):
                continue

            def loads(x: Array, scene: Scene, field: str = field) -> Loads:
                return self.loads(params.replace(**{field: x}), state, state.rpm, self.seen(scene))

            if not any(jax.tree.leaves(compiler.depends(loads, value, scene))):
                raise UserError(
                    f"there is a {'random' if random else 'constant'} {field}, and no effect depends on it; give an "
                    f"effect that does, for example effects=({example!r},), or leave out the {field}"
                )
            self._acting.add(field)

    @functools.cached_property
    def takes_scene(self) -> bool:
        """Whether an effect depends on obstacles."""
        return any(takes(effect, "scene") and not needs_of(effect).ground_only for effect in self.effects)

    def seen(self, scene: Scene) -> Scene:
        """Part of a scene that effects depend on."""
        return scene if self.takes_scene else Scene(ground=scene.ground)

    def contacts(self, *touched: str) -> list[Callable]:
        """Effects and pairs with declared contact with the `ground`, `obstacles` or `drones`."""
        return [f for f in (*self.effects, *self.pairs) if needs_of(f).contact in touched]

    def touches(self, scene: Scene) -> bool:
        """Whether drones touch the obstacles of a scene."""
        return scene.has_obstacles and bool(self.contacts("obstacles"))

    def init(self, params: Params, state: State) -> State:
        """State of a team, with missing model states initialized."""
        with explained_key_errors(params, state):
            fresh = {model.name: model.start(params, state) for model in self.models if model.name not in state.aux}
        return state.replace(aux=state.aux | fresh)

    def loads(
        self,
        params: Params,
        state: State,
        command: Float[Array, "n 4"],
        scene: Scene,
        contact: Contact | None = None,
    ) -> Loads:
        """Rotor speeds, wrenches and rates of a team; arguments are those of `wrench` and the commanded speeds."""
        with explained_key_errors(params, state):
            rpm, rpm_rate = self.rotor_speed(params, state, command)
            state = state.replace(rpm=rpm)
            aux_rate = {model.name: model.team_rate(params, state, command) for model in self.models}
            wrench = self.wrench(params, state, scene, contact) + jax.vmap(rotor_reaction)(params, state, rpm_rate)
        return Loads(state, wrench, rpm_rate, aux_rate)

    def rotor_speed(
        self, params: Params, state: State, command: Float[Array, "n 4"]
    ) -> tuple[Float[Array, "n 4"], Float[Array, "n 4"]]:
        """Rotor speeds of a team and their rates, RPM and RPM/s."""
        for model in self.models:
            if model.name not in state.aux:
                raise UserError(
                    f"state.aux lacks {model.name!r}, the state of a model; start from step.init(params, state)"
                )
        with explained_key_errors(params, state):
            speeds = jax.vmap(self.rotors)(params, state, command)
        if jax.tree.map(np.shape, speeds) != (command.shape, command.shape):
            returned = jax.tree.map(lambda x: np.shape(x)[1:], speeds)
            raise UserError(
                f"rotors: {describe([self.rotors])} returned arrays of shape {returned}; return a tuple of the speeds "
                "(4,), RPM, and their rates (4,), RPM/s"
            )
        return speeds

    def at_speed(self, params: Params, state: State, command: Float[Array, "n 4"]) -> State:
        """State of a team with rotors without a lag at their commanded speed."""
        speed, _ = self.rotor_speed(params, state, command)
        return state if speed is state.rpm else jax.vmap(with_rotor_speed)(params, state, speed)

    def wrench(self, params: Params, state: State, scene: Scene, contact: Contact | None = None) -> Wrench:
        """Sum of the rotors' aerodynamic wrench and of all effects of a team, one row per drone.

        `contact` is an optional faster implementation of the team's contact with obstacles.
        """
        contacts = self.contacts("obstacles")
        effects = [effect for effect in self.effects if effect not in contacts]

        def alone(params: Params, state: State) -> Wrench:
            own = (check_wrench("effects", f, bind(f, scene=scene)(params, state)) for f in effects)
            return sum(own, rotor_wrench(params, state))

        wrench = jax.vmap(alone)(params, state)
        if contact is not None:
            wrench += contact(params, state)
        elif scene.has_obstacles:
            wrench = sum((jax.vmap(bind(f, scene=scene))(params, state) for f in contacts), wrench)
        of_team = (check_wrench("team_effects", f, f(params, state), len(state.pos)) for f in self.team_effects)
        wrench = sum(of_team, wrench)
        state = side_by_side(state) if self.contacts("drones") else state
        return sum((from_others(pair, params, state, self.neighbors) for pair in self.pairs), wrench)


def _undeclared_contact(function: Callable) -> Callable | None:
    """Contact effect that a function, a method or an object names without being declared as contact."""
    if needs_of(function).contact:
        return None
    values: list[Any] = []
    for layer in layers(function):
        called = layer if inspect.isroutine(layer) else layer.__call__
        if inspect.isfunction(called) or inspect.ismethod(called):
            named = inspect.getclosurevars(called)
            values += [*named.nonlocals.values(), *named.globals.values()]
            values += [vars(x).get(name) for x in values if inspect.ismodule(x) for name in named.unbound]
    return next((x for x in values if callable(x) and needs_of(x).contact), None)

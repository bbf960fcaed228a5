"""Fixed programs of track.py and options.py, with their definitions and compiler options."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

import jaxdrones as jd
from benchmarks import cameras, throughput
from benchmarks.cameras_scenes import objects20, poses
from benchmarks.common import first_call
from jaxdrones.cli.throughput import crazyflies, episodes, held
from jaxdrones.envs import make
from jaxdrones.learning import compilation
from jaxdrones.training import presets
from jaxdrones.training.algorithms import ALGORITHMS, learner

WORLDS = 1024
DRONE_STEP, ENV_STEP, IMAGE, UPDATE = "ns a drone-step", "ns an env-step", "us an image", "ms an update"
SCALES = {DRONE_STEP: 1e9, ENV_STEP: 1e9, IMAGE: 1e6, UPDATE: 1e3}


class Made(NamedTuple):
    """A function of arrays that can be traced, its arguments, and how the package compiles it."""

    function: Callable
    arguments: Sequence[Any]
    compiling: Callable[[Callable], Callable] = jax.jit


@dataclasses.dataclass(frozen=True)
class Program:
    """What a program computes in a call, and how often."""

    definition: str
    unit: str
    times: int
    """Steps, images or updates of a call."""
    make: Callable[[], Made]

    def value(self, seconds: float) -> float:
        """The time of a call in the unit."""
        return seconds * SCALES[self.unit] / self.times


def plant(drones: int, steps: int, gradient: bool = False, vmap: bool = False) -> Program:
    """Crazyflies with constant rotor speeds, or the gradient of the final position in those of every step."""
    pairs = (jd.downwash,) if drones > 1 else ()

    def make() -> Made:
        step = jd.make_step(effects=(jd.drag,), pairs=pairs)
        params, starts, rpm = crazyflies(WORLDS, drones)
        world = held(step, params, steps)
        if gradient:
            world = jax.value_and_grad(throughput.miss(step, params), 1)
            rpm = jnp.repeat(rpm[:, None], steps, axis=1)
        if vmap:
            return Made(jax.vmap(world), (starts, rpm))
        return Made(jd.over_worlds(world), (starts, rpm), lambda function: function)

    what = f"{drones} drones with downwash" if drones > 1 else "one drone"
    definition = (
        f"{what} and drag, semi-implicit Euler, {steps} steps of 1/240 s, {WORLDS} worlds by "
        f"{'jax.vmap' if vmap else 'over_worlds'}{', forward and backward' * gradient}"
    )
    return Program(definition, DRONE_STEP, WORLDS * drones * steps, make)


def environment(realistic: bool, steps: int = 50) -> Program:
    def make_it() -> Made:
        fly, begun = episodes(make("hover", realistic=realistic), WORLDS, steps)
        return Made(fly, (begun, jax.random.key(3)))

    definition = f"{'realistic ' * realistic}hover with random actions and autoreset, {steps} steps of {WORLDS} worlds"
    return Program(definition, ENV_STEP, WORLDS * steps, make_it)


def update(algorithm: str) -> Program:
    def make_it() -> Made:
        trained_by = learner(algorithm)
        env, config = presets.preset("hover", algorithm)
        state = jax.jit(lambda key: trained_by.init(key, env, config))(jax.random.key(0))
        compiling = functools.partial(compilation.jit, env=env, config=config)
        return Made(functools.partial(trained_by.update, env, config), (state,), compiling)

    return Program(f"the first update of hover by {algorithm}, with the settings of its preset", UPDATE, 1, make_it)


def camera() -> Program:
    def make_it() -> Made:
        seen = jd.Camera(resolution=(64, 48), field_of_view=80, far=12.0)
        look = functools.partial(cameras.render, seen, ("depth",), objects20())
        return Made(jax.vmap(look), (poses(WORLDS),))

    return Program(f"depth of 64 x 48, scene A of `cameras`, {WORLDS} cameras", IMAGE, WORLDS, make_it)


PROGRAMS: dict[str, Program] = {
    "plant": plant(1, 1000),
    "plant by vmap": plant(1, 1000, vmap=True),
    "plant with gradient": plant(1, 100, gradient=True),
    "camera": camera(),
    "hover": environment(realistic=False),
    "eight drones": plant(8, 20),
    **{f"{algorithm} update": update(algorithm) for algorithm in ALGORITHMS},
    "realistic hover": environment(realistic=True),
    "eight drones with gradient": plant(8, 10, gradient=True),
}
"""Those that compile fast come first, for a comparison whose time is limited."""

COMPILED = tuple(f"{algorithm} update" for algorithm in ALGORITHMS)
"""Programs whose compilation is measured, too."""


class Programs:
    """The programs, each compiled when it is first needed."""

    def __init__(self) -> None:
        self._made: dict[str, Made] = {}
        self._compiled: dict[str, Callable] = {}

    def compile(self, name: str) -> float:
        """Seconds to trace and compile it anew, and for the first call."""
        if name in self._compiled:
            jax.clear_caches()
        else:
            self._made[name] = PROGRAMS[name].make()
        function, arguments, compiling = self._made[name]
        self._compiled[name] = compiling(function)
        return first_call(self._compiled[name], *arguments)

    def call(self, name: str) -> object:
        """Results of a call."""
        if name not in self._compiled:
            self.compile(name)
        return self._compiled[name](*self._made[name].arguments)

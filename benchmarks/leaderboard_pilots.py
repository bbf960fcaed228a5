"""Pilots of the leaderboard, and their tuning or training in the nominal scenario.

All are policies with the action type `rpm`. A controller is tuned by random search for the factors of its gains with
the highest success rate, and among equal ones the smallest error, from the starts for tuning. iLQR and MPPI have the
default weights or those tuned for LQR, MPC the default weights.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxdrones as jd
from benchmarks.leaderboard_scenarios import SETPOINT, TRAINING, TUNING, Scenario, flight
from jaxdrones import assets
from jaxdrones.control import Setpoint, firmware_pid, geometric, mellinger, pid
from jaxdrones.envs import Env
from jaxdrones.envs.observations import last_actions
from jaxdrones.learning import evaluate
from jaxdrones.learning.policies import make_policy
from jaxdrones.optimal import ilqr, lqr, mppi, weights
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.state import State
from jaxdrones.training.algorithms import learner
from jaxdrones.training.presets import preset

_WIDTHS = (8.0, 2.5)  # largest factor of a gain in the first and in the second half of the search
PLANNED_STARTS = 8  # flights of tuning of a planner
_GAINS = {
    pid: ("pos_p", "pos_i", "pos_d", "rpy_p", "rpy_d"),
    firmware_pid: ("pos_p", "vel_p", "vel_i", "attitude_p", "rate_p", "rate_d"),
    geometric: ("pos", "vel", "attitude", "rate"),
    mellinger: ("pos_p", "pos_i", "pos_d", "attitude_p", "rate_p", "rate_d"),
    lqr: ("pos", "attitude", "vel", "omega", "command"),
}
_LEARNED = ("position_error", "rotation_matrix", "velocity_error", "omega", "rotor_speed", "last_action")
"""What learned policies observe: the same as controllers."""


class Obtained(NamedTuple):
    """A pilot for a scenario, and what it cost."""

    policy: Any
    seconds: float
    """Processor time of tuning or training, with compilation, s."""
    flown: float
    """Simulated flight in it, s."""
    settings: str = ""
    """What was found."""


@dataclasses.dataclass(frozen=True)
class Pilot:
    """A pilot and how it flies."""

    obtain: Callable[[Scenario, Pilot], Obtained]
    """(nominal scenario, pilot) -> policy."""
    hz: int = 100
    """Commands per second."""
    starts: int = 1000
    """Scored starts, the first ones of 1,000."""
    horizon: int = -1
    """Control steps whose setpoints a controller observes; -1 for a policy with observations of its own."""
    realistic: bool = False
    """Whether a policy is trained with drawn constants, noise and delays of 0 to 50 ms, and observes five actions."""
    action: str = "rpm"
    """Action type."""
    needs: str = ""
    """Optional library."""
    candidates: int = 48
    """Sets of gains in the tuning."""
    tuning_starts: int = 128
    """Flights of each set: together as many seconds as `bptt` flies in training, within a third."""

    def observation(self, scenario: Scenario) -> tuple:
        """Observation terms in a scenario."""
        if self.horizon >= 0:
            return (flight(self.horizon),)
        if self.realistic:
            return (*_LEARNED[:-1], last_actions(5))
        return (*_LEARNED, "preview") if scenario.task == "tracking" else _LEARNED

    def env(self, scenario: Scenario) -> Env:
        """Environment of a scenario as this pilot flies it."""
        return scenario.env(self.hz, self.observation(scenario), self.action)


class Controller(PyTreeNode):
    """Controller as a policy of the observation `flight`."""

    gains: Any
    """Gains, or settings of an optimal controller."""
    params: Params
    """Nominal parameters of one drone."""
    memory: Any
    """Memory of one drone at the start of an episode."""
    module: ModuleType = flax.struct.field(pytree_node=False)
    dt: float = flax.struct.field(pytree_node=False)

    def initial_hidden_state(self, batch: tuple[int, ...]) -> Any:
        """Memory of every drone."""
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (*batch, *jnp.shape(x))), self.memory)

    def act(self, hidden_state: Any, obs: Float[Array, "n d"]) -> tuple[Any, Float[Array, "n 4"]]:
        """Memory after the observations, and actions."""
        return jax.vmap(self._act)(hidden_state, obs)

    def _act(self, memory: Any, obs: Float[Array, " d"]) -> tuple[Any, Float[Array, "4"]]:
        state, setpoints = seen(obs)
        if not hasattr(self.gains, "horizon"):
            setpoints = jax.tree.map(lambda x: x[0], setpoints)
        memory, rpm = self.module.control(self.gains, self.params, memory, state, setpoints, dt=self.dt)
        return memory, action_of(self.params, rpm)


def seen(obs: Float[Array, " d"]) -> tuple[State, Setpoint]:
    """State and setpoints in an observation `flight` of one drone."""
    state = jnp.split(obs[:17], (3, 7, 10, 13))
    pos, vel, acc, yaw, omega = jnp.split(obs[17:].reshape(-1, SETPOINT), (3, 6, 9, 10), axis=-1)
    return State(*state), Setpoint(pos, vel, acc, yaw[:, 0], omega)


def action_of(params: Params, rpm: Float[Array, "4"]) -> Float[Array, "4"]:
    """Action of the type `rpm` that commands rotor speeds."""
    above = rpm - params.hover_rpm
    return above / jnp.where(above > 0, params.max_rpm - params.hover_rpm, params.hover_rpm)


def nothing(scenario: Scenario, pilot: Pilot) -> Obtained:
    """Rotors at hover speed, whatever is observed."""
    return Obtained(lambda obs: jnp.zeros((len(obs), 4)), 0.0, 0.0)


def merit(env: Env, policy: Any, flights: int) -> tuple[float, float]:
    """Success in flights from the starts of tuning, and of equals the negative error."""
    came = evaluate(env, policy, jax.random.key(TUNING), flights)
    return came.success, -came.rms_error if np.isfinite(came.rms_error) else -np.inf


def tuned(module: ModuleType) -> Callable[[Scenario, Pilot], Obtained]:
    """Controller with gains, or LQR with weights, from a random search."""

    def obtain(scenario: Scenario, pilot: Pilot) -> Obtained:
        began = time.process_time()
        env, names = pilot.env(scenario), _GAINS[module]
        make = controller(module, env)
        rng = np.random.default_rng(TUNING)
        best, score = np.ones(len(names)), (-1.0, 0.0)
        for width in _WIDTHS:
            center = best
            for i in range(pilot.candidates // len(_WIDTHS)):
                factors = center * np.exp(rng.uniform(-1, 1, len(names)) * np.log(width)) if i else center
                found = merit(env, make(factors), pilot.tuning_starts)
                if found > score:
                    best, score = factors, found
        said = ", ".join(f"{name} {factor:.2g}" for name, factor in zip(names, best, strict=True))
        flown = pilot.candidates * pilot.tuning_starts * env.steps * env.dt
        return Obtained(make(best), time.process_time() - began, flown, f"gains times {said}")

    return obtain


def controller(module: ModuleType, env: Env) -> Callable[[np.ndarray], Controller]:
    """Function from the factors of its gains to a controller for the nominal vehicle."""
    params = jax.tree.map(lambda x: x[0], env.params)
    names = _GAINS[module]
    if module is lqr:
        state = jax.tree.map(lambda x: x[0], env.reset(jax.random.key(TUNING))[1].drones)
        solve = jax.jit(lambda settings: lqr.init(settings, params, state))
    nominal = module.gains(params) if module in (firmware_pid, mellinger) else getattr(module, "gains", weights)()

    def make(factors: np.ndarray) -> Controller:
        scaled = {name: getattr(nominal, name) * float(x) for name, x in zip(names, factors, strict=True)}
        gains = nominal.replace(**scaled)
        if module is not lqr:
            return Controller(gains, params, module.init(), module, env.dt)
        settings = lqr.settings(env.physics, gains)
        return Controller(settings, params, solve(settings), lqr, env.dt)

    return make


def planner(module: ModuleType) -> Callable[[Scenario, Pilot], Obtained]:
    """Optimal controller that plans at every step, with the weights of the package or those tuned for LQR.

    A search as that of controllers would take hours, so the better of the two in a few flights is taken.
    """

    def obtain(scenario: Scenario, pilot: Pilot) -> Obtained:
        began = time.process_time()
        env = pilot.env(scenario)
        regulator = tuned(lqr)(scenario, dataclasses.replace(pilot, horizon=2))
        params = regulator.policy.params
        state = jax.tree.map(lambda x: x[0], env.reset(jax.random.key(TUNING))[1].drones)
        key = (jax.random.key(TRAINING),) if module is mppi else ()
        init, scores = jax.jit(module.init), {}
        for name, chosen in (("of the package", weights()), ("of lqr", regulator.policy.gains.weights)):
            settings = module.settings(env.physics, chosen)
            policy = Controller(settings, params, init(settings, params, state, *key), module, env.dt)
            scores[name] = (merit(env, policy, PLANNED_STARTS), policy)
        name = max(scores, key=lambda name: scores[name][0])
        flown = regulator.flown + 2 * PLANNED_STARTS * env.steps * env.dt
        return Obtained(scores[name][1], time.process_time() - began, flown, f"weights {name}")

    return obtain


class Mpc:
    """MPC by CasADi, called on the host."""

    def __init__(self, env: Env):
        from jaxdrones.optimal.mpc import Mpc as Solver
        from jaxdrones.optimal.twin import casadi_model

        params = jax.tree.map(lambda x: x[0], env.params)
        rotors = jd.lagging_rotors
        self.solver = Solver(casadi_model(params.replace(aux={}), [jd.drag], rotors=rotors), env.dt)
        self._read = jax.jit(lambda obs: seen(obs[0]))
        self._action = jax.jit(lambda rpm: action_of(params, rpm)[None])

    def initial_hidden_state(self, batch: tuple[int, ...]) -> None:
        """Forget the plan of the last flight."""
        self.solver.reset()

    def act(self, hidden_state: None, obs: Array) -> tuple[None, Array]:
        """Action of the first command of a plan."""
        rpm = self.solver(*self._read(obs))
        return None, self._action(jnp.asarray(rpm, jnp.float32))


def by_casadi(scenario: Scenario, pilot: Pilot) -> Obtained:
    """Twin and solver of MPC."""
    began = time.process_time()
    return Obtained(Mpc(pilot.env(scenario)), time.process_time() - began, 0.0)


def trained(algorithm: str) -> Callable[[Scenario, Pilot], Obtained]:
    """Policy of a learner with the preset of the task, one seed."""

    def obtain(scenario: Scenario, pilot: Pilot) -> Obtained:
        began = time.process_time()
        settings = scenario.settings(pilot.hz, pilot.observation(scenario)) | dict(scenario.options)
        env, config = preset(scenario.task, algorithm, pilot.realistic, practice=True, **settings)
        policy = jax.block_until_ready(learner(algorithm).train(jax.random.key(TRAINING), env, config).policy)
        flown = config.updates * config.worlds * config.horizon * env.dt
        return Obtained(policy, time.process_time() - began, flown, f"seed {TRAINING}")

    return obtain


def raptor(scenario: Scenario, pilot: Pilot) -> Obtained:
    """RAPTOR as published."""
    return Obtained(make_policy("raptor", pilot.env(scenario)), 0.0, 0.0)


def any_vehicle(scenario: Scenario, pilot: Pilot) -> Obtained:
    """The bundled policy for all vehicles, with the cost of its training."""
    report = json.loads((assets.folder() / "any-vehicle" / "report.json").read_bytes())
    env, trainings = pilot.env(scenario), (report["first_training"], report)
    configs = [training["recipe"]["config"] for training in trainings]
    flown = env.dt * sum(config["updates"] * config["worlds"] * config["horizon"] for config in configs)
    seconds = sum(sum(training["seconds"].values()) for training in trainings)
    return Obtained(make_policy("any-vehicle", env), seconds, flown, "seed 0")


PILOTS: dict[str, Pilot] = {
    "nothing": Pilot(nothing),
    "pid": Pilot(tuned(pid), horizon=0),
    "firmware-pid": Pilot(tuned(firmware_pid), hz=500, horizon=0),
    "geometric": Pilot(tuned(geometric), horizon=0),
    "mellinger": Pilot(tuned(mellinger), hz=500, horizon=0),
    "lqr": Pilot(tuned(lqr), horizon=2),
    "ilqr": Pilot(planner(ilqr), horizon=25, starts=24),
    "mppi": Pilot(planner(mppi), horizon=24, starts=50),
    "mpc": Pilot(by_casadi, hz=50, horizon=20, starts=10, needs="casadi"),
    "ppo": Pilot(trained("ppo")),
    "shac": Pilot(trained("shac")),
    "bptt": Pilot(trained("bptt")),
    "bptt-random": Pilot(trained("bptt"), realistic=True),
    "raptor": Pilot(raptor, action="throttle", needs="foundation_policy"),
    "any-vehicle": Pilot(any_vehicle, action="throttle"),
}

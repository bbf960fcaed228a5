"""Do policies trained with `realistic` fly plants that were not in the training?

Hover policies are trained in jaxdrones and flown without further training on
  own        jaxdrones with `realistic`: lag, drag, delay, noise, random parameters in every episode;
  delay      the same with a delay of 0, 10, 20, 30 and 40 ms in all episodes;
  bullet     the same with Bullet, contacts and the damping of gym-pybullet-drones (2021), 0.04 1/s; 25 drones, 3 m
             apart, share a world;
  crazyflow  crazyflow 0.4.0, in a separate environment: its airframes, thrust curves, rotors, drag, rate and
             integrator, with the delay and noise of `realistic`. An action commands the same fraction of the hover
             speed as in training: the environment uses only mass and hover speed of the airframe.
Starts, observations, delay, noise and the criterion (within 5 cm and 0.1 m/s for the last two of five seconds) are
computed by the same code, an environment with other physics. The result for crazyflow counts only if constant rotor
speeds give the same flight in both simulators.
"""

import argparse
import dataclasses
import importlib.metadata
import importlib.util
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np

import jaxdrones as jd
from benchmarks.common import outcome, success_rate
from benchmarks.rivals import environment
from jaxdrones.checks import check_choice
from jaxdrones.engine.step import Step
from jaxdrones.envs import Env
from jaxdrones.learning import evaluate
from jaxdrones.learning.evaluation import wilson_interval
from jaxdrones.training.algorithms import ALGORITHMS, learner
from jaxdrones.training.episode import fly_episode
from jaxdrones.training.recipe import Recipe
from jaxdrones.training.run import Run

PLANTS = ("own", "delay", "bullet", "crazyflow")
DAMPING = 0.04  # 1/s, of gym-pybullet-drones (2021)
TEAM = 25  # drones of a Bullet world
SEED = 1_000_000  # of the episodes: the same for every policy
DELAYS = (0, 10, 20, 30, 40)  # ms, those that `realistic` draws
AGREED = 1e-9  # m, m/s, rad/s, RPM: largest difference that is rounding


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--policy", nargs="*", type=Path, help="folders of `jaxdrones train hover --realistic`")
    parser.add_argument("--algo", default="bptt", help="trains, where no policy is given: " + ", ".join(ALGORITHMS))
    parser.add_argument("--seeds", type=int, default=3, help="how many to train")
    parser.add_argument("--updates", type=int, help="instead of the preset's")
    parser.add_argument("--plants", nargs="*", default=("own", "bullet", "crazyflow"), help=", ".join(PLANTS))
    parser.add_argument("--airframes", nargs="*", help="of crazyflow; all its Crazyflies when left out")
    parser.add_argument("--episodes", type=int, default=2000, help="of a policy on each plant")
    parser.add_argument("--bullet-episodes", type=int, default=200, help="of a policy on Bullet")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    for plant in options.plants:
        check_choice("plant", plant, PLANTS)
    changes = {} if options.updates is None else {"updates": options.updates}
    if options.quick:
        changes = dict(updates=2, worlds=8, horizon=4)
        options.seeds, options.episodes, options.bullet_episodes, options.plants = 1, 2, 2, ("own", "bullet")

    with tempfile.TemporaryDirectory() as folder:
        runs = [Run(path) for path in options.policy or trained(options, changes, Path(folder))]
        result = measure(runs, options)
    lines = [f"{name}: {value}" for name, value in result["crazyflow"].items()]
    lines.append("plant                | policy       | episodes | success [95 % interval]  | error cm p50    p99")
    lines += [
        f"{row['plant']:20} | {row['policy']:12} | {row['episodes']:8} |"
        f" {success_rate(row['success'], row['interval']):24} |"
        f" {100 * row['error p50']:12.2f} {100 * row['error p99']:6.2f}"
        for row in result["rows"]
    ]
    return result, lines


def trained(options, changes: dict, folder: Path) -> Iterator[Path]:
    """Train one policy per seed."""
    recipe = Recipe.of("hover", options.algo, realistic=True, **changes)
    env = recipe.env(practice=True)
    for seed in range(options.seeds):
        run = Run(folder / f"seed {seed}")
        policy = learner(options.algo).train(jax.random.key(seed), env, recipe.config).policy
        run.save_policy("best", policy, recipe=recipe.as_dict())
        yield run.folder


def measure(runs: list[Run], options) -> dict:
    """A row per plant and policy."""
    recipe, rows, crazyflow = runs[0].recipe(), [], {}
    for plant in options.plants:
        if plant == "crazyflow" and importlib.util.find_spec("crazyflow") is None:
            there = flown_elsewhere(runs, options)
            rows, crazyflow = rows + there["rows"], there["crazyflow"]
            continue
        if plant == "crazyflow":
            crazyflow = checked_crazyflow()
        rows += FLOWN[plant](recipe, runs, options)
    return {"crazyflow": crazyflow, "rows": rows}


def on_own(recipe: Recipe, runs: list[Run], options) -> list[dict]:
    env = recipe.env()
    return [flown("own", run, env, options.episodes) for run in runs]


def with_delays(recipe: Recipe, runs: list[Run], options) -> list[dict]:
    envs = {delay: recipe.env(delay=delay / 1000) for delay in DELAYS}
    return [flown(f"own, delay {delay} ms", run, env, options.episodes) for delay, env in envs.items() for run in runs]


def on_bullet(recipe: Recipe, runs: list[Run], options) -> list[dict]:
    from jaxdrones.engine import bullet  # not in the environment of the rivals

    env = recipe.env(drones=min(TEAM, options.bullet_episodes))
    substeps = env.task.substeps
    physics = dict(effects=(jd.drag,), rotors=jd.lagging_rotors, dt=env.dt / substeps, substeps=substeps)
    with bullet.make_step(**physics, scene=env.task.scene, damping=DAMPING) as step:
        env = with_physics(env, step)
        return [flown_in_teams(f"bullet, damping {DAMPING}", run, env, options.bullet_episodes) for run in runs]


def on_crazyflow(recipe: Recipe, runs: list[Run], options) -> list[dict]:
    from benchmarks.rivals import crazyflow  # only in the environment of the rivals

    rows = []
    nominal = jax.tree.map(lambda x: x[0], recipe.env().params)
    for airframe in options.airframes or crazyflow.AIRFRAMES:
        sim = crazyflow.make_sim(airframe)
        env = recipe.env(vehicle=crazyflow.calibrated(airframe, nominal), randomize=())
        env = with_physics(env, Elsewhere(env.physics, crazyflow.make_step(sim, substeps=round(env.dt * sim.freq))))
        rows += [flown(f"crazyflow {airframe}", run, env, options.episodes) for run in runs]
    return rows


FLOWN = {"own": on_own, "delay": with_delays, "bullet": on_bullet, "crazyflow": on_crazyflow}


def flown(plant: str, run: Run, env: Env, episodes: int) -> dict:
    """How a policy flies many worlds at once."""
    came = evaluate(env, run.policy(env=env), jax.random.key(SEED), episodes)
    return {"plant": plant, "policy": run.folder.name, "episodes": episodes} | outcome(came)


def flown_in_teams(plant: str, run: Run, env: Env, episodes: int) -> dict:
    """How a policy flies one world after the other; each drone of a team is an episode."""
    policy, success, error = run.policy(env=env), [], []
    for key in jax.random.split(jax.random.key(SEED), -(-episodes // env.drones)):
        flight = fly_episode(env, policy, key)
        whole = len(flight.t) == env.steps  # else one was lost, and all of its team count as failures
        success += list(whole & env.task.success(flight.metrics, env.dt))
        error += list(flight.metrics["error"][-1])
    n = len(success)
    found = {"success": float(np.mean(success)), "interval": wilson_interval(int(sum(success)), n)}
    found |= {f"error p{q}": float(np.percentile(error, q)) for q in (50, 99)}
    return {"plant": plant, "policy": run.folder.name, "episodes": n} | found


class Elsewhere(Step):
    """Step of another simulator in an environment without sensors, which would need its derivative."""

    def __init__(self, own: Step, step: Callable[[jd.Params, jd.State, jax.Array], jd.State]):
        self.physics, self._step = own.physics, step

    def __call__(self, params, state, rpm, scene=None):
        """Advance a team by one control step; the other simulator has its own parameters and no scene."""
        return self._step(params, state, rpm).replace(aux=state.aux)

    def rate(self, params, state, rpm, scene=None):
        """Unknown."""
        raise NotImplementedError("the derivative is inside of the other simulator")


def with_physics(env: Env, step: Step) -> Env:
    """The same environment on another plant."""
    return dataclasses.replace(env, physics=step)


def checked_crazyflow() -> dict:
    """Versions, and how far apart the same flight ends on both sides.

    Raises:
        RuntimeError: further than rounding, so frames, units or rotors are not what is taken for granted here.
    """
    from benchmarks.rivals import crazyflow

    apart = crazyflow.agreement()
    if not all(x <= AGREED for x in apart.values()):
        raise RuntimeError(f"crazyflow and our plant do not fly alike: {apart}; the interface is wrong")
    versions = {name: importlib.metadata.version(name) for name in ("crazyflow", "jax")}
    return {"crazyflow": versions, "the same flight ends apart by": apart}


def flown_elsewhere(runs: list[Run], options) -> dict:
    """The same file, in the environment of the rivals."""
    airframes = ["--airframes", *options.airframes] if options.airframes else []
    folders = [str(run.folder.resolve()) for run in runs]
    episodes = ["--episodes", str(options.episodes)]
    return environment.run(
        "benchmarks", "transfer", "--json", "--plants", "crazyflow", *episodes, *airframes, "--policy", *folders
    )

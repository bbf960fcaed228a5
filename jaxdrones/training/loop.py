"""The loop around a learner's `update`: progress, evaluations, checkpoints, and going on where it stopped."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.accelerate.compiler import training_options
from jaxdrones.learning import sharding
from jaxdrones.learning.evaluation import Report, check_episodes, evaluate, wilson
from jaxdrones.learning.networks import Policy
from jaxdrones.limits import LARGEST_COUNT, check_memory
from jaxdrones.training import hosts
from jaxdrones.training.presets import ALGORITHMS
from jaxdrones.training.runs import Progress, Recipe, Run, as_dict, size_of

EVALUATIONS = 10  # in the course of training
_LONGEST_CALL = 64  # updates
_CALL = 0.3  # s that a call takes about; Ctrl-C waits for it
_SAVE = 30.0  # s between training states, at most
_PATIENCE = 10  # updates in a row that are not finite
_PROBE = 4  # times the size of the training state that must fit on the disk
_NEAR = 1.0  # standard errors within which two shares of successes are the same but for chance
CHOICE, REPORT = 2**31, 2**31 + 1  # what a seed's key is folded with; splitting it gives what 0, 1, 2, ... give
_EVALUATED = ("success", "evaluated_return", "evaluated_error")

Tell = Callable[[int, dict[str, float]], None]
"""Is told the number of updates made and the newest numbers."""


Score = tuple[float, float]
"""Share of successes, and return, of an evaluation."""


class Diverged(RuntimeError):
    """Training came to numbers that are not finite."""


class Trainer:
    """The compiled programs of a recipe; all seeds share them, and all devices of all hosts the worlds."""

    def __init__(self, recipe: Recipe, episodes: int = 1000):
        """Prepare; nothing is compiled yet.

        Args:
            recipe: what to train.
            episodes: of an evaluation.

        Raises:
            ValueError: the devices cannot share the worlds equally, or have too little memory for them.
        """
        self.recipe, self.episodes = recipe, episodes
        self.mesh = sharding.devices(recipe.config.worlds)
        self.env, self.practice = recipe.env(), recipe.env(practice=True)
        self.learner = ALGORITHMS[recipe.algorithm]
        self.compile_seconds = 0.0
        self.shapes = jax.eval_shape(self._init, jax.random.key(0))
        check_episodes(self.env, episodes)
        self._check_memory()
        self.metrics = sorted(jax.eval_shape(self._one, self.shapes)[1])

    def compile(self) -> None:
        """Compile what trains; once."""
        start = time.perf_counter()
        count = jnp.zeros((), jnp.int32)
        placed, same = sharding.layout(self.mesh, self.shapes), sharding.everywhere(self.mesh)
        init = jax.jit(self._init, in_shardings=same, out_shardings=placed)
        updates = jax.jit(self._updates, in_shardings=(placed, same, same), out_shardings=(placed, same))
        with jax.set_mesh(self.mesh):
            self.start = init.lower(jax.random.key(0)).compile(training_options())
            self._advance = updates.lower(self.shapes, count, count).compile(training_options())
        self.compile_seconds = time.perf_counter() - start

    def prepare(self, run: Run) -> None:
        """See that a run can be written.

        Raises:
            OSError: it cannot.
        """
        run.prepare(_PROBE * size_of(self.shapes))

    def check(self, run: Run) -> None:
        """See that training can go on from what a run holds.

        Raises:
            FileNotFoundError: a file is missing.
            ValueError: a file is damaged, or they are not of one run.
        """
        self._held(run)
        run.history()

    def fit(self, seconds: float, made: int = 0) -> None:
        """Choose the number of updates: so many as were `made`, and what takes about so many seconds."""
        state, _ = self.advance(self.start(jax.random.key(0)), 1)
        start = time.perf_counter()
        self.advance(state, 3)
        pace = (time.perf_counter() - start) / 3
        updates = min(made + max(1, int(hosts.agreed(seconds / pace))), LARGEST_COUNT)
        self.recipe = dataclasses.replace(self.recipe, config=dataclasses.replace(self.recipe.config, updates=updates))

    def advance(self, state, updates: int):
        """Make some updates in one call: the state after them, and (updates,) of every metric."""
        total = jnp.asarray(self.recipe.config.updates, jnp.int32)
        state, metrics = self._advance(state, jnp.asarray(updates, jnp.int32), total)
        return state, {name: np.asarray(x)[:updates] for name, x in metrics.items()}

    def train(self, run: Run, seed: int, tell: Tell) -> None:
        """Train to the end, from the start or from the state that the run holds; evaluate the best policy.

        Args:
            run: a folder that was prepared.
            seed: of all that is random.
            tell: progress.

        Raises:
            Diverged: numbers that are not finite; the best policy so far is kept.
            KeyboardInterrupt: as it came; the state is saved, unless other hosts would have to help.
        """
        course = _Course(self, run, seed)
        run.drop_report()
        course.save()
        try:
            course.go(tell)
        except KeyboardInterrupt:
            if jax.process_count() == 1:
                course.save()
            raise
        course.finish()

    def _held(self, run: Run) -> tuple[Any, float, Score, float]:
        """State, seconds trained, score of the best policy and highest success of a run that was begun."""
        state = run.load_state(self.shapes)
        if not _finite(state):
            raise ValueError(f"{run.folder / 'state'} holds numbers that are not finite; train anew with --overwrite")
        run.policy("best", self.env)
        for entry in ("seed", "episodes"):
            if run.told("best", entry) != run.told("state", entry):
                raise _of_two_runs(run)
        if _begun(run.told("best", "recipe")) != _begun(run.told("state", "recipe")):
            raise _of_two_runs(run)
        score = tuple(run.told("best", "score"))
        return state, run.told("state", "seconds"), score, max(score[0], run.told("state", "highest"))

    def _check_memory(self) -> None:
        """Raise if the worlds, and what they observe and do in an update, are more than there is memory for."""
        config, env = self.recipe.config, self.env
        numbers = config.worlds * config.horizon * env.drones * (env.observation_size + env.action_size)
        size = size_of(self.shapes) + numbers * jnp.zeros(()).dtype.itemsize
        what = f"a training of {config.worlds} worlds x {config.horizon} control steps x {env.drones} drones"
        check_memory(what, size // jax.process_count(), "give fewer worlds, a shorter horizon or smaller networks")

    def _init(self, key: jax.Array):
        return self.learner.init(key, self.practice, self.recipe.config)

    def _one(self, state, updates=None):
        config = self.recipe.config
        if updates is not None:
            config = dataclasses.replace(config, updates=updates)
        return self.learner.update(self.practice, config, state)

    def _updates(self, state, count, updates):
        """`count` updates of a training that has `updates`; both may change without compiling anew."""
        metrics = jax.tree.map(
            lambda x: jnp.zeros((_LONGEST_CALL, *x.shape), x.dtype), jax.eval_shape(self._one, state)[1]
        )

        def one(i, carry):
            state, metrics = carry
            state, new = self._one(state, updates)
            return state, jax.tree.map(lambda all, x: all.at[i].set(x), metrics, new)

        return jax.lax.fori_loop(0, count, one, (state, metrics))


class _Course:
    """One seed's training: where it is, and what it has come to."""

    def __init__(self, trainer: Trainer, run: Run, seed: int):
        """At the start, or where the run stopped."""
        self.trainer, self.run, self.config = trainer, run, trainer.recipe.config
        self.key = jax.random.key(seed)
        self.about = {"recipe": trainer.recipe.as_dict(), "seed": seed, "episodes": trainer.episodes}
        self.evaluating = 0.0  # s
        self.unbroken = 0  # updates in a row that were not finite
        self.best: Score | None = None
        self.highest = 0.0  # success of any evaluation
        if run.started:
            state, self.seconds, self.best, self.highest = trainer._held(run)
            self.state = sharding.placed(trainer.mesh, state)
            self.update = int(self.state.step)
        else:
            self.state, self.seconds, self.update = trainer.start(self.key), 0.0, 0
            self.judge(self.state.policy, 0)

    def go(self, tell: Tell) -> None:
        """Make all updates that are left."""
        updates, saved, length = self.config.updates, self.seconds, 1
        points = {updates * (i + 1) // EVALUATIONS for i in range(EVALUATIONS)}
        with Progress(self.run, self._columns(), self.update) as progress:
            while self.update < updates:
                length = min(length, min(point for point in points if point > self.update) - self.update, _LONGEST_CALL)
                state, rows, took = self.fly(length)
                self.seconds += took
                if self.update + length in points:
                    rows[-1] |= self.judge(state.policy, self.update + length)
                    if self.unbroken and not math.isfinite(rows[-1]["evaluated_return"]):
                        raise _diverged(self.update + length)
                progress.add(rows)
                self.state, self.update = state, self.update + length
                if self.update in points or self.seconds - saved > _SAVE:
                    self.save()
                    saved = self.seconds
                tell(self.update, rows[-1] | {"steps_per_s": length * self._steps / took})
                length = max(1, round(_CALL / took * length))

    def fly(self, length: int):
        """The state after some updates, a line of progress for each, and the seconds they took; checked."""
        start = time.perf_counter()
        state, metrics = self.trainer.advance(self.state, length)
        took = hosts.agreed(time.perf_counter() - start)
        self.unbroken = _unbroken(metrics, self.unbroken)
        if self.unbroken >= min(_PATIENCE, self.config.updates) or not _finite(state):
            raise _diverged(self.update + length)
        rows = [
            {
                "update": self.update + i,
                "steps": (self.update + i) * self._steps,
                "seconds": self.seconds + took * i / length,
                **{name: float(x[i - 1]) for name, x in metrics.items()},
            }
            for i in range(1, length + 1)
        ]
        return state, rows, took

    def judge(self, policy: Policy, update: int) -> dict[str, float]:
        """Evaluate a policy, always on the same episodes; keep it if it is the best."""
        policy = sharding.whole(self.trainer.mesh, policy)
        report = self._evaluate(policy, CHOICE)
        score = score_of(report.success, report.returned)
        self.highest = max(self.highest, report.success)
        if self.best is None or best_of([self.best, score], self.trainer.episodes, self.highest) == 1:
            self.best = score
            self.run.save_policy("best", policy, **self.about, update=update, score=score)
        return dict(zip(_EVALUATED, (report.success, report.returned, report.error_percentiles[50]), strict=True))

    def save(self) -> None:
        """Write the newest policy and the training state."""
        state = sharding.whole(self.trainer.mesh, self.state)
        self.run.save_policy("last", state.policy, **self.about, update=self.update)
        self.run.save_state(state, **self.about, update=self.update, seconds=self.seconds, highest=self.highest)

    def finish(self) -> None:
        """Evaluate the best policy on other episodes than it was chosen by, and write the report."""
        report = self._evaluate(self.run.policy(), REPORT)
        seconds = {
            "training": self.seconds,
            "compiling": self.trainer.compile_seconds,
            "evaluating": self.evaluating,
        }
        self.run.save_report(
            self.about
            | {"best_update": self.run.told("best", "update"), "updates": self.update, "seconds": seconds}
            | {"evaluation": as_dict(report)}
        )

    @property
    def _steps(self) -> int:
        """Control steps of an update, of all drones."""
        return self.config.worlds * self.config.horizon * self.trainer.env.drones

    def _columns(self) -> list[str]:
        return ["update", "steps", "seconds", *self.trainer.metrics, *_EVALUATED]

    def _evaluate(self, policy: Policy, purpose: int) -> Report:
        start = time.perf_counter()
        report = evaluate(self.trainer.env, policy, jax.random.fold_in(self.key, purpose), self.trainer.episodes)
        self.evaluating += time.perf_counter() - start
        return report


def score_of(success: float, returned: float) -> Score:
    """Of an evaluation; a return that is not a number is the worst."""
    return success, returned if math.isfinite(returned) else -math.inf


def best_of(scores: Sequence[Score], episodes: int, highest: float = 0.0) -> int:
    """Index of the policy to keep.

    Of the policies whose success is as high as the highest but for chance, it is the one with the highest return, and
    of equal returns the first. Two shares are the same but for chance where their Wilson intervals of one standard
    error overlap: a difference of 1 in 1,000 decides nothing, one of 5 in 1,000 does.

    Args:
        scores: of all policies to choose from.
        episodes: that each was evaluated in.
        highest: success of a policy that is not among them, which was evaluated in as many; so that small losses do
            not add up from one choice to the next.
    """

    def interval(success: float) -> tuple[float, float]:
        return wilson(round(success * episodes), episodes, _NEAR)

    least = max(interval(success)[0] for success in (highest, *(success for success, _ in scores)))
    near = [i for i, (success, _) in enumerate(scores) if interval(success)[1] >= least]
    return max(near or range(len(scores)), key=lambda i: scores[i][1])


def _begun(recipe: dict) -> dict:
    """What a recipe was begun with, which training longer does not change."""
    return recipe | {"config": recipe["config"] | {"updates": None}}


def _of_two_runs(run: Run) -> ValueError:
    return ValueError(
        f"{run.folder}: best.json and state.json are of two runs; restore the files of one, or train anew with "
        "--overwrite"
    )


def _diverged(update: int) -> Diverged:
    return Diverged(f"numbers that are not finite at update {update}, or shortly before")


def _finite(state) -> bool:
    """Whether what was learnt is; a world that flew off ends by itself."""
    learnt = [getattr(state, name) for name in ("policy", "critic") if hasattr(state, name)]
    return all(np.isfinite(x).all() for x in jax.tree.leaves(learnt))


def _unbroken(metrics: dict[str, np.ndarray], before: int) -> int:
    """Updates in a row, up to the last, with a number that is not finite."""
    bad = ~np.all([np.isfinite(x) for x in metrics.values()], axis=0)
    good = np.flatnonzero(~bad)
    return before + len(bad) if len(good) == 0 else len(bad) - 1 - int(good[-1])

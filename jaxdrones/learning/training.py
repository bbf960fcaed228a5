"""The loop around a learner's `update`: progress, evaluations, checkpoints, and going on where it stopped."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.learning.evaluation import evaluate
from jaxdrones.learning.presets import ALGORITHMS
from jaxdrones.learning.result import COMPILER_OPTIONS
from jaxdrones.learning.runs import Progress, Recipe, Run, as_dict, size_of

EVALUATIONS = 10  # in the course of training
_LONGEST_CALL = 64  # updates
_CALL = 0.3  # s that a call takes about; Ctrl-C waits for it
_SAVE = 30.0  # s between training states, at most
_PATIENCE = 10  # updates in a row that are not finite
_PROBE = 4  # times the size of the training state that must fit on the disk

Tell = Callable[[int, dict[str, float]], None]
"""Is told the number of updates made and the newest numbers."""


class Diverged(RuntimeError):
    """Training came to numbers that are not finite."""


class Trainer:
    """The compiled programs of a recipe; all seeds share them."""

    def __init__(self, recipe: Recipe, episodes: int = 1000):
        """Prepare; nothing is compiled yet.

        Args:
            recipe: what to train.
            episodes: of an evaluation.
        """
        self.recipe, self.episodes = recipe, episodes
        self.env, self.learner = recipe.env(), ALGORITHMS[recipe.algorithm]
        self.compile_seconds = 0.0
        self.shapes = jax.eval_shape(self._init, jax.random.key(0))

    def compile(self) -> None:
        """Compile what trains; once."""
        start = time.perf_counter()
        count = jnp.zeros((), jnp.int32)
        self._start = jax.jit(self._init).lower(jax.random.key(0)).compile(COMPILER_OPTIONS)
        self._advance = jax.jit(self._updates).lower(self.shapes, count, count).compile(COMPILER_OPTIONS)
        self.compile_seconds = time.perf_counter() - start

    def prepare(self, run: Run) -> None:
        """See that a run can be written.

        Raises:
            OSError: it cannot.
        """
        run.prepare(_PROBE * size_of(self.shapes))

    def fit(self, seconds: float) -> None:
        """Choose the number of updates that take about so many seconds."""
        state, _ = self.advance(self._start(jax.random.key(0)), 1)
        start = time.perf_counter()
        self.advance(state, 3)
        pace = (time.perf_counter() - start) / 3
        config = dataclasses.replace(self.recipe.config, updates=max(1, int(seconds / pace)))
        self.recipe = dataclasses.replace(self.recipe, config=config)

    def advance(self, state, updates: int):
        """Make some updates in one call: the state after them, and (updates,) of every metric."""
        total = jnp.asarray(self.recipe.config.updates, jnp.int32)
        state, metrics = self._advance(state, jnp.asarray(updates, jnp.int32), total)
        return state, {name: np.asarray(x)[:updates] for name, x in metrics.items()}

    def train(self, run: Run, seed: int, tell: Tell) -> None:
        """Train to the end, from the start or from the state that the run holds.

        Args:
            run: a folder that was prepared.
            seed: of all that is random.
            tell: progress.

        Raises:
            Diverged: numbers that are not finite; the best policy so far is kept.
            KeyboardInterrupt: as it came; the state is saved.
        """
        config, about = self.recipe.config, {"recipe": self.recipe.as_dict(), "seed": seed}
        key = jax.random.key(seed)
        if run.started:
            state, best = run.load_state(self.shapes), tuple(run.about("best")["score"])
            spent = run.about("state")["seconds"]
        else:
            state, best, spent = self._start(key), None, 0.0
        update = int(state.step)
        per_update = config.worlds * config.horizon * self.env.drones
        points = {config.updates * (i + 1) // EVALUATIONS for i in range(EVALUATIONS)} | {config.updates}
        names = sorted(jax.eval_shape(self._one, self.shapes)[1])
        columns = ["update", "steps", "seconds", *names, "success", "evaluated_return", "evaluated_error"]
        bad, saved, length, evaluating = 0, time.perf_counter(), 1, 0.0

        def save():
            run.save_policy("last", state.policy, **about, update=update)
            run.save_state(state, **about, update=update, seconds=spent)

        def judge(policy, update: int) -> dict[str, float]:
            nonlocal best, evaluating
            start = time.perf_counter()
            report = evaluate(self.env, policy, jax.random.fold_in(key, 1), self.episodes)
            score = (report.success, report.returned if math.isfinite(report.returned) else -math.inf)
            if best is None or score > best:
                best = score
                run.save_policy("best", policy, **about, update=update, score=score)
            evaluating += time.perf_counter() - start
            return {
                "success": report.success,
                "evaluated_return": report.returned,
                "evaluated_error": report.error_percentiles[50],
            }

        if best is None:
            judge(state.policy, update)
            save()
        with Progress(run, columns, update) as progress:
            try:
                while update < config.updates:
                    upto = min(point for point in points if point > update)
                    length = min(length, upto - update, _LONGEST_CALL)
                    start = time.perf_counter()
                    after, metrics = self.advance(state, length)
                    took = time.perf_counter() - start
                    bad = _unbroken(metrics, bad)
                    if bad >= min(_PATIENCE, config.updates) or not _finite(after):
                        raise Diverged(f"numbers that are not finite at update {update + length} or a little before")
                    rows = [
                        {"update": update + i + 1, "steps": (update + i + 1) * per_update}
                        | {"seconds": spent + took * (i + 1) / length}
                        | {name: float(x[i]) for name, x in metrics.items()}
                        for i in range(length)
                    ]
                    spent += took
                    if update + length in points:
                        rows[-1] |= judge(after.policy, update + length)
                        if bad and not math.isfinite(rows[-1]["evaluated_return"]):
                            raise Diverged(
                                f"what is flown in training and in evaluation is not finite at update {update + length}"
                            )
                    progress.add(rows)
                    state, update = after, update + length
                    if update in points or time.perf_counter() - saved > _SAVE:
                        save()
                        saved = time.perf_counter()
                    tell(update, rows[-1] | {"steps_per_s": length * per_update / took})
                    length = max(1, round(_CALL / took * length))
            except KeyboardInterrupt:
                save()
                raise
        start = time.perf_counter()
        report = evaluate(self.env, run.policy(), jax.random.fold_in(key, 2), self.episodes)
        evaluating += time.perf_counter() - start
        run.save_report(
            {"seed": seed, "best_update": run.about()["update"], "updates": update, "evaluation": as_dict(report)}
            | {"seconds": {"training": spent, "compiling": self.compile_seconds, "evaluating": evaluating}}
            | {"recipe": self.recipe.as_dict()}
        )

    def _init(self, key: jax.Array):
        return self.learner.init(key, self.env, self.recipe.config)

    def _one(self, state, updates=None):
        config = self.recipe.config
        if updates is not None:
            config = dataclasses.replace(config, updates=updates)
        return self.learner.update(self.env, config, state)

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


def _finite(state) -> bool:
    """Whether what was learnt is; a world that flew off ends by itself."""
    learnt = [getattr(state, name) for name in ("policy", "critic") if hasattr(state, name)]
    return all(np.isfinite(x).all() for x in jax.tree.leaves(learnt))


def _unbroken(metrics: dict[str, np.ndarray], before: int) -> int:
    """Updates in a row, up to the last, with a number that is not finite."""
    bad = ~np.all([np.isfinite(x) for x in metrics.values()], axis=0)
    good = np.flatnonzero(~bad)
    return before + len(bad) if len(good) == 0 else len(bad) - 1 - int(good[-1])

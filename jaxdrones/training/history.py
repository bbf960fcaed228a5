"""Flights of the policies in the history of a training, and its learning curve."""

import math
from typing import NamedTuple

import jax

from jaxdrones.envs import Env
from jaxdrones.errors import UserError
from jaxdrones.training.episode import EpisodeLog, fly_episode
from jaxdrones.training.run import Run


class Evaluated(NamedTuple):
    """Policy of an evaluation."""

    update: int
    """Number of updates before."""
    value: float
    """Success rate, or mean return of a task without success."""
    flight: EpisodeLog
    """An episode, with the same start for all policies."""


def fly_history(run: Run, env: Env) -> list[Evaluated]:
    """Fly an episode with every policy in the history of a run."""
    if not run.kept:
        raise UserError(
            f"{run.folder} holds no policies of its evaluations; train with --keep-history, or give that of one seed"
        )
    name = "evaluated_return" if env.task.success is None else "success"
    found = []
    for kept in run.kept:
        value = run.sidecar_entry(kept, "evaluation").get(name, math.nan)
        flight = fly_episode(env, run.policy(kept, env), jax.random.key(0))
        found.append(Evaluated(run.sidecar_entry(kept, "update"), value, flight))
    return found

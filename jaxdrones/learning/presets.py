"""Settings that were found to work, by task and learner."""

from __future__ import annotations

import dataclasses
from types import ModuleType
from typing import Any

from jaxdrones.checks import check_choice
from jaxdrones.envs import Env, make
from jaxdrones.envs.observations import last_actions
from jaxdrones.learning import bptt, ppo, shac

ALGORITHMS: dict[str, ModuleType] = {"bptt": bptt, "ppo": ppo, "shac": shac}

_DELAYED = ("position_error", "rotation_matrix", "velocity_error", "omega", "rotor_speed", last_actions(3))
"""With delay and lag, what was done and has not shown yet is part of the state."""

_CONFIGS: dict[tuple[str, str], dict[str, Any]] = {
    ("tracking", "bptt"): dict(updates=250),
    ("recovery", "bptt"): dict(updates=250),
    ("paper-hover", "bptt"): dict(updates=150, worlds=64, horizon=100, restart=0.3, learning_rate=1e-2),
    ("leader-follower", "ppo"): dict(
        updates=150, worlds=128, horizon=96, trace=0.99, per_role=True, central_critic=True, sizes=(64, 64)
    ),
}
_REALISTIC: dict[tuple[str, str], dict[str, Any]] = {
    ("hover", "bptt"): dict(updates=450),
}


def preset(task: str, algorithm: str, realistic: bool = False, **options) -> tuple[Env, Any]:
    """An environment and the settings to learn it with.

    Args:
        task: a name of `jaxdrones.envs.TASKS`.
        algorithm: bptt, ppo or shac.
        realistic: lag, drag, delay, noise and parameter ranges; the policy then sees rotors and its last three actions.
        **options: of `jaxdrones.envs.make`.
    """
    check_choice("algorithm", algorithm, ALGORITHMS)
    if realistic and task in ("hover", "recovery", "landing"):
        options = {"observation": _DELAYED} | options
    env = make(task, realistic=realistic, **options)
    found = _CONFIGS.get((task, algorithm), {}) | (_REALISTIC.get((task, algorithm), {}) if realistic else {})
    return env, dataclasses.replace(ALGORITHMS[algorithm].Config(), **found)

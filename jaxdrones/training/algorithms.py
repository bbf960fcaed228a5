"""The table of learners; a new learner is a module, and a line here.

The table holds names, so that the command line can list them without importing the learners.
"""

from __future__ import annotations

import importlib
from typing import Any, Protocol, cast

import jax

from jaxdrones.checks import check_choice
from jaxdrones.envs import Env

ALGORITHMS = {
    "bptt": "jaxdrones.learning.bptt",
    "ppo": "jaxdrones.learning.ppo",
    "shac": "jaxdrones.learning.shac",
}
"""Module of each learner."""


class Learner(Protocol):
    """What the module of a learner defines.

    Its `Config` is a frozen dataclass with at least `updates`, `worlds` and `horizon`. Its training state is a pytree
    with at least `step`, `policy` and `worlds`. The metrics of an update include `nonfinite_gradients`, the number of
    gradients that were not finite.
    """

    Config: type[Any]

    def init(self, key: jax.Array, env: Env, config: Any) -> Any:
        """The training state before the first update."""

    def update(self, env: Env, config: Any, state: Any) -> tuple[Any, dict[str, jax.Array]]:
        """The training state after one more update, and metrics."""

    def train(self, key: jax.Array, env: Env, config: Any) -> Any:
        """The result of all updates."""


def learner(algorithm: str) -> Learner:
    """The module of a learner.

    Raises:
        ValueError: unknown algorithm; lists the known ones.
    """
    check_choice("algorithm", algorithm, ALGORITHMS)
    return cast(Learner, importlib.import_module(ALGORITHMS[algorithm]))

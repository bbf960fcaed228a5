"""Table of learners.

It holds names of modules, so that the command line can list them without importing the learners.
"""

import importlib
from typing import Annotated, Any, Protocol, cast

import jax

from jaxdrones.arguments import checked, choice
from jaxdrones.envs import Env

ALGORITHMS = {
    "bptt": "jaxdrones.learning.bptt",
    "league": "jaxdrones.learning.league",
    "ppo": "jaxdrones.learning.ppo",
    "shac": "jaxdrones.learning.shac",
}
"""Module of each learner."""


class Learner(Protocol):
    """Interface of a learner module.

    Its `Config` is a frozen dataclass with at least `updates`, `worlds` and `horizon`. Its training state is a
    `jaxdrones.learning.result.TrainState`. The metrics of an update include `nonfinite_gradients`, the number of
    gradients that are not finite.
    """

    Config: type[Any]

    def init(self, key: jax.Array, env: Env, config: Any) -> Any:
        """Training state before the first update."""

    def update(self, env: Env, config: Any, state: Any) -> tuple[Any, dict[str, jax.Array]]:
        """Training state after one update, and metrics."""

    def train(self, key: jax.Array, env: Env, config: Any) -> Any:
        """Result of all updates."""


@checked
def learner(algorithm: Annotated[str, choice("algorithm", ALGORITHMS)]) -> Learner:
    """Module of a learner."""
    return cast(Learner, importlib.import_module(ALGORITHMS[algorithm]))

"""Status of planners and fits."""

import enum
from typing import Annotated, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jaxdrones.arguments import choice

OnFailure = Annotated[str, choice("on_failure", ("hold", "raise"))]
"""Action of a planner without a new plan: repeat the last safe command, or raise."""


class Status(enum.IntEnum):
    """Status of a solution; inside `jax.jit` an integer."""

    OK = 0
    NOT_CONVERGED = 1
    INVALID_STATE = 2

    @property
    def sentence(self) -> str:
        """Sentence of the status."""
        return _SENTENCES[self]


_SENTENCES = {
    Status.OK: "A solution was found.",
    Status.NOT_CONVERGED: "The solver did not converge to a finite solution.",
    Status.INVALID_STATE: "The state or a set-point is not finite or not flyable, so nothing was planned.",
}


class PlanningError(RuntimeError):
    """Planner without a new command; see `status`."""

    def __init__(self, status: Status, planner: str):
        super().__init__(f"{planner}: {status.sentence}")
        self.status = status


def status_of(valid: Bool[Array, ""], solved: Bool[Array, ""]) -> Int[Array, ""]:
    """Status from the validity of a problem and the success of its solution."""
    failed = jnp.where(valid, int(Status.NOT_CONVERGED), int(Status.INVALID_STATE))
    return jnp.where(valid & solved, int(Status.OK), failed).astype(jnp.int32)


def is_finite(tree: Any) -> Bool[Array, ""]:
    """Whether all floating-point numbers of a pytree are finite."""
    leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    return jnp.all(jnp.array([jnp.all(jnp.isfinite(x)) for x in leaves if jnp.issubdtype(x.dtype, jnp.floating)]))


def raise_unless_ok(status: Any, planner: str) -> None:
    """Raise `PlanningError` unless the status is `OK`."""
    if int(status) != Status.OK:
        raise PlanningError(Status(int(status)), planner)

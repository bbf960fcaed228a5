"""Policies for all quadrotors: a recurrent network that adapts to the vehicle, and the arrangement of its rotors."""

from typing import Any, Self

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.envs import Env
from jaxdrones.errors import UserError
from jaxdrones.learning.networks import RecurrentPolicy
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode

OBSERVED = ("position_error", "rotation_matrix", "velocity_error", "omega")
OPTIONS = {"action": "throttle", "rotors": "lagging"}
"""Options of `jaxdrones.make` for an environment like those of its training."""
_CORNERS = np.array([(1, -1), (-1, -1), (-1, 1), (1, 1)])  # front right, rear right, rear left, front left
_SPINS = (-1, 1, -1, 1)
_TURNS = (0.0, 90.0, 45.0, -45.0)  # degrees
_CENTERED = 0.3  # of the largest coordinate of a rotor: below, it is on an axis


class AdaptivePolicy(PyTreeNode):
    """Policy that hovers any quadrotor at the target of a task, without its parameters.

    Its network observes `OBSERVED` and its last action, and commands `throttle`. Rotors should be `lagging`, as in
    training: with instant rotors most vehicles oscillate.
    """

    network: RecurrentPolicy
    """(hidden state, observations (*batch, 22)) -> (hidden state, actions (*batch, 4)), in its own body axes."""
    turn: Float[Array, "3 3"]
    """From body axes to those of a vehicle whose front right rotor turns clockwise, seen from above."""
    order: tuple[int, ...] = flax.struct.field(pytree_node=False)
    """Indices of its rotors: front right, rear right, rear left, front left in those axes."""

    @classmethod
    def of(cls, name: str, network: RecurrentPolicy, env: Env) -> Self:
        """Policy for the nominal vehicle of an environment."""
        names = tuple(term.name for term in env.terms)
        if names[: len(OBSERVED)] != OBSERVED or env.action.name != "throttle":
            raise UserError(
                f"{name} observes {', '.join(OBSERVED)}, and commands throttle; the environment observes "
                f"{', '.join(names)} and has the action {env.action.name}; give action='throttle' and no observation"
            )
        turn, order = _placed(name, jax.tree.map(lambda x: x[0], env.params))
        return cls(network, jnp.asarray(turn, jnp.float32), order)

    def initial_hidden_state(self, batch: tuple[int, ...]) -> tuple[Any, Array]:
        """Hidden state of the network, and the last action."""
        return self.network.initial_hidden_state(batch), jnp.zeros((*batch, 4), self.turn.dtype)

    def act(
        self, hidden_state: tuple[Any, Array], obs: Float[Array, "*batch d"]
    ) -> tuple[Any, Float[Array, "*batch 4"]]:
        """Hidden state after the observations, and actions."""
        hidden, last = hidden_state
        away, matrix, vel, omega = jnp.split(obs[..., :18].astype(last.dtype), (3, 12, 15), axis=-1)
        turned = (matrix.reshape(*matrix.shape[:-1], 3, 3) @ self.turn.T).reshape(matrix.shape)
        seen = jnp.concatenate([away, turned, vel, omega @ self.turn.T, last], axis=-1)
        hidden, own = self.network.act(hidden, seen)
        own = jnp.clip(own, -1, 1).astype(last.dtype)
        return (hidden, own), jnp.zeros_like(own).at[..., jnp.array(self.order)].set(own)


def _placed(name: str, params: Params) -> tuple[np.ndarray, tuple[int, ...]]:
    """Turn of the body axes (3, 3), and the indices of the rotors at the corners of the turned axes."""
    places, spin = np.asarray(params.rotor_pos)[:, :2], np.asarray(params.rotor_spin)
    for degrees in _TURNS:
        sin, cos = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
        turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        turned = places @ turn[:2, :2].T
        order = tuple(int(i) for i in np.argmax(_CORNERS @ turned.T, axis=1))
        at_corners = len(set(order)) == len(order) and np.abs(turned).min() > _CENTERED * np.abs(turned).max()
        if at_corners and np.array_equal(np.sign(spin[list(order)]), _SPINS):
            return turn, order
    raise UserError(f"{name} needs four rotors at the corners of a cross, neighbors of opposite spins")

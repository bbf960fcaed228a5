"""RAPTOR, a published policy for all quadrotors. Needs the extra `raptor`."""

from __future__ import annotations

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.envs import Env
from jaxdrones.errors import UserError, install
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode

_OBSERVED = ("position_error", "rotation_matrix", "velocity_error", "omega")
_CORNERS = np.array([(1, -1), (-1, -1), (-1, 1), (1, 1)])  # front right, rear right, rear left, front left
_TURNS = (0.0, 90.0, 45.0, -45.0)  # degrees
_CENTERED = 0.3  # of the largest coordinate of a rotor: below, it is on an axis


class Raptor(PyTreeNode):
    """RAPTOR, a foundation policy for quadrotors (Eschmann, Albani and Loianno 2025): a GRU that adapts to the vehicle.

    It hovers at the target of a task. Rotors should be `lagging`: with instant rotors most vehicles oscillate.
    """

    weights: dict[str, Array]
    turn: Float[Array, "3 3"]
    """From body axes to those of a vehicle whose front right rotor turns clockwise, seen from above."""
    order: tuple[int, ...] = flax.struct.field(pytree_node=False)
    """Indices of its rotors: front right, rear right, rear left, front left in those axes."""
    hover_share: Float[Array, ""]
    """Rotor speed in hover over the largest."""

    @classmethod
    def of(cls, env: Env) -> Raptor:
        """Policy for the nominal vehicle of an environment.

        Raises:
            ValueError: another observation or action than the policy has.
            ImportError: without the package foundation-policy (extra `raptor`).
        """
        names = tuple(term.name for term in env.terms)
        if names[: len(_OBSERVED)] != _OBSERVED or env.action.name != "rpm":
            raise UserError(
                f"raptor observes {', '.join(_OBSERVED)}, and commands rotor speeds; the environment observes "
                f"{', '.join(names)} and has the action {env.action.name}; leave out observation and give action='rpm'"
            )
        params = jax.tree.map(lambda x: x[0], env.params)
        turn, order = _placed(params)
        return cls(_weights(), jnp.asarray(turn, jnp.float32), order, params.hover_rpm / params.max_rpm)

    def initial_hidden_state(self, batch: tuple[int, ...]) -> tuple[Array, Array]:
        """Hidden state of the GRU, and the last action."""
        hidden = self.weights["initial"]
        return jnp.broadcast_to(hidden, (*batch, len(hidden))), jnp.zeros((*batch, 4), hidden.dtype)

    def act(
        self, hidden_state: tuple[Array, Array], obs: Float[Array, "*batch d"]
    ) -> tuple[Any, Float[Array, "*batch 4"]]:
        """Hidden state after the observations, and actions of the type `rpm`."""
        of_all = jnp.vectorize(self._act, signature="(h),(a),(d)->(h),(a),(a)")
        hidden, last, action = of_all(*hidden_state, obs)
        return (hidden, last), action

    def _act(self, hidden: Float[Array, " h"], last: Float[Array, "4"], obs: Float[Array, " d"]) -> tuple[Array, ...]:
        """Hidden state, action in the order of RAPTOR's rotors, and action of one drone."""
        w = self.weights
        away, matrix, vel, omega = jnp.split(obs[:18].astype(hidden.dtype), (3, 12, 15))
        turned = (matrix.reshape(3, 3) @ self.turn.T).reshape(9)
        seen = jnp.concatenate([-away, turned, -vel, self.turn @ omega, last])
        x = jax.nn.relu(w["in"] @ seen + w["in_bias"])
        hidden = _gru(w, hidden, x)
        own = jnp.clip(w["out"] @ hidden + w["out_bias"], -1, 1)
        share = jnp.zeros_like(own).at[jnp.array(self.order)].set((own + 1) / 2)
        span = jnp.where(share > self.hover_share, 1 - self.hover_share, self.hover_share)
        return hidden, own, (share - self.hover_share) / span


def _gru(w: dict[str, Array], hidden: Float[Array, " h"], x: Float[Array, " d"]) -> Float[Array, " h"]:
    reset_in, keep_in, new_in = jnp.split(w["input"] @ x + w["input_bias"], 3)
    reset_old, keep_old, new_old = jnp.split(w["hidden"] @ hidden + w["hidden_bias"], 3)
    keep = jax.nn.sigmoid(keep_in + keep_old)
    return keep * hidden + (1 - keep) * jnp.tanh(new_in + jax.nn.sigmoid(reset_in + reset_old) * new_old)


def _weights() -> dict[str, Array]:
    """Weights of the package foundation-policy."""
    try:
        from foundation_policy import Raptor as Published
    except ImportError:
        raise ImportError(f"foundation-policy is not installed; {install('raptor')}") from None
    dense, gru, out = Published().layers
    parts = {
        "in": dense.weights,
        "in_bias": dense.biases,
        "input": gru.weights_input,
        "input_bias": gru.biases_input,
        "hidden": gru.weights_hidden,
        "hidden_bias": gru.biases_hidden,
        "initial": gru.initial_hidden_state,
        "out": out.weights,
        "out_bias": out.biases,
    }
    return {name: jnp.asarray(np.squeeze(x), jnp.float32) for name, x in parts.items()}


def _placed(params: Params) -> tuple[np.ndarray, tuple[int, ...]]:
    """Turn of the body axes (3, 3), and the indices of the rotors at the corners of the turned axes."""
    places, spin = np.asarray(params.rotor_pos)[:, :2], np.asarray(params.rotor_spin)
    for degrees in _TURNS:
        sin, cos = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
        turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        turned = places @ turn[:2, :2].T
        order = tuple(int(i) for i in np.argmax(_CORNERS @ turned.T, axis=1))
        if np.abs(turned).min() > _CENTERED * np.abs(turned).max() and spin[order[0]] < 0:
            return turn, order
    raise UserError("raptor needs four rotors at the corners of a cross, neighbors of opposite spins")

"""RAPTOR, a published policy for all quadrotors. Needs the extra `raptor`."""

from typing import Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.errors import install
from jaxdrones.pytree import PyTreeNode


class Raptor(PyTreeNode):
    """Network of RAPTOR, a foundation policy for quadrotors (Eschmann, Albani and Loianno 2025): a GRU."""

    weights: dict[str, Array]

    @classmethod
    def load(cls) -> Self:
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
        return cls({name: jnp.asarray(np.squeeze(x), jnp.float32) for name, x in parts.items()})

    def initial_hidden_state(self, batch: tuple[int, ...]) -> Array:
        """Hidden state of the GRU at the start."""
        initial = self.weights["initial"]
        return jnp.broadcast_to(initial, (*batch, len(initial)))

    def act(
        self, hidden_state: Float[Array, "*batch h"], obs: Float[Array, "*batch 22"]
    ) -> tuple[Array, Float[Array, "*batch 4"]]:
        """Hidden state after the observations of `AdaptivePolicy`, and actions."""
        return jnp.vectorize(self._act, signature="(h),(d)->(h),(a)")(hidden_state, obs)

    def _act(self, hidden_state: Float[Array, " h"], obs: Float[Array, "22"]) -> tuple[Array, Array]:
        w = self.weights
        obs = obs.astype(hidden_state.dtype)
        obs = obs.at[0:3].multiply(-1).at[12:15].multiply(-1)  # it observes the position from the target
        x = jax.nn.relu(w["in"] @ obs + w["in_bias"])
        reset_in, keep_in, new_in = jnp.split(w["input"] @ x + w["input_bias"], 3)
        reset_old, keep_old, new_old = jnp.split(w["hidden"] @ hidden_state + w["hidden_bias"], 3)
        keep = jax.nn.sigmoid(keep_in + keep_old)
        hidden_state = keep * hidden_state + (1 - keep) * jnp.tanh(
            new_in + jax.nn.sigmoid(reset_in + reset_old) * new_old
        )
        return hidden_state, w["out"] @ hidden_state + w["out_bias"]

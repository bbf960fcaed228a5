"""Bundled and published policies by name."""

from collections.abc import Callable
from typing import Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones import assets
from jaxdrones.checks import look_up
from jaxdrones.envs import TASKS, Env
from jaxdrones.errors import UserError, needs
from jaxdrones.learning import checkpoint
from jaxdrones.learning.adaptive import AdaptivePolicy
from jaxdrones.learning.networks import AnyPolicy, Policy, RecurrentPolicy
from jaxdrones.pytree import PyTreeNode


class Raptor(PyTreeNode):
    """Network of RAPTOR, a foundation policy for quadrotors (Eschmann, Albani and Loianno 2025): a GRU.

    Needs the extra `raptor`.
    """

    weights: dict[str, Array]

    @classmethod
    def load(cls) -> Self:
        """Weights of the package foundation-policy."""
        with needs("foundation-policy", "raptor"):
            from foundation_policy import Raptor as Published
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


_NETWORKS: dict[str, Callable[[], RecurrentPolicy]] = {
    "raptor": Raptor.load,
    "any-vehicle": lambda: checkpoint.load(assets.folder() / "any-vehicle" / "best"),
}
POLICIES = tuple(_NETWORKS)
"""Policies for all vehicles; see `learning.adaptive`."""


def make_policy(name: str, env: Env | None = None) -> AnyPolicy:
    """Bundled or published policy, for `evaluate` and the functions of `learning.networks`.

    Args:
        name: a task with a bundled policy, for example `forest` (all: `jaxdrones list`), or a policy for all vehicles:
            `any-vehicle` (bundled) or `raptor` (published).
        env: environment of the policy, whose observations and actions are checked. Optional for the bundled policy of
            a task, which is for `jaxdrones.make(name)` and environments with the same observations and actions.

    Raises:
        ValueError: an unknown name, or an environment with other observations or actions than the policy has.
        ImportError: a policy whose package is not installed.
    """
    bundled = assets.policies()
    found = look_up("policy", name, bundled | _NETWORKS)
    if name in bundled:
        policy = checkpoint.load(found / "best")
        if env is not None:
            check_fits(name, policy, env)
            task = TASKS[name]()
            check_terms(name, (*task.observation, task.action), env)
        return policy
    if env is None:
        raise UserError(f"{name} adapts to a vehicle; give its environment, for example make_policy({name!r}, env)")
    return AdaptivePolicy.of(name, found(), env)


def terms_of(env: Env) -> tuple[str, ...]:
    """Names of the observation terms and of the action type of an environment."""
    return (*(term.name for term in env.terms), env.action.name)


def check_terms(name: str, trained: tuple[str, ...], env: Env) -> None:
    """Raise unless an environment has the observation terms and the action type `trained` of a policy called `name`."""
    own, given = (f"observation={','.join(names)} action={action}" for *names, action in (trained, terms_of(env)))
    if own != given:
        raise UserError(
            f"the policy {name} was trained with {own}, the environment {env.task.name} has {given}; give those of the "
            "policy"
        )


def check_fits(name: str, policy: Policy, env: Env) -> None:
    """Raise unless a policy, called `name`, fits the observations, actions and number of drones of an environment."""
    own = policy.obs_stats.mean.size, policy.network.output_size
    expected = env.observation_size, env.action_size
    if own != expected:
        raise UserError(
            f"the policy {name} has {own[0]} observations and {own[1]} actions, the environment {env.task.name} "
            f"{expected[0]} and {expected[1]}; give the task and the options that it was trained with"
        )
    networks = len(jax.tree.leaves(policy.params)[0])
    if policy.per_agent and networks != env.drones:
        raise UserError(
            f"the policy {name} has a network for each of {networks} drones; give as many, not {env.drones}"
        )

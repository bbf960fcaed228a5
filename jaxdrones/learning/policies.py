"""Bundled and published policies by name."""

from collections.abc import Callable

import jax

from jaxdrones import assets
from jaxdrones.checks import look_up
from jaxdrones.envs import Env
from jaxdrones.errors import UserError
from jaxdrones.learning import checkpoint
from jaxdrones.learning.adaptive import AdaptivePolicy
from jaxdrones.learning.networks import AnyPolicy, Policy, RecurrentPolicy
from jaxdrones.learning.raptor import Raptor

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
            a task, which flies in `jaxdrones.make(name)`, and in environments with the same observations.

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
        return policy
    if env is None:
        raise UserError(f"{name} adapts to a vehicle; give its environment, for example make_policy({name!r}, env)")
    return AdaptivePolicy.of(name, found(), env)


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

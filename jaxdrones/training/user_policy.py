"""A policy of a user's file, which flies a task as the policy of a run does."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax

from jaxdrones import user_code
from jaxdrones.checks import check_arguments
from jaxdrones.envs import Env, make
from jaxdrones.envs.functions import check_policy
from jaxdrones.errors import UserError
from jaxdrones.learning.networks import AnyPolicy, RecurrentPolicy


@dataclasses.dataclass(frozen=True)
class UserPolicy:
    """A policy of a user's file and the task that it flies: what is asked of a run, and of its recipe."""

    reference: str
    """`file.py:name` of a function from observations (n, d) to actions (n, a), or of a recurrent policy."""
    task: str
    """A name of `jaxdrones.envs.TASKS`, or `file.py:function`."""
    realistic: bool | str
    options: dict[str, Any]
    """Options of `jaxdrones.make`."""

    @property
    def algorithm(self) -> str:
        """Name of the policy for titles."""
        return self.reference

    def as_dict(self) -> dict[str, Any]:
        """The policy and the task for JSON."""
        return dataclasses.asdict(self)

    def recipe(self) -> UserPolicy:
        """What says which environment is flown: this."""
        return self

    def env(self, **options: Any) -> Env:
        """The environment to fly in; options of `jaxdrones.make` replace those given."""
        return make(self.task, realistic=self.realistic, **self.options | options)

    def policy(self, env: Env) -> AnyPolicy:
        """The policy.

        Raises:
            ValueError: the file cannot be read or executed, or the name is not that of a policy.
        """
        policy = user_code.load(self.reference)
        sizes = (env.drones, env.observation_size), (env.drones, env.action_size)
        recurrent = isinstance(policy, RecurrentPolicy)
        if isinstance(policy, type) or not (callable(policy) or recurrent):
            raise UserError(
                f"{self.reference} is {policy!r:.60}; give a function from observations {sizes[0]} to actions "
                f"{sizes[1]}, or a recurrent policy"
            )
        if recurrent:
            check_arguments(f"{self.reference}.initial_hidden_state", policy.initial_hidden_state, ("batch",))
            check_arguments(f"{self.reference}.act", policy.act, ("hidden_state", "obs"))
        else:
            check_arguments(self.reference, policy, ("obs",))
        obs, _ = jax.eval_shape(env.reset, jax.random.key(0))
        check_policy(self.reference, policy, obs, sizes[1])
        return policy

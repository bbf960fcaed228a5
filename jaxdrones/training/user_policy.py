"""Policies from users' files, and published ones."""

import dataclasses
from typing import Any, Self

import jax

from jaxdrones import user_code
from jaxdrones.checks import check_function
from jaxdrones.envs import Env, make
from jaxdrones.envs.functions import check_policy
from jaxdrones.errors import UserError
from jaxdrones.learning import adaptive
from jaxdrones.learning.networks import AnyPolicy, Policy, RecurrentPolicy
from jaxdrones.learning.policies import POLICIES, check_fits, make_policy


@dataclasses.dataclass(frozen=True)
class UserPolicy:
    """Policy of a user's file, or a published one, and its task, with the interface of `Run` and `Recipe`."""

    reference: str
    """`file.py:name` of a function from observations (n, d) to actions (n, a), or of a recurrent policy; or a name of
    `jaxdrones.learning.policies.POLICIES`."""
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
        """Policy and task for JSON."""
        return dataclasses.asdict(self)

    def recipe(self) -> Self:
        """Recipe of the environment: this object."""
        return self

    def env(self, **options: Any) -> Env:
        """Environment; options of `jaxdrones.make` override those of the policy."""
        own = adaptive.OPTIONS if self.reference in POLICIES else {}
        return make(self.task, realistic=self.realistic, **own | self.options | options)

    def policy(self, env: Env) -> AnyPolicy:
        """Policy."""
        if self.reference in POLICIES:
            return make_policy(self.reference, env)
        policy = user_code.load(self.reference)
        sizes = (env.drones, env.observation_size), (env.drones, env.action_size)
        recurrent = isinstance(policy, RecurrentPolicy)
        if isinstance(policy, Policy):
            check_fits(self.reference, policy, env)
        if isinstance(policy, type) or not (callable(policy) or recurrent):
            raise UserError(
                f"{self.reference} is {policy!r:.60}; give a function from observations {sizes[0]} to actions "
                f"{sizes[1]}, or a recurrent policy"
            )
        functions: dict[str, tuple[Any, tuple[str, ...]]] = {"": (policy, ("obs",))}
        if recurrent:
            functions = {
                ".initial_hidden_state": (policy.initial_hidden_state, ("batch",)),
                ".act": (policy.act, ("hidden_state", "obs")),
            }
        for name, (function, arguments) in functions.items():
            check_function(self.reference + name, function, arguments)
        obs, _ = jax.eval_shape(env.reset, jax.random.key(0))
        check_policy(self.reference, policy, obs, sizes[1])
        return policy

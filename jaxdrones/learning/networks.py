"""Policies: built-in and user-defined networks of normalized observations."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Protocol, Self, cast, runtime_checkable

import flax.errors
import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.arguments import checked, function
from jaxdrones.checks import is_concrete, short_repr
from jaxdrones.envs import Env
from jaxdrones.envs.env import Obs
from jaxdrones.errors import UserError
from jaxdrones.learning.layers import MLP, OUTPUT_SCALE, Network, expand, make_network
from jaxdrones.learning.normalize import RunningStatistics, map_state_vector, state_vector
from jaxdrones.pytree import PyTreeNode


@runtime_checkable
class RecurrentPolicy(Protocol):
    """Policy with a hidden state, an array or a pytree; `None` for a policy without one."""

    def initial_hidden_state(self, batch: tuple[int, ...]) -> Any:
        """Hidden state at the start of an episode; `batch` is (drones,) for one team."""

    def act(self, hidden_state: Any, obs: Obs) -> tuple[Any, Float[Array, "*batch n a"]]:
        """Hidden state after the observations, and actions."""


AnyPolicy = RecurrentPolicy | Callable[[Obs], Array]
"""Recurrent policy, or any function from observations (n, d), or a dictionary with images, to actions (n, a)."""


def initial_hidden_state(policy: AnyPolicy, drones: int) -> Any:
    """Hidden state of a team's policy at the start of an episode; `None` for a plain function."""
    return policy.initial_hidden_state((drones,)) if isinstance(policy, RecurrentPolicy) else None


def act(policy: AnyPolicy, hidden_state: Any, obs: Obs) -> tuple[Any, Float[Array, "n a"]]:
    """Hidden state after the observations, and actions."""
    return policy.act(hidden_state, obs) if isinstance(policy, RecurrentPolicy) else (hidden_state, policy(obs))


class OwnNetwork:
    """User-defined network: a flax linen, flax nnx or equinox module.

    The network maps the normalized observation of one drone, (d,) or a dictionary with images, to one output per
    action; the policy applies tanh to them. A recurrent network also has `initial_hidden_state()`, zeros of any
    structure, and maps `(hidden_state, obs)` to `(hidden_state, output)`.

    The parameters of a linen module are its variables. Those of an nnx or equinox module are a tuple of all its
    floating-point arrays.
    """

    @checked
    def __init__(self, module: Annotated[Any, function("a flax or equinox module", name="network")], output_size: int):
        if isinstance(module, type):
            raise UserError(f"network is the class {module.__name__}; give an object of this class")
        self.module, self.output_size = module, output_size
        self.recurrent = hasattr(module, "initial_hidden_state")
        if self.recurrent and any(np.any(x) for x in jax.tree.leaves(module.initial_hidden_state()) if is_concrete(x)):
            raise UserError("network.initial_hidden_state() is not zero; give zeros")
        if not isinstance(module, nn.Module):
            self._leaves, self._structure = jax.tree.flatten(module)
            if not any(map(_is_trained, self._leaves)):
                raise UserError(f"network {short_repr(module)} has no parameters; give a flax or equinox module")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, OwnNetwork) and self.module is other.module

    def __hash__(self) -> int:
        return id(self.module)

    def init(self, key: jax.Array, example: Obs) -> Any:
        """Initial parameters; only a linen module uses the key."""
        if isinstance(self.module, nn.Module):
            state = (self.module.initial_hidden_state(),) if self.recurrent else ()
            return self.module.init(key, *state, example)
        return tuple(jnp.asarray(x) for x in self._leaves if _is_trained(x))

    def restored(self, params: Any, observation_size: int, per_agent: bool = False) -> Any:
        """Parameters from a file, where tuples are dictionaries, possibly a set for each drone.

        Raises:
            ValueError: arrays of other shapes than those of the module; of a linen module of images, when it is called.
        """
        if isinstance(self.module, nn.Module):
            try:
                module = jax.eval_shape(lambda: self.init(jax.random.key(0), jnp.zeros(observation_size)))
            except Exception:  # of the user's code, for images
                return params
        else:
            module = tuple(filter(_is_trained, self._leaves))
            params = tuple(params[str(i)] for i in range(len(params)))
        own, found = _shapes(module), _shapes(params, per_agent)
        for name in own | found:
            if (here := own.get(name, "none")) != (there := found.get(name, "none")):
                raise UserError(f"network has array {name} of shape {here}, the policy {there}; give its network")
        return params

    def with_params(self, params: Any) -> Callable:
        """Module with other parameters; for linen a function that applies it."""
        if isinstance(self.module, nn.Module):
            return functools.partial(_apply, self.module, params)
        rest = iter(params)
        return jax.tree.unflatten(self._structure, [next(rest) if _is_trained(x) else x for x in self._leaves])

    def apply(self, params: Any, obs: Obs, hidden_state: Any = None, starts: Array | None = None) -> tuple[Any, Array]:
        """Hidden states and outputs of a batch, or with `starts` of sequences; see `layers.GRU` for the arguments."""
        if starts is not None:

            def step(state: Any, step_inputs: tuple[Obs, Array]) -> tuple[Any, tuple[Any, Array]]:
                obs, start = step_inputs
                state, output = self.apply(params, obs, set_zero(start, state))
                return state, (state, output)

            return jax.lax.scan(step, hidden_state, (obs, starts))[1]

        def one_drone(state: Any, obs: Obs) -> tuple[Any, Array]:
            module = self.with_params(params)
            return module(state, obs) if self.recurrent else (None, module(obs))

        for _ in range(state_vector(obs).ndim - 1):
            one_drone = jax.vmap(one_drone)
        return one_drone(hidden_state, obs)


def _shapes(tree: Any, per_agent: bool = False) -> dict[str, tuple[int, ...]]:
    named = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): np.shape(x)[int(per_agent) :] for path, x in named}


def _apply(module: nn.Module, params: Any, *args: Any) -> Any:
    """Output of a linen module with parameters that may be those of another one."""
    try:
        return module.apply(params, *args)
    except (flax.errors.ScopeParamNotFoundError, flax.errors.ScopeParamShapeError) as error:
        raise UserError(f"the policy's parameters are not those of network: {error}; give its network") from error


def _is_trained(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray) and jnp.issubdtype(leaf.dtype, jnp.inexact)


class Policy(PyTreeNode):
    """Function from a team's observations to its actions; a pytree, which can be saved, mapped and differentiated.

    A recurrent policy has a hidden state, see `RecurrentPolicy`; other policies are callable.
    """

    params: Any
    """Parameters of the network; with `per_agent` one set per drone, along a leading axis."""
    obs_stats: RunningStatistics
    """Statistics for the normalization of observations."""
    network: MLP | Network | OwnNetwork = flax.struct.field(pytree_node=False)
    per_agent: bool = flax.struct.field(pytree_node=False, default=False)

    @classmethod
    def init(
        cls,
        key: jax.Array,
        env: Env,
        hidden_sizes: Sequence[int] = (32, 32),
        per_agent: bool = False,
        recurrent_size: int = 0,
        network: Any = None,
        set_sizes: Sequence[int] = (32, 32),
    ) -> Self:
        """Create a policy with actions near zero, which is hover in most action types.

        With `per_agent` every drone has its own network; otherwise all drones share one. `recurrent_size` is 0 without
        a GRU, and `set_sizes` are those of the layers that encode a row of a set in the observation. A user-defined
        network replaces these sizes, see `OwnNetwork`.

        Raises:
            ValueError: a network without parameters, or with the wrong output for the environment.
        """
        obs = example_observation(env)
        own = make_network(obs, hidden_sizes, env.action_size, OUTPUT_SCALE, recurrent_size, env.sets, set_sizes)
        network = own if network is None else OwnNetwork(network, env.action_size)
        params = init_params(key, network, obs, env.drones if per_agent else None)
        policy = cls(params, RunningStatistics.empty(env.observation_size), network, per_agent)
        if isinstance(network, OwnNetwork):
            team = jax.tree.map(lambda x: jnp.zeros((env.drones, *x.shape), x.dtype), obs)
            action = jax.eval_shape(policy.act, policy.initial_hidden_state((env.drones,)), team)[1]
            if action.shape != (env.drones, env.action_size):
                raise UserError(f"network has outputs {action.shape[1:]} for one drone; give ({env.action_size},)")
        return policy

    def __repr__(self) -> str:
        sizes = np.shape(self.obs_stats.mean)[-1:]
        if isinstance(self.network, OwnNetwork):
            layers = f"{sizes[0]} -> {type(self.network.module).__name__}"
        else:
            layers = " -> ".join(map(str, (*sizes, *self.network.hidden_sizes, self.network.output_size)))
            layers += f", {self.network.activation}"
        if isinstance(self.network, Network):
            layers += f", images by {self.network.channels}" if self.network.channels else ""
            layers += f", GRU of {self.network.recurrent_size}" if self.network.recurrent_size else ""
        numbers = sum(math.prod(np.shape(x)) for x in jax.tree.leaves(self.params))
        count = self.obs_stats.count
        known = isinstance(count, jax.Array | np.ndarray) and is_concrete(count) and count.ndim == 0
        counted = f", statistics of {float(count):,.0f} observations" if known else ""
        whose = ", one network per drone" if self.per_agent else ""
        return f"<Policy {layers}, {numbers:,} parameters{whose}{counted}>"

    def with_obs_stats(self, obs_stats: RunningStatistics) -> Self:
        """Policy with new statistics, except for the rows of sets, which are not normalized: their order is random."""
        for at, rows, size, _ in getattr(self.network, "sets", ()):
            columns = slice(at, at + rows * size)
            mean, var = obs_stats.mean.at[columns].set(0), obs_stats.var.at[columns].set(1)
            obs_stats = obs_stats.replace(mean=mean, var=var)
        return self.replace(obs_stats=obs_stats)

    @property
    def is_recurrent(self) -> bool:
        """Whether the policy has a hidden state."""
        own = isinstance(self.network, OwnNetwork)
        return self.network.recurrent if own else bool(getattr(self.network, "recurrent_size", 0))

    def initial_hidden_state(self, batch: tuple[int, ...]) -> Any:
        """Zero hidden state of (drones,) or (teams, drones) at the start of an episode; `None` without one."""
        if not self.is_recurrent:
            return None
        if isinstance(self.network, OwnNetwork):
            state = self.network.module.initial_hidden_state()
            return jax.tree.map(lambda x: jnp.zeros((*batch, *jnp.shape(x)), jnp.result_type(x)), state)
        return jnp.zeros((*batch, cast(Network, self.network).recurrent_size))

    def act(self, hidden_state: Any, obs: Obs) -> tuple[Any, Float[Array, "*batch n a"]]:
        """Hidden state (*batch, n, ...) after the observations, which may have images, and actions in (-1, 1)."""
        x = map_state_vector(self.obs_stats.normalize, obs)
        hidden_state, output = apply(self.network, self.params, x, self.per_agent, hidden_state)
        return hidden_state, jnp.tanh(output)

    def replay(self, hidden_state: Any, obs: Obs, starts: Array | None) -> Float[Array, "*batch a"]:
        """Actions of a sequence of normalized observations (t, *batch, n, d), or of a dictionary of them.

        The hidden state (*batch, n, ...) is that before the first observation; `starts` (t, *batch), whether an episode
        starts with an observation, is `None` without a hidden state. Without both, and without `per_agent`, any leading
        axes are possible.
        """
        return jnp.tanh(apply(self.network, self.params, obs, self.per_agent, hidden_state, starts)[1])

    def __call__(self, obs: Obs) -> Float[Array, "*batch n a"]:
        """Actions of a policy without a hidden state."""
        if self.is_recurrent:
            raise UserError(
                "the policy is recurrent; call policy.act(hidden_state, obs), at the start of an episode with "
                "policy.initial_hidden_state((drones,))"
            )
        return self.act(None, obs)[1]


def example_observation(env: Env) -> Obs:
    """Zero observation of one drone."""
    obs, _ = jax.eval_shape(env.reset, jax.random.key(0))
    return jax.tree.map(lambda x: jnp.zeros(x.shape[1:], x.dtype), obs)


def init_params(key: jax.Array, network: Any, example: Obs, agents: int | None = None) -> Any:
    """Initial parameters of a network; with `agents` one set each, along a leading axis."""
    if agents is None:
        return network.init(key, example)
    return jax.vmap(network.init, in_axes=(0, None), axis_size=agents)(jax.random.split(key, agents), example)


def apply(
    network: MLP | Network | OwnNetwork,
    params: Any,
    x: Obs,
    per_agent: bool,
    hidden_state: Any = None,
    starts: Array | None = None,
) -> tuple[Any, Array]:
    """Hidden states and outputs of the shared network, or of each drone's network."""

    def of_network(params: Any, x: Obs, hidden_state: Any) -> tuple[Any, Array]:
        if isinstance(network, MLP):
            return None, cast(Array, network.apply(params, x))
        return cast(tuple[Any, Array], network.apply(params, x, hidden_state, starts))

    if not per_agent:
        return of_network(params, x, hidden_state)
    axis = state_vector(x).ndim - 2
    state_axis = axis if starts is None else axis - 1
    in_axes, out_axes = (0, axis, state_axis), (axis, axis)
    return jax.vmap(of_network, in_axes=in_axes, out_axes=out_axes)(params, x, hidden_state)


def set_zero(where: Array, tree: Any) -> Any:
    """Tree with zeros where the condition over its leading axes holds."""
    return jax.tree.map(lambda x: jnp.where(expand(where, x.ndim), 0, x), tree)

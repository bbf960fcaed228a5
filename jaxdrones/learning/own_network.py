"""Networks of users: modules of flax linen, flax nnx or equinox."""

import contextlib
import functools
from collections.abc import Callable
from typing import Annotated, Any

import flax.errors
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdrones.arguments import checked, function
from jaxdrones.checks import is_concrete, short_repr
from jaxdrones.envs.env import Obs
from jaxdrones.errors import UserError
from jaxdrones.learning.layers import set_zero
from jaxdrones.learning.normalize import state_vector
from jaxdrones.user_code import errors_of


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
            with self._explained(example):
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

    def _explained(self, obs: Obs) -> contextlib.AbstractContextManager[None]:
        given = jax.tree.map(np.shape, obs)
        received = (
            f"it receives {'the hidden state and ' * self.recurrent}the observation of one drone, of shape {given}"
        )
        return errors_of(f"network {type(self.module).__name__}", received)

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
            name, before = type(self.module).__name__, jax.tree.leaves(module)
            with self._explained(obs):
                result = module(state, obs) if self.recurrent else (None, module(obs))
            if self.recurrent and not (isinstance(result, tuple) and len(result) == 2):
                raise UserError(
                    f"network {name} has a hidden state and returns {short_repr(result)}; return (hidden_state, output)"
                )
            if list(map(id, jax.tree.leaves(module))) != list(map(id, before)):
                raise UserError(
                    f"network {name} changes its arrays in a call, as dropout and batch normalization do; leave such "
                    "layers out, or call network.eval() first, which disables dropout"
                )
            return result

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

"""Policies as StableHLO programs of `jax.export`, with a symbolic batch."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import export
from jaxtyping import Array

from jaxdrones.errors import UserError, needs
from jaxdrones.export.layers import Tensor
from jaxdrones.learning.networks import Policy

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")


def program(policy: Policy, images: tuple[Tensor, ...]) -> bytes:
    """Serialized program of a policy, with any network that all drones share, in float32.

    Returns:
        Bytes for `jax.export.deserialize`. The program maps `obs` (batch, d), the images (batch, height, width,
        ...) in the order of their names, and for a recurrent policy its hidden state, to the actions (batch, a), or
        to actions and next hidden state.

    Raises:
        ValueError: flatbuffers is not installed.
    """
    assert not policy.per_agent, "give the policy of one drone"
    with needs("flatbuffers", "export", UserError):
        import flatbuffers  # noqa: F401 - with which jax.export saves
    policy = jax.tree.map(_float32, policy)
    (batch,) = export.symbolic_shape("batch")

    def step(obs: Array, *more: Any) -> Any:
        seen = {"state": obs, **{image.name: x for image, x in zip(images, more, strict=False)}} if images else obs
        if not policy.is_recurrent:
            return policy.act(None, seen)[1]
        hidden_state, action = policy.act(more[-1], seen)
        return action, hidden_state

    def example(shape: tuple[int, ...], dtype: Any) -> Any:
        return jax.ShapeDtypeStruct((batch, *shape), dtype)

    examples = [example(policy.obs_stats.mean.shape, jnp.float32)]
    examples += [example(image.shape, image.dtype) for image in images]
    if policy.is_recurrent:
        hidden_state = jax.tree.map(_float32, policy.initial_hidden_state((1,)))
        examples.append(jax.tree.map(lambda x: example(x.shape[1:], x.dtype), hidden_state))
    return bytes(export.export(jax.jit(step), platforms=PLATFORMS)(*examples).serialize())


def _float32(x: Any) -> Any:
    return jnp.asarray(x, jnp.float32) if jnp.issubdtype(jnp.result_type(x), jnp.floating) else x

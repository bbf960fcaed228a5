"""Wrenches between drones, and validation of functions that compute wrenches."""

import contextlib
import functools
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import cast

import jax
import jax.numpy as jnp

from jaxdrones import rotation
from jaxdrones.accelerate.where_needed import in_all_worlds
from jaxdrones.checks import check_shape, short_repr
from jaxdrones.engine.neighbors import NeighborGrid
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.sensing.scene import Scene
from jaxdrones.state import State
from jaxdrones.vector import components
from jaxdrones.wrench import Wrench

Effect = Callable[[Params, State], Wrench] | Callable[[Params, State, Scene], Wrench]
"""`(params, state)` of one drone -> wrench on it; a parameter named `scene` receives the scene."""
Pair = Callable[[Params, State, Params, State], Wrench]
"""`(params, state, other, other_state)` of two drones -> wrench on the first."""
TeamEffect = Callable[[Params, State], Wrench]
"""`(params, state)` of a team of n drones -> wrench on each: force and torque (n, 3), body axes."""

_OUT_OF_REACH = 1e3  # m
_BESIDE = 2.0**-13  # m; 0.1 mm, which float32 adds to 1 km without rounding
_SHORT = 32  # terms


def describe(functions: Sequence[Callable]) -> str:
    """Names of functions for messages."""
    return ", ".join(_name(function) for function in functions) or "none"


def _name(function: Callable) -> str:
    while isinstance(function, functools.partial):
        function = function.func
    return getattr(function, "__name__", type(function).__name__)


@contextlib.contextmanager
def explained_key_errors(params: Params, state: State) -> Iterator[None]:
    """Turn the KeyError of a user's function that misses an entry of `aux` into one with its place and the remedy."""
    try:
        yield
    except KeyError as error:
        missing = error.args[0] if error.args else ""
        if missing in params.aux and missing in state.aux:
            raise
        last = traceback.extract_tb(error.__traceback__)[-1]
        constants, states = (", ".join(tree.aux) or "nothing" for tree in (params, state))
        raise UserError(
            f"{last.name} ({Path(last.filename).name}, line {last.lineno}) raises KeyError: {missing!r}; params.aux "
            f"has {constants}, state.aux has {states}; give constants by "
            f"params.replace(aux=params.aux | {{{missing!r}: ...}}), and states by "
            f"models=(jaxdrones.Model({missing!r}, init, rate),) and step.init(params, state)"
        ) from error


def check_wrench(name: str, function: Callable, wrench: Wrench, drones: int | None = None) -> Wrench:
    """Validated wrench that a function of the argument `name` of `make_step` returned; `drones` of a team."""
    called = f"{name}: {describe([function])}"
    if not isinstance(wrench, Wrench):
        given = f"an array of shape {wrench.shape}" if isinstance(wrench, jax.Array) else short_repr(wrench)
        raise UserError(f"{called} returned {given}; return jaxdrones.Wrench(force, torque), N and N m in body axes")
    shape, of = ((3,), "one drone") if drones is None else ((drones, 3), f"each of {drones} drones")
    for part in ("force", "torque"):
        check_shape(f"{called}: {part}", getattr(wrench, part), shape, f"x, y, z of {of}, in body axes")
    return wrench


def from_others(pair: Pair, params: Params, state: State, neighbors: NeighborGrid | None) -> Wrench:
    """Sum of a pair effect over all other drones, or over those within the cutoff, for every drone of a team.

    The wrenches are computed and summed as six components, each (others, drones).
    """
    index = jnp.arange(len(state.pos))

    def pair_wrench(j, counts, other, other_state, i, own_params, own_state):
        # A drone is not its own neighbor. Masked drones are moved out of reach first, so that
        # neither value nor gradient of a pair is ever taken at zero distance.
        counts = counts & (i != j)
        if neighbors is not None:
            x, y = components(other_state.pos[:2] - own_state.pos[:2])
            counts &= x * x + y * y < neighbors.cutoff**2
        away = jnp.where(counts, 0, _OUT_OF_REACH)
        pos = jnp.stack([x + away for x in components(other_state.pos)])
        wrench = check_wrench("pairs", pair, pair(own_params, own_state, other, other_state.replace(pos=pos)))
        parts = components(wrench.force) + components(wrench.torque)
        return [jnp.where(counts, x, 0) for x in parts]

    def on_all():
        on_each = jax.vmap(pair_wrench, in_axes=(None, None, None, None, 0, 0, 0))
        from_each = jax.vmap(on_each, in_axes=(0, None, 0, 0, None, None, None))
        return [_sum(x) for x in from_each(index, True, params, state, index, params, state)]

    def on_near():
        other, other_state = jax.tree.map(lambda x: x.at[near].get(mode="promise_in_bounds"), (params, state))
        from_each = jax.vmap(jax.vmap(pair_wrench), in_axes=(0, 0, 0, 0, None, None, None))
        return [_sum(x) for x in from_each(near, meant, other, other_state, index, params, state)]

    if neighbors is None:
        sums = on_all()
    else:
        near, meant, complete = neighbors.near(jax.lax.stop_gradient(state.pos))
        sums = jax.lax.cond(in_all_worlds(complete), on_near, on_all)
    return Wrench(jnp.stack(sums[:3], axis=-1), jnp.stack(sums[3:], axis=-1))


def side_by_side(state: State) -> State:
    """Team with coincident drones displaced slightly upward, in the order of their indices.

    The contact normal of coincident drones is undefined. All pairs use the same displaced positions, so action stays
    equal to reaction.
    """
    x, y, z = state.pos.T
    same = (x[:, None] == x[None]) & (y[:, None] == y[None]) & (z[:, None] == z[None])
    rank = jnp.sum(jnp.tril(same, -1), axis=1)  # how many of lower index are there
    rounding = jnp.finfo(x.dtype).eps * jnp.max(jnp.abs(state.pos), axis=1)
    up = rank * jnp.maximum(_BESIDE, 16 * rounding)
    return state.replace(pos=state.pos + jax.lax.stop_gradient(up[:, None] * jax.vmap(rotation.z_axis)(state.quat)))


def _sum(x: jax.Array) -> jax.Array:
    """Sum over the first axis, unrolled where it is short, like `vector.dot`."""
    return cast(jax.Array, sum(components(x))) if len(x) <= _SHORT else jnp.sum(x, axis=0)

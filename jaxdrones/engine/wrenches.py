"""The sum of wrenches on a team, the same for every backend."""

from collections.abc import Callable, Sequence
from typing import cast

import jax
import jax.numpy as jnp

from jaxdrones import rotation, vector
from jaxdrones.accelerate.stored import stored
from jaxdrones.checks import check_arguments, check_sequence, check_shape, shown
from jaxdrones.dynamics import drone_contact, rotor_wrench
from jaxdrones.engine.neighbors import NeighborGrid
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.wrench import Wrench

Effect = Callable[[Params, State], Wrench]
Pair = Callable[[Params, State, Params, State], Wrench]

_OUT_OF_REACH = 1e3  # m
_BESIDE = 2.0**-13  # m; 0.1 mm, which float32 adds to 1 km without rounding
_SHORT = 32  # terms
_EXAMPLE = {"effects": "drag", "pairs": "downwash", "rotors": "instant_rotors", "integrator": "rk4"}
_ARGUMENTS = {
    "effects": ("params", "state"),
    "pairs": ("params", "state", "other", "other_state"),
    "rotors": ("params", "rpm", "command"),
    "integrator": ("derivative", "state", "dt"),
}
_ELSEWHERE = {
    "effects": "; what depends on another drone belongs to pairs",
    "pairs": "; what depends on one drone alone belongs to effects",
}


def check_functions(name: str, functions: Sequence[Callable]) -> tuple[Callable, ...]:
    """What an argument of `make_step` holds, or an error if it is not a sequence of functions."""
    example = f"jaxdrones.{_EXAMPLE[name]}"
    if callable(functions):
        raise ValueError(f"{name} is a single function, {functions!r}; give a sequence, for example ({example},)")
    functions = check_sequence(name, functions, example)
    for function in functions:
        if not callable(function):
            raise ValueError(f"{name}: {function!r} is not a function; give for example {example}")
        check_arguments(name, function, _ARGUMENTS[name], _ELSEWHERE.get(name, ""))
    return functions


def _checked(name: str, function: Callable, wrench: Wrench) -> Wrench:
    """What an effect returned, or an error if it is no wrench on one drone."""
    called = f"{name}: {describe([function])}"
    if not isinstance(wrench, Wrench):
        given = f"an array of shape {wrench.shape}" if isinstance(wrench, jax.Array) else shown(wrench)
        raise ValueError(f"{called} returned {given}; return jaxdrones.Wrench(force, torque), N and N m in body axes")
    for part in ("force", "torque"):
        check_shape(f"{called}: {part}", getattr(wrench, part), (3,), "x, y, z of one drone, in body axes")
    return wrench


def describe(functions: Sequence[Callable]) -> str:
    """Names of functions, for people."""
    return ", ".join(getattr(function, "__name__", type(function).__name__) for function in functions) or "none"


def make_total_wrench(
    effects: Sequence[Effect], pairs: Sequence[Pair], cells: NeighborGrid | None = None
) -> Callable[[Params, State], Wrench]:
    """Build `(params, state) -> Wrench` of a team: rotors, effects and pairs, one row per drone.

    Raises:
        ValueError: a sequence that holds something else than functions, or cells that are none.
    """
    effects, pairs = check_functions("effects", effects), check_functions("pairs", pairs)
    if not (cells is None or isinstance(cells, NeighborGrid)):
        raise ValueError(f"cells is {cells!r}; give for example jaxdrones.NeighborGrid(reach=3.0), or leave it out")

    def alone(params: Params, state: State) -> Wrench:
        own = (_checked("effects", effect, effect(params, state)) for effect in effects)
        return sum(own, rotor_wrench(params, state))

    def total_wrench(params: Params, state: State) -> Wrench:
        wrench = jax.vmap(alone)(params, state)
        state = _side_by_side(state) if drone_contact in pairs else state
        return sum((_from_others(pair, params, state, cells) for pair in pairs), wrench)

    return total_wrench


def _from_others(pair: Pair, params: Params, state: State, cells: NeighborGrid | None) -> Wrench:
    """The sum of a pair effect over all other drones, or over those within reach, for every drone of the team.

    Sums are taken component by component, over an axis in front of that of the drones acted on: so XLA's CPU compiler
    vectorises a pair along the latter.
    """
    index = jnp.arange(len(state.pos))
    state = jax.tree.map(_stored, state)

    def because_of(j, counts, other, other_state, i, own_params, own_state):
        # A drone is not its own neighbour. What does not count is moved out of reach before it is masked, so that
        # neither value nor gradient of a pair is ever taken at zero distance.
        counts = counts & (i != j)
        if cells is not None:
            x, y = vector.components(other_state.pos[:2] - own_state.pos[:2])
            counts &= x * x + y * y < cells.reach**2
        away = jnp.where(counts, 0, _OUT_OF_REACH)
        pos = jnp.stack([x + away for x in vector.components(other_state.pos)])
        wrench = _checked("pairs", pair, pair(own_params, own_state, other, other_state.replace(pos=pos)))
        components = vector.components(wrench.force) + vector.components(wrench.torque)
        return [jnp.where(counts, x, 0) for x in components]

    def on_all():
        on_each = jax.vmap(because_of, in_axes=(None, None, None, None, 0, 0, 0))
        from_each = jax.vmap(on_each, in_axes=(0, None, 0, 0, None, None, None))
        return [_sum(x) for x in from_each(index, True, params, state, index, params, state)]

    def on_near():
        other, other_state = jax.tree.map(lambda x: x.at[near].get(mode="promise_in_bounds"), (params, state))
        from_each = jax.vmap(jax.vmap(because_of), in_axes=(0, 0, 0, 0, None, None, None))
        return [_sum(x) for x in from_each(near, meant, other, other_state, index, params, state)]

    if cells is None:
        components = on_all()
    else:
        near, meant, complete = cells.near(jax.lax.stop_gradient(state.pos))
        components = jax.lax.cond(complete, on_near, on_all)
    components = [_stored(x) for x in components]
    force, torque = components[:3], components[3:]
    return Wrench(jnp.stack(force, axis=-1), jnp.stack(torque, axis=-1))


def _side_by_side(state: State) -> State:
    """The team with drones that are in exactly the same place a little above each other, in the order of their indices.

    Contact could not tell them apart: they would push each other nowhere, and stay. As all pairs see the same places,
    action stays equal to reaction.
    """
    x, y, z = state.pos.T
    same = (x[:, None] == x[None]) & (y[:, None] == y[None]) & (z[:, None] == z[None])
    rank = jnp.sum(jnp.tril(same, -1), axis=1)  # how many of lower index are there
    rounding = jnp.finfo(x.dtype).eps * jnp.max(jnp.abs(state.pos), axis=1)
    up = rank * jnp.maximum(_BESIDE, 16 * rounding)
    return state.replace(pos=state.pos + jax.lax.stop_gradient(up[:, None] * jax.vmap(rotation.z_axis)(state.quat)))


def _sum(x: jax.Array) -> jax.Array:
    """The sum over the first axis; written out where it is short, like `vector.dot`."""
    return cast(jax.Array, sum(vector.components(x))) if len(x) <= _SHORT else jnp.sum(x, axis=0)


def _stored(x: jax.Array) -> jax.Array:
    """The same numbers of a team (n, ...), each component stored by itself.

    They would be read at strides of 3 or 4, which XLA's CPU compiler does not vectorise.
    """
    if x.ndim == 1:
        return stored(x)
    return jnp.stack([_stored(jnp.squeeze(c, 1)) for c in jax.lax.split(x, [1] * x.shape[1], axis=1)], axis=1)

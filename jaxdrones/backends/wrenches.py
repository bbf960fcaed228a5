"""The sum of wrenches on a team, the same for every backend."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

from jaxdrones.dynamics import rotor_wrench
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.wrench import Wrench

Effect = Callable[[Params, State], Wrench]
Pair = Callable[[Params, State, Params, State], Wrench]

_OUT_OF_REACH = 1e3  # m
_EXAMPLE = {"effects": "drag", "pairs": "downwash", "rotors": "instant_rotors", "integrator": "rk4"}


def check_functions(name: str, functions: Sequence[Callable]) -> tuple[Callable, ...]:
    """What an argument of `make_step` holds, or an error if it is not a sequence of functions."""
    example = f"jaxdrones.{_EXAMPLE[name]}"
    if callable(functions):
        raise ValueError(f"{name} is a single function, {functions!r}; give a sequence, for example ({example},)")
    functions = tuple(functions)
    for function in functions:
        if not callable(function):
            raise ValueError(f"{name}: {function!r} is not a function; give for example {example}")
    return functions


def make_total_wrench(effects: Sequence[Effect], pairs: Sequence[Pair]) -> Callable[[Params, State], Wrench]:
    """Build `(params, state) -> Wrench` of a team: rotors, effects and pairs, one row per drone."""
    effects, pairs = check_functions("effects", effects), check_functions("pairs", pairs)

    def alone(params: Params, state: State) -> Wrench:
        return sum((effect(params, state) for effect in effects), rotor_wrench(params, state))

    def total_wrench(params: Params, state: State) -> Wrench:
        wrench = jax.vmap(alone)(params, state)
        return sum((_from_others(pair, params, state) for pair in pairs), wrench)

    return total_wrench


def _from_others(pair: Pair, params: Params, state: State) -> Wrench:
    """The sum of a pair effect over all other drones, for every drone of the team."""
    index = jnp.arange(len(state.pos))

    def on(i, own_params, own_state):
        def because_of(j, other, other_state):
            # A drone is not its own neighbour. Its copy is moved out of reach before it is masked, so that
            # neither value nor gradient of a pair is ever taken at zero distance.
            itself = i == j
            other_state = other_state.replace(pos=other_state.pos + jnp.where(itself, _OUT_OF_REACH, 0))
            wrench = pair(own_params, own_state, other, other_state)
            return jax.tree.map(lambda x: jnp.where(itself, 0, x), wrench)

        wrenches = jax.vmap(because_of)(index, params, state)
        return jax.tree.map(lambda x: jnp.sum(x, axis=0), wrenches)

    return jax.vmap(on)(index, params, state)

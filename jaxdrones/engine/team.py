"""What every backend demands of a team, and its parameters as one array."""

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones.checks import check_arrays, check_params, check_quaternion, check_shape
from jaxdrones.params import Params
from jaxdrones.state import State

_SHAPES = {
    "inertia": (3,),
    "rotor_pos": (4, 3),
    "rotor_spin": (4,),
    "wind": (3,),
    "external_force": (3,),
    "drag_coeff": (3,),
    "downwash_coeff": (3,),
}
_STATE = {"pos": 3, "quat": 4, "vel": 3, "omega": 3, "rpm": 4}


def check_team(params: Params, state: State, rpm: Any) -> None:
    """Raise `ValueError` unless the arrays are those of one team of n drones."""
    check_arrays("state", vars(state))
    check_arrays("params", vars(params))
    check_shape("state.pos", state.pos, ("n", 3), "one row per drone, at least one drone; for many worlds use jax.vmap")
    n = len(state.pos)
    for name, width in _STATE.items():
        check_shape(f"state.{name}", getattr(state, name), (n, width), f"state.pos has {n} drones")
    for name, leaf in vars(params).items():
        hint = f"state.pos has {n} drones; make a team with jaxdrones.repeat or jaxdrones.stack"
        check_shape(f"params.{name}", leaf, (n, *_SHAPES.get(name, ())), hint)
    check_shape("rpm", rpm, (n, 4), f"four rotor speeds for each of {n} drones")


def check_values(params: Params, state: State) -> None:
    """Raise `ValueError` where values, not shapes, make no flight, and can be looked at: constants and attitudes."""
    check_params(params, finite=False)
    check_arrays("state", vars(state))
    check_quaternion("state.quat", state.quat)


def flatten(params: Params) -> Float[Array, "n k"]:
    """All numbers of a team's parameters as one array, a row per drone."""
    return jnp.concatenate([jnp.reshape(leaf, (len(leaf), -1)) for leaf in vars(params).values()], axis=-1)


def unflatten(flat: Float[Array, "n k"]) -> Params:
    """The parameters that `flatten` made one array of."""
    shapes = {field.name: _SHAPES.get(field.name, ()) for field in dataclasses.fields(Params)}
    ends = np.cumsum([math.prod(shape) for shape in shapes.values()])[:-1]
    columns = jnp.split(flat, ends, axis=-1)
    return Params(
        **{
            name: jnp.reshape(column, (len(flat), *shape))
            for (name, shape), column in zip(shapes.items(), columns, strict=True)
        }
    )

"""Validation of teams, and packing of their pytrees into one array."""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdrones.checks import check_arrays, check_finite, check_quaternion, check_shape, short_repr
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.state import State

_SHAPES = {
    "inertia": (3,),
    "rotor_pos": (4, 3),
    "rotor_spin": (4,),
    "wind": (3,),
    "external_force": (3,),
    "drag_coeff": (3,),
    "flapping_coeff": (2,),
    "flapping_climb": (3,),
    "rate_damping": (3,),
    "trim_torque": (3,),
    "downwash_coeff": (3,),
}
_STATE = {"pos": 3, "quat": 4, "vel": 3, "omega": 3, "rpm": 4}
_CONSTANTS = [field.name for field in dataclasses.fields(Params) if field.name != "aux"]


def check_team(params: Params, state: State, rpm: Any) -> None:
    """Raise `ValueError` unless the arrays are those of one team of n drones."""
    check_arrays(state=state, params=params)
    check_shape("state.pos", state.pos, ("n", 3), "one row per drone, at least one drone; for many worlds use jax.vmap")
    n = len(state.pos)
    drones, team = f"state.pos has {n} drones", "make a team with jaxdrones.repeat or jaxdrones.stack"
    expected: list[tuple[str, Any, tuple[int, ...], str]] = [
        (f"state.{name}", getattr(state, name), (width,), drones) for name, width in _STATE.items()
    ]
    for name in _CONSTANTS:
        expected.append((f"params.{name}", getattr(params, name), _SHAPES.get(name, ()), f"{drones}; {team}"))
    for name, array, of_one, meaning in (*expected, ("rpm", rpm, (4,), f"four rotor speeds for each of {n} drones")):
        check_shape(name, array, (n, *of_one), meaning)
    for name, aux in ("state.aux", state.aux), ("params.aux", params.aux):
        _check_aux(name, aux, n)


def _check_aux(name: str, aux: Any, n: int) -> None:
    if not isinstance(aux, dict):
        raise UserError(f"{name} is {short_repr(aux)}; give a dictionary with names of models as keys")
    for path, leaf in jax.tree_util.tree_leaves_with_path(aux):
        where = name + jax.tree_util.keystr(path)
        if jnp.shape(leaf)[:1] != (n,):
            raise UserError(f"{where} has shape {jnp.shape(leaf)}; give arrays with a leading axis over {n} drones")
        if name == "state.aux" and not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            raise UserError(f"{where} holds {jnp.result_type(leaf)}; give floating-point numbers")


def check_state(name: str, state: State) -> None:
    """Raise `ValueError` for concrete states that cannot fly."""
    check_arrays(**{name: state})
    check_finite(name, state)
    check_quaternion(f"{name}.quat", state.quat)


class Layout(NamedTuple):
    """Column layout of a pytree of arrays (n, ...) in one array; hashable."""

    structure: Any
    shapes: tuple[tuple[int, ...], ...]
    """Of the leaves, without the axis over drones."""

    @classmethod
    def of(cls, tree: Any) -> "Layout":
        """Layout of a pytree."""
        leaves, structure = jax.tree.flatten(tree)
        return cls(structure, tuple(jnp.shape(leaf)[1:] for leaf in leaves))

    def unpack(self, flat: Any, start: int = 0) -> Any:
        """Pytree of the columns of an array (n, k) of JAX or NumPy from `start` on; the inverse of `pack`."""
        leaves = []
        for shape in self.shapes:
            end = start + math.prod(shape)
            leaves.append(flat[:, start:end].reshape(len(flat), *shape))
            start = end
        return self.structure.unflatten(leaves)


def pack(tree: Any, n: int) -> Float[Array, "n k"]:
    """Pack a pytree of arrays (n, ...) into one array, a row per drone."""
    return jnp.concatenate([jnp.zeros((n, 0)), *columns(tree, n)], axis=-1)


def columns(tree: Any, n: int) -> list[Array]:
    """Arrays (n, ...) of a pytree as arrays (n, k)."""
    return [jnp.reshape(leaf, (n, -1)) for leaf in jax.tree.leaves(tree)]

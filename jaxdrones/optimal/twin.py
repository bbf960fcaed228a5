"""Symbolic twin: the equations of motion as a CasADi function."""

import dataclasses
import os
from collections.abc import Sequence
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxdrones.arguments import checked, choices
from jaxdrones.checks import short_repr
from jaxdrones.dynamics.model import Model
from jaxdrones.dynamics.rotors import instant_rotors
from jaxdrones.engine.explicit import make_derivative
from jaxdrones.engine.physics import Physics, Rotors
from jaxdrones.engine.wrenches import Effect, Pair, TeamEffect
from jaxdrones.errors import UserError
from jaxdrones.optimal.interpreter import on_symbols
from jaxdrones.optimal.primitives import casadi
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.state import State
from jaxdrones.urdf import load_params

_BARE = Scene()
_FIELDS = tuple(field.name for field in dataclasses.fields(Params) if field.name != "aux")


@dataclasses.dataclass(frozen=True)
class CasadiModel:
    """Equations of motion x' = f(x, u, p) of a drone or a team, with their symbols."""

    function: Any
    """`casadi.Function` with the inputs `x`, `u` and, with symbolic constants, `p`, and the output `xdot`."""
    x: Any
    """(nx,) `casadi.SX`, the state: see `names`."""
    u: Any
    """(4 n,) `casadi.SX`, commanded rotor speeds, RPM, or PWM of `pwm_rotors`, drone after drone."""
    p: Any
    """(np,) `casadi.SX`, symbolic constants: see `parameter_names`."""
    xdot: Any
    """(nx,) `casadi.SX`, the rate of the state, per second."""
    params: Params
    """Constants of the drone or the team, NumPy arrays in double precision."""
    names: tuple[str, ...]
    """(nx) entries of the state: `pos[0]` of a drone, `pos[1,0]` of the second drone of a team."""
    parameter_names: tuple[str, ...]
    """(np) entries of p."""
    start: State
    """State of the same structure, NumPy arrays: level, at rest at the origin."""
    takes_pwm: bool = False
    """Whether `u` is PWM."""

    def vector(self, state: State) -> np.ndarray:
        """(nx,) vector of a state, in the order of `names`."""
        given, wanted = (jax.tree.map(np.shape, s) for s in (state, self.start))
        if given != wanted:
            raise UserError(f"the state has shapes {short_repr(str(given))}; expected {short_repr(str(wanted))}")
        return np.concatenate([np.ravel(np.asarray(leaf, float)) for leaf in jax.tree.leaves(state)])

    def state(self, vector: ArrayLike) -> State:
        """State of a vector (nx,)."""
        numbers = np.asarray(vector, float).ravel()
        leaves, structure = jax.tree.flatten(self.start)
        parts = np.split(numbers, np.cumsum([leaf.size for leaf in leaves])[:-1])
        shaped = [jnp.asarray(part.reshape(leaf.shape), float) for part, leaf in zip(parts, leaves, strict=True)]
        return jax.tree.unflatten(structure, shaped)

    def parameters(self, params: Params) -> np.ndarray:
        """(np,) values of the symbolic constants of the same drone or team."""
        fields = self._symbolic(params).values()
        return np.concatenate([np.zeros(0), *map(np.ravel, fields)])

    def with_parameters(self, params: Params) -> Params:
        """Constants of the model, with the given values of the symbolic ones."""
        return self.params.replace(**self._symbolic(params))

    def _symbolic(self, params: Params) -> dict[str, np.ndarray]:
        fields = dict.fromkeys(name.partition("[")[0] for name in self.parameter_names)
        return {name: np.asarray(getattr(params, name), float) for name in fields}


@checked
def casadi_model(
    vehicle: str | os.PathLike | Params,
    effects: Sequence[Effect] = (),
    *,
    pairs: Sequence[Pair] = (),
    team_effects: Sequence[TeamEffect] = (),
    models: Sequence[Model] = (),
    rotors: Rotors = instant_rotors,
    scene: Scene = _BARE,
    parameters: Annotated[Sequence[str], choices("field of Params", _FIELDS, "'wind'")] = (),
) -> CasadiModel:
    """Convert the equations of motion of `jaxdrones.make_derivative` to a CasADi function.

    The traced program, with built-in or custom effects, is evaluated on symbols in double precision. It is for one
    drone, or for a team with the constants of a team, which pairs and team effects need. The vehicle is a bundled one,
    the path of a URDF, or constants; `parameters` are names of fields of `Params` to keep as symbols, such as
    `("wind",)`; other arguments are those of `make_derivative`.

    Returns:
        The function, its symbols, and the mapping between a `State` and a vector.

    Raises:
        NotImplementedError: an effect or model with an unsupported JAX primitive.
        ValueError: an unknown vehicle or parameter, or an argument that `make_derivative` rejects.
    """
    with jax.enable_x64(True):
        loaded = vehicle if isinstance(vehicle, Params) else load_params(vehicle)
        params = jax.tree.map(_as_double, loaded)
        team, one = params, np.ndim(params.mass) == 0
        if one:
            if pairs or team_effects:
                raise UserError(
                    "pairs or team_effects are given and the constants are of one drone; give those of a team, for "
                    "example of jaxdrones.repeat(params, 2)"
                )
            team = jax.tree.map(lambda x: x[None], params)
        n = len(team.mass)
        derivative = make_derivative(effects, pairs, team_effects, models, rotors)
        at_rest = State.at_rest(jnp.zeros((n, 3)))
        physics = Physics(effects, pairs, team_effects, models, rotors)
        start = physics.init(team, at_rest)

        def rate(state: State, command: Any, chosen: dict[str, Any]) -> State:
            return derivative(team.replace(**chosen), state, command, scene)

        chosen = {name: getattr(team, name) for name in sorted(parameters)}
        (x, u, p), xdot = on_symbols(rate, x=start, u=jnp.zeros((n, 4)), p=chosen)
        if one:
            start, chosen = jax.tree.map(lambda leaf: leaf[0], (start, chosen))
        params, start = jax.device_get((params, start))
    given, labels = ([x, u, p], ["x", "u", "p"]) if parameters else ([x, u], ["x", "u"])
    function = casadi.Function("f", given, [xdot], labels, ["xdot"])
    return CasadiModel(function, x, u, p, xdot, params, _names(start), _names(chosen), start, physics.takes_pwm)


def _as_double(leaf: Any) -> Any:
    return jnp.asarray(leaf, float) if jnp.issubdtype(jnp.result_type(leaf), jnp.floating) else leaf


def _names(tree: Any) -> tuple[str, ...]:
    names = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        name = ".".join(str(getattr(key, "name", getattr(key, "key", key))) for key in path)
        places = [",".join(map(str, place)) for place in np.ndindex(np.shape(leaf))]
        names += [f"{name}[{place}]" if place else name for place in places]
    return tuple(names)

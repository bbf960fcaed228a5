"""Models with a continuous state, for example a battery, a gust filter, flapping blades or a motor controller."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
from jaxtyping import Array, Float

from jaxdrones.checks import bind, check_function, short_repr
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.state import State


class PointMass(PyTreeNode):
    """Point mass as the state of a model, or its time derivative: velocity and acceleration.

    Semi-implicit Euler moves it with its new velocity, like a drone.
    """

    pos: Array
    """(3,) position, m, world."""
    vel: Array
    """(3,) velocity, m/s, world."""


@dataclasses.dataclass(frozen=True)
class Model:
    """Differential equation integrated with the rigid body; its state is `state.aux[name]`.

    It is integrated with the order of the integrator; the Bullet backend uses explicit Euler, and semi-implicit Euler
    for a `PointMass`.
    """

    name: str
    """Key of `State.aux`."""
    init: Callable[..., Any]
    """`init(params)`: initial state, a pytree of floating-point arrays. A parameter named `state` receives that of the
    drone."""
    rate: Callable[[Params, State, Float[Array, "4"]], Any]
    """`rate(params, state, command)`: time derivative of the state, a pytree of the same type; `command` is the
    commanded rotor speeds, RPM, before any limit."""
    of_team: bool = False
    """Whether `init` and `rate` are written for a team, with a leading drone axis on every array, not for one drone."""

    def __post_init__(self):
        if not isinstance(self.name, str) or not self.name:
            raise UserError(f"name of a model is {short_repr(self.name)}; give a string that is not empty")
        for field, arguments in ("init", ("params",)), ("rate", ("params", "state", "command")):
            function = getattr(self, field)
            function = bind(function, state=None) if field == "init" else function
            check_function(f"{field} of the model {self.name!r}", function, arguments)

    def start(self, params: Params, state: State) -> Any:
        """Initial state of a team in a state without models, every array with a leading drone axis."""

        def init(params: Params, state: State) -> Any:
            return bind(self.init, state=state)(params)

        return init(params, state) if self.of_team else jax.vmap(init)(params, state)

    def team_rate(self, params: Params, state: State, command: Float[Array, "n 4"]) -> Any:
        """Time derivative of the state of a team."""
        rate = (self.rate if self.of_team else jax.vmap(self.rate))(params, state, command)
        given, wanted = jax.eval_shape(lambda: rate), jax.eval_shape(lambda: state.aux[self.name])
        if _type(given) != _type(wanted):
            raise UserError(
                f"rate of the model {self.name!r} returned {given}; return a pytree like the model's state, {wanted}"
            )
        return rate


def constants(params: Params, name: str, example: str) -> Any:
    """Constants of a model, `params.aux[name]`.

    Raises:
        ValueError: missing constants; the message shows `example`.
    """
    if name not in params.aux:
        found = ", ".join(params.aux) or "nothing"
        raise UserError(
            f"params.aux lacks {name!r}; found {found}; give params.replace(aux=params.aux | {{{name!r}: {example}}})"
        )
    return params.aux[name]


def _type(tree: Any) -> tuple:
    return jax.tree.structure(tree), [(x.shape, x.dtype) for x in jax.tree.leaves(tree)]

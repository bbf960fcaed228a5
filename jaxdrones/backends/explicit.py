"""The pure-JAX backend: `step(params, state, rpm) -> state` for one world."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

from jaxdrones.backends.team import check_team
from jaxdrones.checks import check_positive, check_whole
from jaxdrones.dynamics import instant_rotors, newton_euler, quat_rate, rotor_wrench, semi_implicit_euler
from jaxdrones.dynamics.integrators import Integrator
from jaxdrones.params import Params
from jaxdrones.state import State
from jaxdrones.wrench import Wrench

Effect = Callable[[Params, State], Wrench]
Pair = Callable[[Params, State, Params, State], Wrench]
Step = Callable[[Params, State, jax.Array], State]

_OUT_OF_REACH = 1e3  # m


def make_step(
    effects: Sequence[Effect] = (),
    pairs: Sequence[Pair] = (),
    rotors: Callable = instant_rotors,
    integrator: Integrator = semi_implicit_euler,
    dt: float = 1 / 240,
    substeps: int = 1,
) -> Step:
    """Build the step of a world.

    Args:
        effects: wrenches on a drone by itself, `(params, state) -> Wrench`: `drag`, `ground_effect`, your own.
        pairs: wrenches on a drone because of another, `(params, state, other, other_state) -> Wrench`: `downwash`.
        rotors: `instant_rotors` or `lagging_rotors`.
        integrator: `semi_implicit_euler`, `euler`, `rk4` or `implicit_midpoint`.
        dt: physics step, s.
        substeps: physics steps per call, with the command held.

    Returns:
        `step(params, state, rpm) -> state`, pure and compiled: params and state of a team of n drones,
        rpm (n, 4) the commanded rotor speeds. It does not clip the command. It raises `ValueError` on a wrong shape.

    Raises:
        ValueError: `dt` or `substeps` not positive, or an argument that should be a function and is not.
    """
    check_positive("dt", dt, "s")
    check_whole("substeps", substeps)
    effects, pairs = _functions("effects", effects), _functions("pairs", pairs)
    _functions("rotors", [rotors])
    _functions("integrator", [integrator])

    def derivative(params: Params, state: State, command: jax.Array) -> State:
        rpm, rpm_rate = jax.vmap(rotors)(params, state.rpm, command)
        state = state.replace(rpm=rpm)
        wrench = jax.vmap(lambda p, s: sum((effect(p, s) for effect in effects), rotor_wrench(p, s)))(params, state)
        for pair in pairs:
            wrench = wrench + _from_others(pair, params, state)
        acc, omega_rate = jax.vmap(newton_euler)(params, state, wrench)
        return State(pos=state.vel, quat=jax.vmap(quat_rate)(state), vel=acc, omega=omega_rate, rpm=rpm_rate)

    def step(params: Params, state: State, rpm: jax.Array) -> State:
        rpm = jnp.asarray(rpm, state.rpm.dtype)  # whole numbers too: a rotor speed is real, and squared
        check_team(params, state, rpm)
        speed, _ = jax.vmap(rotors)(params, state.rpm, rpm)
        state = state.replace(rpm=speed)

        def substep(state: State, _: None) -> tuple[State, None]:
            return integrator(lambda s: derivative(params, s, rpm), state, dt), None

        return substep(state, None)[0] if substeps == 1 else jax.lax.scan(substep, state, length=substeps)[0]

    return jax.jit(step, inline=True)


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


def _functions(name: str, functions: Sequence[Callable]) -> tuple[Callable, ...]:
    """What an argument of `make_step` holds, or an error if it is not a sequence of functions."""
    example = f"jaxdrones.{_EXAMPLE[name]}"
    if callable(functions):
        raise ValueError(f"{name} is a single function, {functions!r}; give a sequence, for example ({example},)")
    functions = tuple(functions)
    for function in functions:
        if not callable(function):
            raise ValueError(f"{name}: {function!r} is not a function; give for example {example}")
    return functions


_EXAMPLE = {"effects": "drag", "pairs": "downwash", "rotors": "instant_rotors", "integrator": "rk4"}

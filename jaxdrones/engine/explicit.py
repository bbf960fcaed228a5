"""The pure-JAX backend: `step(params, state, rpm) -> state` for one world."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from jaxdrones.accelerate.stored import stored, stored_for_derivatives
from jaxdrones.checks import check_positive, check_whole
from jaxdrones.dynamics import instant_rotors, newton_euler, quat_rate, semi_implicit_euler
from jaxdrones.dynamics.integrators import Integrator
from jaxdrones.dynamics.rotors import limited
from jaxdrones.engine.host import is_traced
from jaxdrones.engine.neighbors import NeighborGrid
from jaxdrones.engine.team import check_team, check_values
from jaxdrones.engine.wrenches import Effect, Pair, check_functions, describe, make_total_wrench
from jaxdrones.params import Params
from jaxdrones.state import State

Step = Callable[[Params, State, jax.Array], State]


def make_step(
    effects: Sequence[Effect] = (),
    pairs: Sequence[Pair] = (),
    rotors: Callable = instant_rotors,
    integrator: Integrator = semi_implicit_euler,
    dt: float = 1 / 240,
    substeps: int = 1,
    cells: NeighborGrid | None = None,
) -> Callable[[Params, State, ArrayLike], State]:
    """Build the step of a world.

    Args:
        effects: wrenches on a drone by itself, `(params, state) -> Wrench`: `drag`, `ground_effect`, your own.
        pairs: wrenches on a drone because of another, `(params, state, other, other_state) -> Wrench`: `downwash`.
        rotors: `instant_rotors` or `lagging_rotors`.
        integrator: `semi_implicit_euler`, `euler`, `rk4` or `implicit_midpoint`.
        dt: physics step, s.
        substeps: physics steps per call, with the command held.
        cells: limits pairs to drones near each other, which is faster from some 700 drones on.

    Returns:
        `step(params, state, rpm) -> state`, pure and compiled: params and state of a team of n drones,
        rpm (n, 4) the commanded rotor speeds. The rotors limit them to [0, `params.max_rpm`], and so the speeds that
        a state starts with. There is no floor: drones fall through z = 0 unless `ground_contact` is among the
        effects, and pass through each other unless `drone_contact` is among the pairs. It raises `ValueError` on a
        wrong shape, and where it is called with values, on constants that do not fly and on quaternions that are no
        attitude.

    Raises:
        ValueError: `dt` or `substeps` not positive, or an argument that should be a function and is not.
    """
    check_positive("dt", dt, "s")
    check_whole("substeps", substeps)
    check_functions("rotors", [rotors])
    check_functions("integrator", [integrator])
    effects, pairs = check_functions("effects", effects), check_functions("pairs", pairs)
    total_wrench = make_total_wrench(effects, pairs, cells)

    def derivative(params: Params, state: State, command: jax.Array) -> State:
        rpm, rpm_rate = jax.vmap(rotors)(params, state.rpm, command)
        state = state.replace(rpm=rpm)
        acc, omega_rate = jax.vmap(newton_euler)(params, state, total_wrench(params, state))
        rate = State(pos=state.vel, quat=jax.vmap(quat_rate)(state), vel=acc, omega=omega_rate, rpm=rpm_rate)
        return stored(rate)  # rk4 takes 39 instead of 72 ns, its gradient 240 instead of 570

    def step(params: Params, state: State, rpm: ArrayLike) -> State:
        rpm = jnp.asarray(rpm, state.rpm.dtype)  # whole numbers too: a rotor speed is real, and squared
        check_team(params, state, rpm)
        speed, _ = jax.vmap(rotors)(params, jax.vmap(limited)(params, state.rpm), rpm)
        state = state.replace(rpm=speed)

        # Recomputing a substep in a backward pass is faster than storing more of it than the state at its start.
        @jax.checkpoint
        def substep(state: State, _: None) -> tuple[State, None]:
            start, command = stored_for_derivatives((state, rpm))
            return integrator(lambda s: derivative(params, s, command), start, dt), None

        return substep(state, None)[0] if substeps == 1 else jax.lax.scan(substep, state, length=substeps)[0]

    text = f"{describe([integrator])} at {1 / (dt * substeps):.4g} Hz x {substeps}, {describe([rotors])}"
    text += f", effects: {describe(effects)}, pairs: {describe(pairs)}" + (f", {cells}" if cells else "")
    return _ExplicitStep(jax.jit(step, inline=True), text)


class _ExplicitStep:
    """A compiled step that looks at what it is given, where that has values: once at constants and at a start."""

    def __init__(self, compiled: Callable[..., State], text: str):
        self._compiled, self._text = compiled, text
        self._params: Params | None = None  # what was looked at last, and the attitude that was flown to
        self._quat: jax.Array | None = None

    def __call__(self, params: Params, state: State, rpm: ArrayLike) -> State:
        if params is not self._params or state.quat is not self._quat:
            check_values(params, state)
        state = self._compiled(params, state, rpm)
        if not is_traced(state.quat):
            self._params, self._quat = params, state.quat
        return state

    def __repr__(self) -> str:
        return f"<step: {self._text}>"

"""JAX backend: the derivative of a team, and `step(params, state, rpm) -> state` for one world."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Annotated

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxdrones.accelerate.apart import apart_under_vmap
from jaxdrones.accelerate.shared import recomputed
from jaxdrones.arguments import Count, TimeStep, checked
from jaxdrones.checks import check_params, check_quaternion
from jaxdrones.dynamics import INTEGRATORS
from jaxdrones.dynamics.integrators import Integrator, semi_implicit_euler
from jaxdrones.dynamics.model import Model
from jaxdrones.dynamics.needs import needs_of
from jaxdrones.dynamics.rigid_body import newton_euler, quat_rate
from jaxdrones.dynamics.rotors import instant_rotors, limited
from jaxdrones.engine.clearance import NearObstacles
from jaxdrones.engine.neighbors import NeighborGrid
from jaxdrones.engine.physics import Contact, Physics, Rotors, check_function_of_step
from jaxdrones.engine.step import Step, is_traced
from jaxdrones.engine.team import check_team
from jaxdrones.engine.wrenches import Effect, Pair, TeamEffect, describe
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.state import State

Derivative = Callable[..., State]
"""`(params, state, command, scene=Scene())` -> time derivative of the state, of a team."""

_BARE = Scene()


def make_derivative(
    effects: Sequence[Effect] = (),
    pairs: Sequence[Pair] = (),
    team_effects: Sequence[TeamEffect] = (),
    models: Sequence[Model] = (),
    rotors: Rotors = instant_rotors,
    neighbors: NeighborGrid | None = None,
) -> Derivative:
    """Build the equations of motion of a team, for linearization, sensors and custom integrators.

    Arguments are those of `make_step`.

    Returns:
        `derivative(params, state, command, scene=Scene()) -> State`, pure: params and state of a team of n drones,
        command (n, 4) the commanded rotor speeds, RPM. The rate has the type of the state: `pos` m/s, `quat` 1/s,
        `vel` m/s^2 (world), `omega` rad/s^2 (body), `rpm` RPM/s, and that of every model in `aux`. Other leaves (extra
        fields of a subclass of `State`, `aux` without a model) have a zero rate. Rotors without a lag have their
        commanded speed, whatever `state.rpm` is.
    """
    of_team = _derivative_of(Physics(effects, pairs, team_effects, models, rotors, neighbors))

    def derivative(params: Params, state: State, command: Float[Array, "n 4"], scene: Scene = _BARE) -> State:
        return of_team(params, state, command, scene)

    return derivative


def _derivative_of(physics: Physics) -> Derivative:
    def derivative(
        params: Params,
        state: State,
        command: Float[Array, "n 4"],
        scene: Scene,
        contact: Contact | None = None,
    ) -> State:
        loads = physics.loads(params, state, command, scene, contact)
        acc, omega_rate = jax.vmap(newton_euler)(params, loads.state, loads.wrench)
        still = jax.tree.map(jnp.zeros_like, state)
        return still.replace(
            pos=state.vel,
            quat=jax.vmap(quat_rate)(state),
            vel=acc,
            omega=omega_rate,
            rpm=loads.rpm_rate,
            aux=still.aux | loads.aux_rate,
        )

    return derivative


@checked
def make_step(
    effects: Sequence[Effect] = (),
    pairs: Sequence[Pair] = (),
    rotors: Rotors = instant_rotors,
    integrator: Annotated[Integrator, check_function_of_step] = semi_implicit_euler,
    dt: TimeStep = 1 / 240,
    substeps: Count = 1,
    *,
    team_effects: Sequence[TeamEffect] = (),
    models: Sequence[Model] = (),
    neighbors: NeighborGrid | None = None,
    scene: Scene = _BARE,
) -> ExplicitStep:
    """Build the step of a world.

    Args:
        effects: wrenches on one drone, `(params, state) -> Wrench`, such as `drag` and `ground_effect`. A parameter
            named `scene` receives the scene, as in `obstacle_contact` and `ground_contact`.
        pairs: wrenches on a drone by another one, `(params, state, other, other_state) -> Wrench`, such as `downwash`.
        rotors: `instant_rotors`, `lagging_rotors`, or a function `(params, state, command) -> (rpm, rpm_rate)`.
        integrator: `semi_implicit_euler`, `euler`, `midpoint`, `implicit_midpoint` or `rk4`.
        dt: physics step, s.
        substeps: physics steps per call, with the command held.
        team_effects: wrenches on all drones of the team, `(params, state) -> Wrench` with force and torque (n, 3), such
            as cables between drones.
        models: additional differential equations, such as a battery; their states are in `state.aux`.
        neighbors: limits pairs to nearby drones, which is faster for teams of several hundred drones.
        scene: default scene of effects with a `scene` parameter. A call can override it.

    Returns:
        `step(params, state, rpm) -> state`, pure and compiled: params and state of a team of n drones,
        rpm (n, 4) the commanded rotor speeds, which the rotors limit to [0, `params.max_rpm`]. There is no floor:
        drones fall through z = 0 without `ground_contact` in `effects`, and pass through each other without
        `drone_contact` in `pairs`. The step raises `ValueError` on a wrong shape, and with concrete arguments on
        constants that cannot fly, on a wind or an external force on which no effect depends, on rotors that lag by less
        than half of `dt`, and on quaternions that are not of unit length.

    Raises:
        ValueError: `dt` or `substeps` not positive, an argument that is not a function or a model, a scene with
            obstacles without an effect that uses it, or `dt` above 1 s or above that with which an effect is stable:
            1/240 s for contact, 1/100 s for `cable`.
    """
    physics = Physics(effects, pairs, team_effects, models, rotors, neighbors)
    _check_stable(physics, dt, substeps)
    return ExplicitStep(physics, integrator, dt, substeps, scene)


def _check_stable(physics: Physics, dt: float, substeps: int) -> None:
    functions = (*physics.effects, *physics.pairs, *physics.team_effects)
    largest = min((needs_of(f).largest_step for f in functions), default=math.inf)
    if dt > largest * (1 + 1e-6):
        stiff = describe([f for f in functions if needs_of(f).largest_step == largest])
        times = math.ceil(dt / largest - 1e-6)
        raise UserError(
            f"dt is {dt:.4g} s and {stiff} is stable up to 1/{1 / largest:.0f} s; give dt={dt / times:.4g} and "
            f"substeps={times * substeps}"
        )


class ExplicitStep(Step):
    """Compiled step that validates new concrete inputs once."""

    def __init__(self, physics: Physics, integrator: Integrator, dt: float, substeps: int, scene: Scene):
        self.physics, self._scene, self.dt, self.substeps = physics, scene, dt, substeps
        self.integrator = describe([integrator])
        self._divides = integrator not in INTEGRATORS.values()  # a user's own may divide the physics step
        self.period = dt * substeps
        self._check_scene(scene)
        self._text = f"{self.integrator} at {1 / (dt * substeps):.4g} Hz x {substeps}, {physics}"
        derivative = _derivative_of(physics)

        def within_limits(params: Params, state: State, rpm: ArrayLike) -> tuple[State, jax.Array]:
            """State with limited rotor speeds, and commanded rotor speeds."""
            command = jnp.asarray(rpm, state.rpm.dtype)  # whole numbers too: a rotor speed is real, and squared
            check_team(params, state, command)
            return state.replace(rpm=jax.vmap(limited)(params, state.rpm)), command

        @apart_under_vmap
        def step(params: Params, state: State, rpm: ArrayLike, scene: Scene) -> State:
            state, command = within_limits(params, state, rpm)
            near = NearObstacles(physics.contacts("obstacles"), state, scene) if physics.touches(scene) else None

            @recomputed
            def substep(state: State, command: jax.Array) -> State:
                start = physics.at_speed(params, state, command)

                def advance(contact: Contact | None) -> State:
                    return integrator(lambda s: derivative(params, s, command, scene, contact), start, dt)

                return near.step(params, start, advance) if near else advance(None)

            if substeps == 1:
                return substep(state, command)
            return jax.lax.scan(lambda state, _: (substep(state, command), None), state, length=substeps)[0]

        def rate(params: Params, state: State, rpm: ArrayLike, scene: Scene) -> State:
            state, command = within_limits(params, state, rpm)
            return derivative(params, physics.at_speed(params, state, command), command, scene)

        self._step, self._rate = jax.jit(step, inline=True), jax.jit(rate, inline=True)
        self._params: Params | None = None  # inputs that were validated last, and the resulting attitude
        self._quat: jax.Array | None = None

    def __call__(self, params: Params, state: State, rpm: ArrayLike, scene: Scene | None = None) -> State:
        """Advance a team by one control step; see `make_step`."""
        given, is_new = self._given(scene), params is not self._params or state.quat is not self._quat
        if is_new:
            check_params(params, finite=False)
            self.check_lag(params)
            check_quaternion("state.quat", state.quat)
        after = self._step(params, state, rpm, given)
        if is_new:
            self.physics.check_acts(params, state, given)
        if not is_traced(after.quat):
            self._params, self._quat = params, after.quat
        return after

    def check_lag(self, params: Params) -> None:
        """Raise for rotors whose lag is too short for the physics step."""
        if not self._divides:
            self.physics.check_lag(params, self.dt)

    def rate(self, params: Params, state: State, rpm: ArrayLike, scene: Scene | None = None) -> State:
        """Time derivative of the state, with rotors without a lag at their commanded speed; see `make_derivative`."""
        return self._rate(params, state, rpm, self._given(scene))

    def __repr__(self) -> str:
        return f"<step: {self._text}>"

    def _given(self, scene: Scene | None) -> Scene:
        """Part of the scene of a call that effects depend on."""
        if scene is None:
            scene = self._scene
        else:
            self._check_scene(scene)
        return self.physics.seen(scene)

    def _check_scene(self, scene: Scene) -> None:
        if not isinstance(scene, Scene):
            raise UserError(f"scene is {scene!r}; give a jaxdrones.sensing.Scene")
        if scene.has_obstacles and not self.physics.takes_scene:
            raise UserError(
                "the scene has obstacles, but no effect uses it, so drones would fly through them; give "
                "jaxdrones.obstacle_contact or another effect (params, state, scene) -> Wrench, leave the obstacles "
                "out, or use the bullet backend"
            )

"""Plant of jaxdrones with the features of other simulators, one at a time, and the remaining differences.

A `Setup` has the parts of our plant, and a cause changes one of them. `attribution` simulates the plant with defaults,
with all causes, and with all but one: the effect of a cause is the difference that remains without it.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from benchmarks.rivals.ours import angle
from jaxdrones import rotation

RADIANS_PER_SECOND = 2 * np.pi / 60  # per RPM
BEFORE = "before"
"""Name in `Params.aux` of attitude and rotor speeds at the start of the last step, which some of the others use."""


@dataclasses.dataclass(frozen=True)
class Setup:
    """A plant of ours."""

    params: jd.Params
    effects: tuple[Callable, ...] = ()
    rotors: Callable = jd.instant_rotors
    integrator: Callable = jd.semi_implicit_euler
    fly: Callable | None = None
    """(setup, start, tape, dt) -> the states, in place of a step of ours; another solver of our law of motion."""

    def but(self, **changes: Any) -> "Setup":
        """The same with other fields, or other fields of its parameters."""
        own = {name: x for name, x in changes.items() if name in self.__dataclass_fields__}
        params = {name: jnp.asarray(x, float) for name, x in changes.items() if name not in own}
        return dataclasses.replace(self, params=self.params.replace(**params), **own)

    def plus(self, *effects: Callable) -> "Setup":
        """The same with further effects."""
        return self.but(effects=(*self.effects, *effects))


@dataclasses.dataclass(frozen=True)
class Cause:
    """Something that another simulator does differently."""

    kind: str
    """gyroscopic term, attitude integration, integration, drag, rotor model, inertia, frame or constant."""
    what: str
    switch: Callable[[Setup], Setup]
    """Ours as it is -> ours as the other has it."""


def flown(setup: Setup, start: jd.State, tape: np.ndarray, dt: float) -> jd.State:
    """The states of one drone after each row of a tape of commands (T, 4), RPM."""
    if setup.fly is not None:
        return setup.fly(setup, start, tape, dt)
    step = jd.make_step(effects=setup.effects, rotors=setup.rotors, integrator=setup.integrator, dt=dt)

    @jax.jit
    def fly(params: jd.Params, start: jd.State, tape: jax.Array) -> jd.State:
        def advance(carry, rpm):
            before, state = carry
            aux = {BEFORE: before}
            after = step(_team(params.replace(aux=aux)), _team(state), rpm[None])
            after = jax.tree.map(lambda x: x[0], after)
            return ({"quat": state.quat, "rpm": rpm}, after), after

        before = {"quat": start.quat, "rpm": jnp.zeros(4)}
        return jax.lax.scan(advance, (before, start), tape)[1]

    return fly(setup.params, start, jnp.asarray(tape))


def _team(tree: Any) -> Any:
    return jax.tree.map(lambda x: x[None], tree)


def differences(ours: jd.State, theirs: dict[str, np.ndarray]) -> dict[str, float]:
    """Largest difference in a flight: of the position (m), attitude (rad), velocity (m/s) and body rates (rad/s)."""
    found = {
        name: float(np.max(np.linalg.norm(np.asarray(getattr(ours, name)) - theirs[name], axis=-1)))
        for name in ("pos", "vel", "omega")
    }
    return found | {"angle": angle(ours.quat, theirs["quat"])}


def attribution(
    name: str,
    ours: Setup,
    causes: Sequence[Cause],
    start: jd.State,
    tape: np.ndarray,
    dt: float,
    theirs: dict[str, np.ndarray],
    rounding: float = 1e-9,
) -> dict[str, Any]:
    """Differences from a flight of another simulator: ours as it comes, with all causes switched, with all but one.

    Args:
        name: of the other simulator and its vehicle.
        ours: as it comes.
        causes: in the order in which they are switched.
        start: of one drone.
        tape: (T, 4) commands, RPM.
        dt: s.
        theirs: pos, quat, vel and omega (body) after each row.
        rounding: bound, in SI units, below which a difference is one.
    """

    def of(chosen: Sequence[Cause]) -> dict[str, float]:
        setup = ours
        for cause in chosen:
            setup = cause.switch(setup)
        return differences(flown(setup, start, tape, dt), theirs)

    matched = of(causes)
    return {
        "simulator": name,
        "seconds": len(tape) * dt,
        "as it comes": of(()),
        "causes": [
            {"kind": cause.kind, "what": cause.what} | of([other for other in causes if other is not cause])
            for cause in causes
        ],
        "all switched": matched,
        "rounding": rounding,
        "explained": max(matched.values()) < rounding,
    }


def exponential_euler(derivative: Callable, state: jd.State, dt: float) -> jd.State:
    """Explicit Euler whose attitude is turned by the exponential map with the old body rates."""
    after = jax.tree.map(lambda x, k: x + dt * k, state, derivative(state))
    turn = jax.vmap(lambda q, w: rotation.normalize(rotation.multiply(q, rotation.exp(dt * w))))
    return after.replace(quat=turn(state.quat, state.omega))


def euler_angles(derivative: Callable, state: jd.State, dt: float) -> jd.State:
    """Semi-implicit Euler that takes body rates for rates of roll, pitch and yaw."""
    after = jax.tree.map(lambda x, k: x + dt * k, state, derivative(state))
    turn = jax.vmap(lambda q, w: rotation.from_rpy(rotation.to_rpy(q) + dt * w))
    return after.replace(pos=state.pos + dt * after.vel, quat=turn(state.quat, after.omega))


def constant_drag(coefficients: Sequence[float]) -> Callable:
    """Drag in N/(m/s) along the body axes, whatever the rotors do."""

    def drag(params: jd.Params, state: jd.State) -> jd.Wrench:
        air_velocity = rotation.rotate_inverse(state.quat, state.vel - params.wind)
        return jd.Wrench.of_force(-jnp.asarray(coefficients) * air_velocity)

    return drag


def curves(thrust: Sequence[float], torque: Sequence[float]) -> Callable:
    """What thrust and torque curves (by powers of RPM) add to k_F RPM^2 and k_M RPM^2."""

    def of_curves(params: jd.Params, state: jd.State) -> jd.Wrench:
        rpm = state.rpm
        more_thrust = jnp.polyval(jnp.asarray(thrust[::-1]), rpm) - params.kf * rpm**2
        more_torque = jnp.polyval(jnp.asarray(torque[::-1]), rpm) - params.km * rpm**2
        yaw = jnp.sum(params.rotor_spin * more_torque) * jnp.array([0.0, 0, 1])
        return jd.Wrench.of_thrusts(params.rotor_pos, more_thrust) + jd.Wrench.of_torque(yaw)

    return of_curves


def stale_frame(setup: Setup) -> Setup:
    """All forces along the axes of the step before, their levers along those of now: Bullet's cached frame."""
    return setup.but(effects=tuple(map(_stale, setup.effects))).plus(_stale_rotors)


def _stale(effect: Callable) -> Callable:
    """An effect without torque whose force is turned with the attitude of the step before."""

    def turned(params: jd.Params, state: jd.State) -> jd.Wrench:
        return jd.Wrench.of_force(rotation.rotate(_turn(params, state), effect(params, state).force))

    return turned


def _turn(params: jd.Params, state: jd.State) -> jax.Array:
    """From the body axes of the step before to those of now."""
    return rotation.multiply(rotation.conjugate(state.quat), params.aux[BEFORE]["quat"])


def _stale_rotors(params: jd.Params, state: jd.State) -> jd.Wrench:
    """What the turned thrusts and drag torque add to those of now."""
    thrusts = params.kf * state.rpm**2
    up = jnp.array([0.0, 0, 1])
    change = rotation.rotate(_turn(params, state), up) - up
    torque = jnp.sum(jnp.cross(params.rotor_pos, thrusts[:, None] * change[None]), axis=0)
    torque = torque + params.km * jnp.sum(params.rotor_spin * state.rpm**2) * change
    return jd.Wrench.of_force(jnp.sum(thrusts) * change) + jd.Wrench.of_torque(torque)


def damping(rate: float) -> Callable:
    """A deceleration of rate (1 + |v|) v and the same of the body rates: Bullet's default."""

    def damp(params: jd.Params, state: jd.State) -> jd.Wrench:
        vel, omega = rotation.rotate_inverse(state.quat, state.vel), state.omega
        slow = lambda x: rate * (1 + jnp.sqrt(jnp.sum(x**2))) * x  # noqa: E731
        return jd.Wrench.of_force(-params.mass * slow(vel)) + jd.Wrench.of_torque(-params.inertia * slow(omega))

    return damp


def earlier_speeds(setup: Setup) -> Setup:
    """All effects with the rotor speeds of the step before."""

    def earlier(effect: Callable) -> Callable:
        return lambda params, state: effect(params, state.replace(rpm=params.aux[BEFORE]["rpm"]))

    return setup.but(effects=tuple(map(earlier, setup.effects)))

"""Plant of jaxdrones for the comparisons with other simulators and with C, by the public API."""

from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from jaxdrones import rotation
from jaxdrones.control import for_team, pid
from jaxdrones.learning import sharding

DRAG = np.array([0.015, 0.015, 0.02], np.float32)
"""N/(m/s), along the body axes."""


def constant_drag(params: jd.Params, state: jd.State) -> jd.Wrench:
    """Drag that does not depend on the rotors, as rivals have it."""
    return jd.Wrench.of_force(-jnp.asarray(DRAG, state.vel.dtype) * rotation.rotate_inverse(state.quat, state.vel))


def even_rotors(time: float) -> jd.Params:
    """A Crazyflie whose rotors rise and fall with one time constant (s), under a gravity of 9.81 m/s^2."""
    time = jnp.asarray(time, float)
    return jd.load_params("cf2x").replace(rotor_rise_time=time, rotor_fall_time=time, gravity=jnp.asarray(9.81))


def flight(step: jd.Step, length: int) -> Callable:
    """`(params, start, rpm) -> final state` of a world that holds its rotor speeds for `length` steps."""

    def fly(params: jd.Params, start: jd.State, rpm: jax.Array) -> jd.State:
        return jax.lax.scan(lambda state, _: (step(params, state, rpm), None), start, length=length)[0]

    return fly


def starts(worlds: int, key: jax.Array, params: jd.Params) -> tuple[jd.State, jax.Array]:
    """A turning start and the rotor speeds to hold, of one drone in each world.

    High above any floor, and with rotors so nearly equal that a drone does not spin up within ten seconds.
    """
    at, turned, moving, turning, asked, uneven = jax.random.split(key, 6)
    hover = params.hover_rpm[0]

    def spread(k, scale, *shape):
        return scale * jax.random.normal(k, (worlds, 1, *shape))

    state = jd.State(
        pos=jnp.array([0.0, 0.0, 200.0]) + spread(at, 0.1, 3),
        quat=jax.vmap(jax.vmap(jd.rotation.exp))(spread(turned, 0.2, 3)),
        vel=spread(moving, 0.3, 3),
        omega=spread(turning, 0.5, 3),
        rpm=jnp.full((worlds, 1, 4), hover),
    )
    return state, hover * (1 + spread(asked, 0.02, 1) + spread(uneven, 1e-4, 4))


def attitudes(worlds: int, steps: int, key: jax.Array) -> tuple[np.ndarray, np.ndarray]:
    """Roll, pitch, yaw (rad) that drift, (steps, worlds, 1, 3), and thrust over weight, (steps, worlds, 1, 1)."""
    first, rate, thrust = (np.asarray(jax.random.normal(k, (worlds, 1, 3))) for k in jax.random.split(key, 3))
    t = np.linspace(0, 1, steps, dtype=np.float32)[:, None, None, None]
    return 0.1 * first + 0.05 * rate * t, 1 + 0.02 * thrust[..., :1] * (1 - t)


def ways(
    fly: Callable,
    devices: Sequence[jax.Device],
    params: jd.Params,
    start: jd.State,
    commands: jax.Array,
    axis: int = 0,
) -> dict[str, Callable[[], jd.State]]:
    """The flight of all worlds by `jax.vmap`, by `over_worlds`, and by `over_worlds` on all devices."""
    programs = {
        "ours, vmap": by_vmap(fly, params, start, commands, axis),
        "ours": program(fly, params, start, commands, axis=axis),
    }
    if len(devices) > 1 and len(start.pos) % len(devices) == 0:
        programs[f"ours, {len(devices)} devices"] = program(fly, params, start, commands, devices, axis)
    return programs


def program(
    fly: Callable,
    params: jd.Params,
    start: jd.State,
    commands: jax.Array,
    devices: Sequence[jax.Device] = (),
    axis: int = 0,
) -> Callable[[], jd.State]:
    """The flight of many worlds of one vehicle by `over_worlds`, from these inputs; the first call compiles.

    `axis` is that over worlds of the commands.
    """
    flown = jd.over_worlds(partial(fly, params), in_axes=(0, axis), devices=devices)
    return partial(flown, *placed(devices, start, commands, axis))


def by_vmap(
    fly: Callable, params: jd.Params, start: jd.State, commands: jax.Array, axis: int = 0
) -> Callable[[], jd.State]:
    """The flight of many worlds of one vehicle by `jax.vmap`, from these inputs; the first call compiles."""
    return partial(jax.jit(jax.vmap(fly, (None, 0, axis))), params, start, commands)


def placed(
    devices: Sequence[jax.Device], start: jd.State, commands: jax.Array, axis: int = 0
) -> tuple[jd.State, jax.Array]:
    """The inputs with an equal share of the worlds on each device."""
    if len(devices) < 2:
        return start, commands
    mesh = sharding.make_mesh(len(start.pos), devices)
    shares = (jax.NamedSharding(mesh, jax.P(*[None] * along, *sharding.WORLDS)) for along in (0, axis))
    start, commands = map(jax.device_put, (start, commands), shares)
    return start, commands


def difference(state: jd.State, other: jd.State) -> dict[str, float]:
    """Largest difference of each quantity over the worlds: m, m/s, rad/s, RPM, rad."""
    fields = ("pos", "vel", "omega", "rpm")
    pairs = {name: (np.asarray(getattr(state, name)), np.asarray(getattr(other, name))) for name in fields}
    return {name: float(np.max(np.abs(a - b))) for name, (a, b) in pairs.items()} | {
        "angle": angle(state.quat, other.quat)
    }


def angle(quat, other) -> float:
    """Largest angle between two attitudes, rad."""
    difference = np.minimum(
        np.linalg.norm(np.asarray(quat) - np.asarray(other), axis=-1),
        np.linalg.norm(np.asarray(quat) + np.asarray(other), axis=-1),
    )
    return float(4 * np.arcsin(np.minimum(np.max(difference) / 2, 1)))


def controlled(step: jd.Step, dt: float) -> Callable:
    """`(params, start, commands) -> final state` of a world; commands (steps, 1, 4) are roll, pitch, yaw, thrust.

    The controller is the attitude loop and PWM mixer of `control.pid`, the kind of cascade that crazyflow flies.
    """
    gains = pid.gains("cf2x")

    def control(params, memory, state, command):
        thrust = pid.rpm_to_pwm(jnp.sqrt(command[3] / (4 * params.kf)))
        target = rotation.axes(rotation.from_rpy(command[:3]))
        memory, torque = pid.attitude_loop(gains, memory, state, target, jnp.zeros(3), dt)
        return memory, pid.rotor_speeds(params, thrust, torque)

    def fly(params: jd.Params, start: jd.State, commands: jax.Array) -> jd.State:
        def advance(carry, command):
            memory, state = carry
            memory, rpm = jax.vmap(control)(params, memory, state, command)
            return (memory, step(params, state, rpm)), None

        return jax.lax.scan(advance, (for_team(pid.init(), 1), start), commands)[0][1]

    return fly

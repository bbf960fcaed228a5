"""crazyflow in its fastest form: a compiled step of all worlds, many steps a program, commands and vehicle as data.

The vehicle is ours, converted to the parameters of crazyflow; its floor, motor limits and disturbances stay in its
pipeline, as for its users.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from crazyflow.control import Control
from crazyflow.dynamics import Dynamics
from crazyflow.sim import Sim
from crazyflow.sim import functional as F
from crazyflow.sim.integration import Integrator
from crazyflow.sim.sharding import placement, world_mesh

import jaxdrones as jd
from benchmarks.rivals.crazyflow import AIRFRAMES, make_sim, told
from jaxdrones.accelerate.compiler import kernel_options


def plant(
    integrator: str,
    params: jd.Params,
    start: jd.State,
    rpm: jax.Array,
    freq: int,
    steps: int,
    devices: Sequence[jax.Device],
) -> dict[str, Callable[[], jd.State]]:
    """`steps` steps with the rotor speeds held."""
    sim = make_sim(AIRFRAMES[0], freq, Integrator(integrator))
    data = _with(sim, start).replace(params=told(sim.data.params, jax.tree.map(lambda x: x[0], params)))
    data = data.replace(controls=data.controls.replace(rotor_vel=rpm))
    advance = sim.build_step_fn()
    return _ways(lambda data: advance(data, n_steps=steps), devices, data)


def attitude(
    start: jd.State, rpy: np.ndarray, thrust_to_weight: np.ndarray, freq: int, devices: Sequence[jax.Device]
) -> dict[str, Callable[[], jd.State]]:
    """Its default airframe under its attitude controller, with a new command at every step."""
    sim = Sim(dynamics=Dynamics.first_principles, control=Control.attitude, freq=freq, attitude_freq=freq)
    weight = float(sim.data.params.mass[0]) * 9.81
    commands = jnp.asarray(np.concatenate([rpy, thrust_to_weight * weight], axis=-1))
    advance = sim.build_step_fn()

    def fly(data, commands):
        return jax.lax.scan(lambda d, c: (advance(F.attitude_control(d, c), n_steps=1), None), data, commands)[0]

    return _ways(fly, devices, _with(sim, start), commands)


def _with(sim: Sim, start: jd.State):
    """The simulation's data, for as many worlds as there are starts; without the collision models of those worlds."""
    sim.n_worlds = len(start.pos)
    data = sim.build_data()
    states = data.states.replace(
        pos=start.pos, quat=start.quat, vel=start.vel, ang_vel=start.omega, rotor_vel=start.rpm
    )
    return data.replace(states=states)


def _ways(fly: Callable, devices: Sequence[jax.Device], data, *commands) -> dict[str, Callable[[], jd.State]]:
    """On one device, and on all by its own sharding; compiled as JAX does it by default, and with our options."""

    def programs_of(name, *inputs):
        for options, said in ((None, ""), (kernel_options(), ", our options")):
            compiled = jax.jit(fly).lower(*inputs).compile(options)
            programs[name + said] = lambda compiled=compiled: _state(compiled(*inputs))

    programs = {}
    programs_of("crazyflow", data, *commands)
    if len(devices) > 1 and data.core.n_worlds % len(devices) == 0:
        mesh = world_mesh(devices)
        spread = jax.NamedSharding(mesh, jax.P(None, *mesh.axis_names))
        placed = jax.device_put(data, placement(data, mesh)), *(jax.device_put(c, spread) for c in commands)
        programs_of(f"crazyflow, {len(devices)} devices", *placed)
    return programs


def _state(data) -> jd.State:
    after = data.states
    return jd.State(after.pos, after.quat, after.vel, after.ang_vel, after.rotor_vel)

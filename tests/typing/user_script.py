"""What a user writes: a team with an effect of one's own, many worlds, a gradient, an environment, a learner."""

from functools import partial

import jax
import jax.numpy as jnp

import jaxdrones as jd
from jaxdrones.control import Setpoint, for_team, pid
from jaxdrones.learning import bptt, evaluate


def tether(params: jd.Params, state: jd.State) -> jd.Wrench:
    return jd.Wrench.of_force(jd.rotation.rotate_inverse(state.quat, -0.05 * state.pos))


params: jd.Params = jd.repeat(jd.load_params("cf2x"), 2)
start = jd.State.at_rest([[0.0, 0.0, 1.0], [0.5, 0.0, 1.5]], yaw=[0.0, 0.5])
step = jd.make_step(effects=(jd.drag, tether), pairs=(jd.downwash,), rotors=jd.lagging_rotors, dt=1 / 240, substeps=2)
pilot = partial(pid.control, pid.gains("cf2x"), dt=1 / 120)
goal = Setpoint.at([0.0, 0.0, 1.0])


def control(params: jd.Params, memory: pid.Memory, state: jd.State, k: jax.Array) -> tuple[pid.Memory, jax.Array]:
    return jax.vmap(pilot, (0, 0, 0, None))(params, memory, state, goal)


def fly(start: jd.State) -> jd.State:
    return jd.rollout(step, control, params, start, memory=for_team(pid.init(), 2), length=12)[0]


def miss(start: jd.State) -> jax.Array:
    return jnp.sum((fly(start).pos - goal.pos) ** 2)


many = jax.tree.map(lambda x: jnp.stack([x, x]), start)
last: jd.State = jd.over_worlds(fly)(many)
slope: jd.State = jax.grad(miss)(start)


def slow_rotors(params: jd.Params, state: jd.State, command: jax.Array) -> tuple[jax.Array, jax.Array]:
    return state.rpm, (command - state.rpm) / 0.1


custom = jd.make("hover", rotors=slow_rotors, integrator=jd.rk4)
env = jd.make("hover", action="rpm", drones=1, duration=0.1)
obs, world = env.reset(jax.random.key(0))
obs, world, reward, terminated, truncated, info = env.step(jax.random.key(1), world, jnp.zeros((1, env.action_size)))
result = bptt.train(jax.random.key(2), env, bptt.Config(updates=1, worlds=2, horizon=4))
report = evaluate(env, result.policy, jax.random.key(3), episodes=4)
success: float | None = report.success

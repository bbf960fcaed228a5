"""A mistake on every line that says so, which a type checker tells; never run."""

import jax
import jax.numpy as jnp

import jaxdrones as jd
from jaxdrones.learning import bptt, evaluate, ppo

params, start, env = jd.load_params("cf2x"), jd.State.at_rest([[0, 0, 1]]), jd.make("hover")
key = jax.random.key(0)


def push(params: jd.Params, state: jd.State) -> jax.Array:
    return state.pos


jd.make_step(effects=(push,))  # mistake: an effect returns a wrench
jd.make_step(effects=(jd.downwash,))  # mistake: a pair effect is not an effect
jd.make_step(pairs=(jd.drag,))  # mistake: nor the other way round
jd.make_step(dt="fast")  # mistake: a number
jd.make_step(substep=2)  # mistake: substeps
jd.repeat(params)  # mistake: how many
jd.repeat(params, 2).masses  # mistake: mass
start.position  # mistake: pos
jd.rollout(jd.make_step(), lambda params, memory, state, k: state.rpm, params, start, None, 10)  # mistake: memory, rpm
jd.make("hover", rotor="lagging")  # an option of the task; told when it runs
jd.make("hover", backend=2)  # mistake: a name
env.reset(0)  # mistake: a key
env.step(key, start, jnp.zeros((1, 4)))  # mistake: a world, not a state
bptt.train(key, env, ppo.Config())  # mistake: the other learner's
bptt.Config(world=8)  # mistake: worlds
evaluate(env, bptt.train(key, env, bptt.Config()), key)  # mistake: a result is not a policy
jd.over_worlds(jd.drag, chunks=4)  # mistake: no such argument
jd.make_steps()  # mistake: make_step

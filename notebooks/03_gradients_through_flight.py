# %% [markdown]
# # Gradients through flight
# The simulator is differentiable from end to end: here gradient descent tunes the gains of a controller, through a
# hundred control steps of flight.

# %%
import functools

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import optax

import jaxdrones as jd
from jaxdrones.control import Setpoint, rates

# %%
HZ = 100
params = jd.repeat(jd.load_params("cf2x"), 1)
step = jd.make_step(effects=(jd.drag,), rotors=jd.lagging_rotors, dt=1 / 500, substeps=5)
start = jd.State.at_rest(jnp.array([[0.0, 0.0, 1.0]])).replace(rpm=jnp.full((1, 4), params.hover_rpm[0]))
target = Setpoint.at(jnp.array([[1.0, 0.5, 1.3]]))


def flight(log_gains):
    """Fly to the target with the exponentials of the given numbers as gains: (length, 1, 3)."""
    pilot = functools.partial(rates.control, jax.tree.map(jnp.exp, log_gains), dt=1 / HZ)

    def control(params, memory, state, k):
        return jax.vmap(pilot)(params, memory, state, target)

    return jd.rollout(step, control, params, start, memory=None, length=150)[1].pos


def cost(log_gains):
    return jnp.mean(jnp.sum((flight(log_gains) - target.pos) ** 2, axis=-1))


# %% [markdown]
# One call gives the cost and its derivative in all twelve gains.

# %%
gains = jax.tree.map(jnp.log, rates.gains())
optimizer = optax.adam(0.05)


@jax.jit
def update(gains, memory):
    value, slope = jax.value_and_grad(cost)(gains)
    change, memory = optimizer.update(slope, memory)
    return optax.apply_updates(gains, change), memory, value


memory, costs, tuned = optimizer.init(gains), [], gains
for _ in range(60):
    tuned, memory, value = update(tuned, memory)
    costs.append(float(value))

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4))
left.plot(costs)
left.set(xlabel="updates", ylabel="mean squared error (m²)")
for name, these in ("before", gains), ("after", tuned):
    right.plot(jnp.arange(150) / HZ, flight(these)[:, 0, 0], label=name)
right.axhline(1.0, color="grey", linewidth=0.5)
right.set(xlabel="t (s)", ylabel="x (m)")
right.legend()
assert costs[-1] < 0.8 * costs[0]

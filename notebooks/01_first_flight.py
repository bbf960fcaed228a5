# %% [markdown]
# # First flight
# Four Crazyflies on the circle of gym-pybullet-drones (2021), flown by its PID. These notebooks are plain Python in
# cells: open them in Jupyter with jupytext, or in an editor that knows `# %%`.

# %%
import functools

import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxdrones as jd
from jaxdrones.control import Setpoint, for_team, pid
from jaxdrones.tasks import curves

# %% [markdown]
# What changes is `State`, what does not is `Params`, what is chosen is an argument of `make_step`.

# %%
HZ = 120
params = jd.repeat(jd.load_params("cf2x"), 4)
step = jd.make_step(effects=(jd.drag, jd.ground_effect), pairs=(jd.downwash,), dt=1 / 240, substeps=2)
circle = curves.circle(radius=0.3, period=10.0)
start = jd.State.at_rest(circle.positions(4))

# %% [markdown]
# A controller is about one drone; `jax.vmap` makes it one of a team.

# %%
pilot = functools.partial(pid.control, pid.gains("cf2x"), dt=1 / HZ)


def control(params, memory, state, k):
    return jax.vmap(pilot)(params, memory, state, Setpoint.at(circle.positions(4, k / HZ)))


@jax.jit
def fly(params, state):
    return jd.rollout(step, control, params, state, memory=for_team(pid.init(), 4), length=12 * HZ)


final, trajectory = fly(params, start)
trajectory.pos.shape

# %%
t = np.arange(12 * HZ) / HZ
target = jax.vmap(lambda t: circle.positions(4, t))(t)
error = np.linalg.norm(trajectory.pos - target, axis=-1)

figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4))
for i in range(4):
    left.plot(*trajectory.pos[:, i, :2].T, label=f"drone {i}")
    right.plot(t, 100 * error[:, i])
left.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
right.set(xlabel="t (s)", ylabel="distance from the target (cm)")
left.legend()
assert error[4 * HZ :].mean() < 0.12  # the PID lags some 10 cm behind, as in gym-pybullet-drones

"""The Bullet backend against recorded Bullet flights of gym-pybullet-drones."""

from functools import lru_cache

import golden_data
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones
from jaxdrones import State, rotation
from jaxdrones.engine import bullet

pytestmark = pytest.mark.needs("pybullet")

DAMPING = 0.04  # gym-pybullet-drones leaves Bullet's own on
PYB_EFFECTS = {
    "gnd": jaxdrones.ground_effect_2021,
    "drag": jaxdrones.drag_world_axes,
    "dw": jaxdrones.downwash_2021,
}

make_step = lru_cache(bullet.make_step)


def step_of(physics: str, dt: float = 1 / 240):
    """The step of one of gym-pybullet-drones' physics options, such as `pyb_gnd_drag_dw`."""
    chosen = [PYB_EFFECTS[name] for name in physics.split("_")[1:]]
    pairs = tuple(f for f in chosen if f is jaxdrones.downwash_2021)
    return make_step(effects=tuple(f for f in chosen if f not in pairs), pairs=pairs, dt=dt, damping=DAMPING)


def of_bullet(physics: str) -> bool:
    return physics.startswith("pyb")


def falls(motion: str) -> bool:
    return "fall" in motion


def collides(velocities: list) -> bool:
    return np.any(velocities)


def above_the_ground(positions: list) -> bool:
    return min(z for _, _, z in positions) > 1


def body_rates(quat, ang_vel):
    return jax.vmap(jax.vmap(rotation.rotate_inverse))(jnp.asarray(quat), jnp.asarray(ang_vel))


@pytest.mark.parametrize("name", golden_data.names("pos_in", physics=of_bullet, variant="main"))
def test_single_steps_agree(name):
    case = golden_data.load(name)
    a, physics = case.arrays, case.about["physics"]
    params = jaxdrones.repeat(golden_data.unlimited(golden_data.recorded_params(case)), 1)
    previous = a.get("rpm_previous")

    def drag_of_the_step_before(params, state):  # gym-pybullet-drones' drag sees the rotor speeds of the step before
        return jaxdrones.drag_world_axes(params, state.replace(rpm=params.max_speed * jnp.ones(4)))

    effects = [PYB_EFFECTS[word] for word in physics.split("_")[1:] if word != "drag"]
    if previous is not None:
        effects.append(drag_of_the_step_before)
    with bullet.make_step(effects=effects, damping=DAMPING) as step:
        for k, rpm in enumerate(a["rpm"]):
            state = State(
                *(jnp.array([a[f"{key}_in"][k]]) for key in ("pos", "quat", "vel", "body_rates")), rpm=jnp.zeros((1, 4))
            )
            # the drag depends on the sum of the earlier speeds only; `max_speed`, which nothing else reads, carries it
            team = params if previous is None else params.replace(max_speed=jnp.array([previous[k].mean()]))
            after = step(team, state, rpm[None])
            ang_vel = rotation.rotate(jnp.asarray(after.quat[0]), jnp.asarray(after.omega[0]))
            quat = after.quat[0] * np.sign(after.quat[0] @ a["quat_out"][k])
            for actual, key in (after.pos[0], "pos"), (after.vel[0], "vel"), (quat, "quat"), (ang_vel, "ang_vel"):
                np.testing.assert_allclose(actual, a[f"{key}_out"][k], rtol=0, atol=1e-9, err_msg=f"{key} of row {k}")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    golden_data.names(
        kind="open_loop_rollout", physics=of_bullet, variant="main", physics_steps_per_record=1, contact_free=True
    ),
)
def test_rows_of_rollouts_agree_but_for_the_stale_link_frame(name):
    """gym-pybullet-drones turns a force with the attitude of the step before, which is |omega| dt away from ours."""
    case = golden_data.load(name)
    a, dt = case.arrays, 1 / case.about["physics_freq_hz"]
    step = step_of(case.about["physics"], dt)
    params, commands = golden_data.flown(case, golden_data.recorded_params(case))
    params = jaxdrones.repeat(params, a["pos"].shape[1])
    rates, rpm = body_rates(a["quat"], a["ang_vel"]), a["rpm_applied"]
    for k in range(1, len(rpm), 4):
        state = State(*(jnp.asarray(x[k]) for x in (a["pos"], a["quat"], a["vel"], rates)), rpm=jnp.asarray(rpm[k - 1]))
        after = step(params, state, commands[k])
        thrust = np.sum(np.asarray(params.kf)[:, None] * rpm[k] ** 2, axis=-1)
        mass, spin = np.asarray(params.mass), np.linalg.norm(a["ang_vel"][k], axis=-1)
        bound = thrust / mass * spin * dt**2 + 1e-9
        if (
            "drag" in case.about["physics"]
        ):  # it is turned by the stale frame too, and uses the speeds of the step before
            bound += drag_of(params, a["vel"][k], rpm[k - 1].sum(-1)) * spin * dt**2
            bound += drag_of(params, a["vel"][k], np.abs(rpm[k].sum(-1) - rpm[k - 1].sum(-1))) * dt
        error = np.linalg.norm(after.vel - a["vel"][k + 1], axis=-1)
        assert np.all(error <= bound), f"row {k}: {error} > {bound}"


def drag_of(params, vel, summed_rpm):
    """Largest acceleration by drag at a velocity and a sum of rotor speeds, m/s^2."""
    speed = np.linalg.norm(vel, axis=-1)
    return np.asarray(params.drag_coeff).max(-1) * summed_rpm * 2 * np.pi / 60 * speed / np.asarray(params.mass)


def energy(params, state) -> float:
    """Of the whole team, J."""
    kinetic = params.mass * jnp.sum(state.vel**2, -1) / 2 + jnp.sum(params.inertia * state.omega**2, -1) / 2
    return float(jnp.sum(kinetic + params.mass * params.gravity * state.pos[:, 2]))


@pytest.mark.parametrize(
    "name", golden_data.names(physics="pyb", variant="main", contact_free=False, motion=falls, num_drones=1)
)
def test_a_fall_ends_at_the_recorded_height_and_gains_no_energy(name):
    case = golden_data.load(name)
    a, step = case.arrays, step_of("pyb")
    n = a["pos"].shape[1]
    params = jaxdrones.repeat(golden_data.recorded_params(case), n)
    state = State(*(jnp.asarray(x[0]) for x in (a["pos"], a["quat"], a["vel"])), jnp.zeros((n, 3)), jnp.zeros((n, 4)))
    top = energy(params, state)
    for rpm in a["rpm_applied"]:
        state = step(params, state, rpm)
        assert energy(params, state) <= top + 1e-9
    for _ in range(240):
        state = step(params, state, a["rpm_applied"][-1])
    upright = np.abs(np.asarray(jax.vmap(rotation.z_axis)(jnp.asarray(state.quat)))[:, 2]) > 0.99
    rest = case.constants["collision_h"] / 2
    assert upright.all() and np.all(np.abs(state.pos[:, 2] - rest) < 2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    golden_data.names(
        kind="open_loop_rollout",
        physics=of_bullet,
        contact_free=False,
        initial_vel=collides,
        num_drones=2,
        initial_xyz=above_the_ground,
    ),
)
def test_drones_that_meet_rebound_by_no_more_than_a_third_of_their_speed(name):
    """The law of the recorded flights too, wherever on their rims drones meet; ours by no more than a fifth.

    Off-center, drones turn about the point of contact. Later the thrust of the rotors, which are held at hover, drives
    them apart faster than they met, so that only the time of the first contact counts; see `rebound`.
    """
    case = golden_data.load(name)
    a, dt = case.arrays, 1 / case.about["physics_freq_hz"]
    step = step_of(case.about["physics"], dt)
    params, rpm = golden_data.flown(case, golden_data.recorded_params(case))
    params = jaxdrones.repeat(params.replace(inertia=jnp.array(case.constants["J_bullet"])), 2)
    start = [jnp.asarray(a[key][0]) for key in ("pos", "quat", "vel")]
    states, touch = meet(step, params, State(*start, body_rates(a["quat"], a["ang_vel"])[0], jnp.asarray(rpm[0])), rpm)
    pos, vel = states.pos, states.vel

    recorded, first = int(np.argmax(a["contact"])), int(np.argmax(touch))
    free = min(recorded, first or recorded)
    np.testing.assert_allclose(pos[:free], a["pos"][:free], rtol=0, atol=1e-4)
    above = abs(a["pos"][recorded - 1, 1, 2] - a["pos"][recorded - 1, 0, 2])
    if above < case.constants["collision_h"] / 2:  # otherwise the round rims of ours meet later, or miss each other
        assert touch.any() and abs(first - recorded) <= 2
    assert rebound(a["pos"], a["vel"], a["contact"]) <= 1 / 3
    if touch.any():
        assert rebound(pos, vel, touch) <= 0.2
    axes = jax.vmap(jax.vmap(rotation.z_axis))(jnp.asarray(states.quat))
    centers = pos + case.constants["collision_z_offset"] * np.asarray(axes)
    path_of_a_step = np.linalg.norm(vel[:, 0] - vel[:, 1], axis=-1).max() * dt
    nearest = np.linalg.norm(centers[:, 0] - centers[:, 1], axis=-1).min()
    assert nearest > case.constants["collision_h"] - path_of_a_step


@pytest.mark.slow
@pytest.mark.parametrize("aside", [0.0, 0.03, 0.06, 0.1])
def test_drones_that_meet_off_centre_part_slowly_whenever_in_a_step_they_touch(aside):
    params, step = jaxdrones.repeat(jaxdrones.load_params("cf2x"), 2), step_of("pyb")
    hover = np.broadcast_to(params.hover_rpm[:, None], (40, 2, 4))
    for gap in np.linspace(0.16, 0.168, 5):  # 2 m/s is 8 mm in a step
        start = State.at_rest([[0, 0, 2], [gap, aside, 2]]).replace(vel=jnp.array([[1.0, 0, 0], [-1, 0, 0]]))
        states, touch = meet(step, params, start.replace(rpm=hover[0]), hover)
        assert touch.any() and rebound(states.pos, states.vel, touch) <= 0.2


def meet(step, params, state, rpm):
    """States of two drones, with a leading axis over time, and whether they press on each other before each."""
    states, touch = [state], [False]
    for command in rpm:
        touch.append(any(contact.other.startswith("drone") for contact in step.contacts(params, states[-1])))
        states.append(step(params, states[-1], command))
    return jax.tree.map(lambda *x: np.array(x), *states), np.array(touch)


def rebound(pos, vel, touch) -> float:
    """How fast two drones part while they touch for the first time, over how fast they came.

    Along the line of their centers before they touch. Bullet's restitution is zero, but it resolves a fifth of a
    penetration in every step, and drones penetrate by up to the way that they come in a step.
    """
    first = int(np.argmax(touch))
    line = pos[first - 1, 1] - pos[first - 1, 0]
    relative = vel[:, 0] - vel[:, 1]
    end = first + (int(np.argmin(touch[first:])) or len(touch))
    apart = -(relative[first:end] @ line).min() / np.linalg.norm(line)
    return float(apart / np.linalg.norm(relative[first - 1]))


def test_nothing_tunnels_through_the_ground_at_five_metres_per_second():
    step, params = step_of("pyb"), jaxdrones.repeat(jaxdrones.load_params("cf2x"), 1)
    for height in np.linspace(0.05, 0.07, 7):
        state = State.at_rest([[0, 0, height]]).replace(vel=jnp.array([[0, 0, -5.0]]))
        lowest = height
        for _ in range(240):
            state = step(params, state, np.zeros((1, 4)))
            lowest = min(lowest, float(state.pos[0, 2]))
        assert state.pos[0, 2] > 0.01 and lowest > -0.0125

"""Users' sensors measure what mechanics and geometry say, in steps and environments of both backends."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from extensions.imu import Imu, specific_force
from extensions.range_finder import RangeFinder
from helpers import assert_close, assert_finite, flying, jit_unoptimized

import jaxdrones as jd
from jaxdrones.engine import bullet
from jaxdrones.envs import make
from jaxdrones.sensing import Box, Scene, Sphere
from jaxdrones.sensing.sensor import init_sensors, measure_sensors

KEY = jax.random.key(0)
TEAM = jd.repeat(jd.load_params("cf2x"), 2)
GRAVITY = float(TEAM.gravity[0])
DT = 1 / 2000  # s
RK4 = jd.make_step(effects=(jd.drag,), integrator=jd.rk4, dt=DT)
COMMAND = TEAM.hover_rpm[:, None] * jnp.array([[1.1, 1.0, 0.95, 1.05]])
BACKENDS = ["explicit", pytest.param("bullet", marks=pytest.mark.needs("pybullet"))]


@partial(jax.jit, static_argnums=0)
def measured(sensor, params, state, rate=None, scene=None):
    """The first reading."""
    rate = jax.tree.map(jnp.zeros_like, state) if rate is None else rate
    scene = Scene() if scene is None else scene
    memories = init_sensors((sensor,), KEY, params, state)
    return measure_sensors((sensor,), KEY, params, state, rate, scene, memories)[1][sensor.name]


# An inertial measurement unit


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
def test_at_rest_on_the_ground_an_imu_feels_the_ground_push_up(backend):
    still, state = jnp.zeros((2, 4)), jd.State.at_rest([[0, 0, 0.0125], [1, 0, 0.0125]], yaw=[0.0, 2.0])
    options = dict(effects=(jd.ground_contact,)) if backend == "explicit" else {}
    step = (jd if backend == "explicit" else bullet).make_step(**options)
    for _ in range(240):
        state = step(TEAM, state, still)
    reading = measured(Imu(offset=(0.01, 0.0, 0.02)).sensor, TEAM, state, step.rate(TEAM, state, still))
    np.testing.assert_allclose(reading["acc"], np.tile([0, 0, GRAVITY], (2, 1)), atol=0.02)
    np.testing.assert_allclose(reading["gyro"], 0, atol=0.02)


def test_in_free_fall_an_imu_feels_nothing_and_in_hover_the_thrust():
    state = jd.State.at_rest([[0, 0, 1], [1, 0, 1]])
    step = jd.make_step()
    for share, expected in (0.0, 0.0), (1.0, GRAVITY):
        rate = step.rate(TEAM, state, share * TEAM.hover_rpm[:, None] * jnp.ones((1, 4)))
        acc = measured(Imu().sensor, TEAM, state, rate)["acc"]
        np.testing.assert_allclose(acc, np.tile([0, 0, expected], (2, 1)), atol=1e-12)


def flight(steps):
    """States of a tumbling team, one row per step of `DT`, and their time derivatives."""
    start = flying(TEAM)

    @jit_unoptimized
    def fly(start):
        trajectory = jd.rollout(RK4, lambda p, m, s, k: (m, COMMAND), TEAM, start, None, steps)[1]
        return trajectory, jax.vmap(lambda state: RK4.rate(TEAM, state, COMMAND))(trajectory)

    return fly(start)


def felt(trajectory, rate, offset):
    """Specific force (T, n, 3) at a point of the body, m/s^2, body."""
    at = jax.vmap(jax.vmap(specific_force, (0, 0, 0, None)), (None, 0, 0, None))
    return at(TEAM, trajectory, rate, jnp.array(offset, float))


def to_world(trajectory, v):
    return jax.vmap(jax.vmap(jd.rotation.rotate))(trajectory.quat, v)


@pytest.mark.slow
def test_what_an_imu_feels_integrates_to_the_velocity_that_was_flown():
    """Strapdown navigation: the velocity changes by the integral of R f + g."""
    trajectory, rate = flight(401)
    acc = to_world(trajectory, felt(trajectory, rate, (0, 0, 0))) - jnp.array([[[0, 0, GRAVITY]]])
    simpson = DT / 3 * np.array([1, *[4, 2] * 199, 4, 1])
    change = np.tensordot(simpson, acc, axes=1)
    np.testing.assert_allclose(change, trajectory.vel[-1] - trajectory.vel[0], atol=1e-8)
    assert np.abs(change).max() > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (0.1, -0.05, 0.2)])
def test_away_from_the_center_an_imu_feels_the_second_derivative_of_its_own_place(offset):
    trajectory, rate = flight(41)
    place = trajectory.pos + to_world(trajectory, jnp.broadcast_to(jnp.array(offset), trajectory.pos.shape))
    acc = (place[2:] - 2 * place[1:-1] + place[:-2]) / DT**2 + jnp.array([[[0, 0, GRAVITY]]])
    inside = jax.tree.map(lambda x: x[1:-1], (trajectory, rate))
    expected = jax.vmap(jax.vmap(jd.rotation.rotate_inverse))(inside[0].quat, acc)
    np.testing.assert_allclose(felt(*inside, offset), expected, atol=2e-3)  # of 10 to 30 m/s^2
    if any(offset):
        assert np.abs(felt(*inside, offset) - felt(*inside, (0, 0, 0))).max() > 1


@pytest.mark.slow
def test_the_variance_of_a_bias_grows_linearly_and_that_of_white_noise_does_not():
    n, dt = 4000, 0.01
    params, state = jd.repeat(jd.load_params("cf2x"), n), jd.State.at_rest(jnp.zeros((n, 3)))
    rate = jax.tree.map(jnp.zeros_like, state)
    sensors = (Imu(dt=dt, acc_noise=0.5, gyro_noise=0.02, acc_walk=0.3, gyro_walk=0.01).sensor,)

    @jit_unoptimized
    def run(key):
        def measure(memories, key):
            memories, readings = measure_sensors(sensors, key, params, state, rate, Scene(), memories)
            return memories, (memories["imu"], readings["imu"])

        return jax.lax.scan(measure, init_sensors(sensors, key, params, state), jax.random.split(key, 40))[1]

    bias, reading = run(KEY)
    steps, spread = np.arange(1, 41), 4 * np.sqrt(2 / (3 * n))  # 4 standard deviations of a variance
    true = {"acc": np.array([0, 0, GRAVITY]), "gyro": np.zeros(3)}
    for name, walk, noise in ("acc", 0.3, 0.5), ("gyro", 0.01, 0.02):
        np.testing.assert_allclose(np.var(bias[name], axis=(1, 2)), walk**2 * dt * steps, rtol=spread)
        white = np.asarray(reading[name] - bias[name]) - true[name]
        np.testing.assert_allclose(np.var(white, axis=(1, 2)), noise**2, rtol=spread)
        assert abs(np.mean(white)) < 4 * noise / np.sqrt(white.size)
        assert abs(np.corrcoef(white[:-1].ravel(), white[1:].ravel())[0, 1]) < 4 / np.sqrt(white.size)


# A range finder

FINDER = RangeFinder().sensor
TABLE = Scene.of(Box(pos=(1, 0, 0.5), size=(0.6, 0.6, 0.2)))


def test_a_range_finder_reads_the_height_over_what_is_below():
    state = jd.State.at_rest([[0, 0, 1.5], [1, 0, 1.5]])
    np.testing.assert_allclose(measured(FINDER, TEAM, state), [1.5, 1.5])
    np.testing.assert_allclose(measured(FINDER, TEAM, state, scene=TABLE), [1.5, 0.9])
    tilt = jnp.tile(jd.rotation.from_rpy(jnp.array([0.3, 0, 0.5]))[None], (2, 1))
    tilted = measured(FINDER, TEAM, state.replace(quat=tilt), scene=Scene())
    np.testing.assert_allclose(tilted, 1.5 / np.cos(0.3), rtol=1e-12)
    upside_down = state.replace(quat=jnp.tile(jnp.array([[1.0, 0, 0, 0]]), (2, 1)))
    np.testing.assert_allclose(measured(FINDER, TEAM, upside_down, scene=TABLE), [4, 4])


def test_the_noise_of_a_range_finder_is_a_share_of_the_range():
    n = 4000
    params = jd.repeat(jd.load_params("cf2x"), n)
    state = jd.State.at_rest(jnp.broadcast_to(jnp.array([0, 0, 2.0]), (n, 3)))
    reading = measured(RangeFinder(noise=0.05).sensor, params, state)
    np.testing.assert_allclose(np.std(reading), 0.1, rtol=4 / np.sqrt(2 * n))
    np.testing.assert_allclose(np.mean(reading), 2, atol=4 * 0.1 / np.sqrt(n))


def range_in(key, pos):
    """The range of one drone over a table of a height that is drawn."""
    height = jax.random.uniform(key, (), minval=0.1, maxval=1.0)
    scene = Scene.of(Box(pos=(0, 0, height / 2), size=jnp.stack([2.0, 2.0, height])))
    one = jax.tree.map(lambda x: x[:1], TEAM)
    state = jd.State.at_rest([[0.0, 0.0, 0.0]]).replace(pos=pos[None])
    return measured(FINDER, one, state, scene=scene)[0], height


@pytest.mark.slow
def test_ranges_in_drawn_scenes_are_mapped_and_fly_in_one_kernel():
    keys = jax.random.split(KEY, 20)
    pos = jnp.stack([jnp.linspace(-1.5, 1.5, 20), jnp.zeros(20), jnp.full(20, 2.0)], axis=-1)
    found, height = jit_unoptimized(jax.vmap(range_in))(keys, pos)
    np.testing.assert_allclose(found, np.where(np.abs(pos[:, 0]) < 1, 2 - height, 2), rtol=1e-12)
    assert_close(jd.over_worlds(range_in)(keys, pos), (found, height), 1e-12)


@pytest.mark.slow
def test_a_range_is_differentiable_in_the_flight_and_in_the_scene():
    state = jd.State.at_rest([[0, 0, 1.5], [1, 0, 1.5]])

    def total(state, scene):
        return jnp.sum(measured(FINDER, TEAM, state, scene=scene))

    of_state, of_scene = jit_unoptimized(jax.grad(total, argnums=(0, 1)))(state, TABLE)
    np.testing.assert_allclose(of_state.pos, [[0, 0, 1], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(of_scene.boxes.pos, [[0, 0, -1]], atol=1e-12)
    np.testing.assert_allclose(of_scene.boxes.size, [[0, 0, -0.5]], atol=1e-12)
    assert_finite((of_state, of_scene))


# Sensors and scenes in an environment


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
def test_environments_carry_users_sensors(backend):
    sensors = (Imu(acc_walk=0.1).sensor, FINDER)
    with make(
        "hover", backend=backend, drones=2, sensors=sensors, observation=("position_error", "imu", "range")
    ) as env:
        assert env.observation_size == 3 + 6 + 1
        np.testing.assert_array_equal(env.observation_bound[3:], [200] * 6 + [4])
        _, start = env.reset(KEY)
        _, later, *_ = env.step(KEY, start, jnp.zeros((2, 4)))
        for world in start, later:
            height, up = world.drones.pos[:, 2], jax.vmap(jd.rotation.z_axis)(world.drones.quat)[:, 2]
            np.testing.assert_allclose(world.readings["range"], np.minimum(height / up, 4), rtol=1e-5)
            assert np.all(world.sensors["imu"]["acc"] != 0)  # the bias of the memory
            assert_finite(world.readings)


def touch(params, state, scene):
    """A stiff damped spring along the gradient of the distance, at the center of mass."""
    away, normal = jax.value_and_grad(Scene.distance, argnums=1)(scene, state.pos)
    depth, speed = params.collision_height / 2 - away, jd.vector.dot(normal, state.vel)
    force = jnp.where(depth > 0, jnp.maximum(params.mass * (4e3 * depth - 80 * speed), 0), 0) * normal
    return jd.Wrench.of_force(jd.rotation.rotate_inverse(state.quat, force))


@pytest.mark.slow
def test_an_effect_of_a_drawn_scene_and_a_sensor_agree_where_a_drone_comes_to_rest():
    """Drones fall on tables that are drawn for every episode; the range finder then reads half their height."""

    def tables(key):
        height = jax.random.uniform(key, (), minval=0.2, maxval=0.8)
        return Scene.of(
            Box(pos=(0, 0, height / 2), size=jnp.stack([9.0, 9.0, height])), Sphere(pos=(0, 0, 9), radius=1)
        )

    env = make("hover", effects=(touch,), scene=tables, sensors=(FINDER,), action="rpm", tilt=0.0, speed=0.0, omega=0.0)
    _, world = jax.vmap(env.reset)(jax.random.split(KEY, 3))
    top = world.scene.boxes.size[:, 0, 2]
    assert len(set(top.tolist())) == 3

    @jit_unoptimized
    @jax.vmap
    def fall(world):
        still = world.replace(params=world.params.replace(kf=0.0 * world.params.kf, km=0.0 * world.params.km))
        return jax.lax.scan(lambda w, _: (env.step(KEY, w, jnp.zeros((1, 4)))[1], None), still, length=200)[0]

    end = fall(world)
    half = float(TEAM.collision_height[0]) / 2
    np.testing.assert_allclose(end.drones.pos[:, 0, 2], top + half - GRAVITY / 4e3, atol=1e-4)
    np.testing.assert_allclose(end.readings["range"][:, 0], half - GRAVITY / 4e3, atol=1e-4)

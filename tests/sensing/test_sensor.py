"""The contract of sensors: one drone in the sensor, a team around it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import Keys, jit_unoptimized

import jaxdrones as jd
from jaxdrones.sensing import (
    DepthNoise,
    MotionCaptureSystem,
    Scene,
    barometer,
    forest,
    imu,
    magnetometer,
    motion_capture,
    optical_flow,
    range_finder,
    room,
    state_estimate,
)
from jaxdrones.sensing.sensor import check_sensors, init_sensors, measure_sensors

BEFORE, KEY = jax.random.key(1), jax.random.key(0)
PARAMS = jd.stack([jd.load_params("cf2x"), jd.load_params("racer")])
STATE = jd.State.at_rest([[0.0, 0.0, 1.0], [1.0, 2.0, 3.0]])


def altimeter() -> jd.Sensor:
    """Height with noise, m."""

    def measure(key, params, state, rate, scene, memory):
        return memory, state.pos[2] + 0.1 * jax.random.normal(key)

    return jd.Sensor("altimeter", measure)


def at_100_hz() -> jd.Sensor:
    return dataclasses.replace(altimeter(), rate=100.0)


def odometer() -> jd.Sensor:
    """The distance covered at the drone's top speed, m, and the number of measurements: a memory that is a pytree."""

    def init(key, params):
        return {"distance": jnp.zeros(()), "count": jnp.zeros((), jnp.int32)}

    def measure(key, params, state, rate, scene, memory):
        memory = {"distance": memory["distance"] + params.max_speed, "count": memory["count"] + 1}
        return memory, (memory["distance"], memory["count"])

    return jd.Sensor("odometer", measure, init)


def measure(sensors, key=KEY, memories=None):
    memories = init_sensors(sensors, key, PARAMS, STATE) if memories is None else memories
    rate = jax.tree.map(jnp.zeros_like, STATE)
    return measure_sensors(sensors, key, PARAMS, STATE, rate, Scene(), memories)


def test_every_drone_and_sensor_has_its_own_constants_memory_and_noise():
    sensors = (altimeter(), odometer(), dataclasses.replace(altimeter(), name="second"))
    memories, readings = measure(sensors)
    memories, readings = measure(sensors, memories=memories)
    assert memories["altimeter"] is None and sorted(readings) == ["altimeter", "odometer", "second"]
    distance, count = readings["odometer"]
    np.testing.assert_allclose(distance, 2 * PARAMS.max_speed)
    assert count.tolist() == [2, 2]
    noise = np.stack([readings[name] - STATE.pos[:, 2] for name in ("altimeter", "second")])
    assert noise.shape == (2, 2) and np.diff(np.sort(noise, axis=None)).min() > 1e-6  # m, beyond rounding
    drawn = [
        dataclasses.replace(odometer(), name=name, init=lambda key, params: jax.random.normal(key)) for name in "ab"
    ]
    assert len(np.unique(list(init_sensors(drawn, KEY, PARAMS, STATE).values()))) == 4


def test_equal_keys_give_equal_readings_and_a_further_sensor_changes_none():
    alone, again = (measure((altimeter(),))[1]["altimeter"] for _ in range(2))
    other = measure((altimeter(),), jax.random.key(1))[1]["altimeter"]
    beside = measure((altimeter(), odometer()))[1]["altimeter"]
    np.testing.assert_array_equal(alone, again)
    np.testing.assert_array_equal(alone, beside)
    assert np.all(alone != other)


def test_memories_are_carried_through_a_scan():
    sensors = (altimeter(), odometer())

    @jit_unoptimized
    def run(key):
        start = init_sensors(sensors, key, PARAMS, STATE)
        return jax.lax.scan(lambda memories, key: measure(sensors, key, memories), start, jax.random.split(key, 5))

    memories, readings = run(KEY)
    assert memories["odometer"]["count"].tolist() == [5, 5]
    assert readings["altimeter"].shape == (5, 2)


def test_a_memory_may_begin_with_the_state_of_its_drone():
    def lagging(key, params, state, rate, scene, memory):
        memory = memory + 0.1 * (state.pos[2] - memory)
        return memory, memory

    _, readings = measure((jd.Sensor("lagging", lagging, lambda key, params, state: state.pos[2]),))
    np.testing.assert_array_equal(readings["lagging"], STATE.pos[:, 2])


def returning(result):
    return jd.Sensor("odd", lambda key, params, state, rate, scene, memory: result, lambda key, params: jnp.zeros(3))


@pytest.mark.parametrize(
    ("result", "message"),
    [
        (jnp.zeros(3), r"measure of sensor 'odd' returned .*\(memory, reading\)"),
        ((jnp.zeros(2), 0.0), r"returned a memory of float64\[2\], but was given one of float64\[3\]"),
        (None, "measure of sensor 'odd' returned None; return the two values"),
        (((), 0.0), r"returned a memory of \(\), but was given one of float64\[3\]"),
        ((jnp.zeros(3), "far"), "reading with 'far' in it; return arrays"),
    ],
)
def test_what_is_no_memory_and_reading_is_refused(result, message):
    with pytest.raises(ValueError, match=message):
        measure((returning(result),))


def test_a_reading_without_a_memory_is_refused_although_it_is_traced():
    lost = jd.Sensor("lost", lambda key, params, state, rate, scene, memory: state.pos)
    with pytest.raises(ValueError, match=r"measure of sensor 'lost' returned .*Tracer.*; return the two values"):
        measure((lost,))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jd.Sensor("", altimeter().measure), "name of a sensor is ''"),
        (lambda: jd.Sensor("imu", 3), "measure of sensor 'imu': 3 is not a function"),
        (lambda: jd.Sensor("imu", lambda state: state), r"measure of sensor 'imu': .*\(key, params, state, rate, sc"),
        (lambda: jd.Sensor("imu", altimeter().measure, lambda: 0), r"init of sensor 'imu': .*\(key, params\)"),
        (lambda: jd.Sensor("imu", altimeter().measure, bound=0), "bound of sensor 'imu' is 0"),
        (lambda: check_sensors((altimeter(), altimeter())), "two sensors have the name 'altimeter'"),
        (lambda: check_sensors(altimeter()), "sensors is the single sensor 'altimeter'"),
        (lambda: check_sensors((3,)), r"sensors holds 3; give jaxdrones\.Sensor"),
        (lambda: check_sensors((at_100_hz(),), 0.011), "'altimeter' measures at 100 Hz; give at most the control rate"),
    ],
)
def test_a_wrong_sensor_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
    assert check_sensors((at_100_hz(),), 0.01)  # of the control rate itself


@pytest.fixture
def keys(monkeypatch):
    """Notes the random keys that a function uses while it is traced; they stay values, so that nothing is compiled."""
    keys = Keys()

    def name(key):
        return np.asarray(jax.random.key_data(key)).tobytes()

    def drawing(function):
        def draw(key, *args, **kwargs):
            with jax.ensure_compile_time_eval():
                keys.drawn[name(key)] += 1
            return function(key, *args, **kwargs)

        return draw

    def split(key, num=2, split=jax.random.split):
        with jax.ensure_compile_time_eval():
            children = list(split(key, num))
            keys.parents.add(name(key))
            keys.derived.update(map(name, children))
        return children

    for draw in Keys.draws:
        monkeypatch.setattr(jax.random, draw, drawing(getattr(jax.random, draw)))
    monkeypatch.setattr(jax.random, "split", split)
    return keys


def begun(sensor):
    """A measurement of one drone after the start of its episode."""
    params, state = (jax.tree.map(lambda x: x[0], tree) for tree in (PARAMS, STATE))
    memory = None if sensor.init is None else sensor.init(BEFORE, params)
    return sensor.measure(KEY, params, state, state, Scene(), memory)


SYSTEM = MotionCaptureSystem(dropout=0.1, pos_noise=0.1, angle_noise=0.1)


@pytest.mark.parametrize(
    ("draw", "draws"),
    [
        (lambda: begun(range_finder("rays", np.eye(3), max_range=1.0, noise=0.1, dropout=0.1)), 2),
        (lambda: begun(optical_flow(noise=0.1, dropout=0.1)), 2),
        (lambda: begun(imu()), 2 * 3 + 2 * 3),
        (lambda: begun(barometer()), 3 + 3),
        (lambda: begun(magnetometer()), 3 + 3),
        (lambda: begun(motion_capture(SYSTEM)), 3),
        (lambda: begun(state_estimate(system=SYSTEM)), 6 + 1 + 6 + 2 + 1),
        (lambda: DepthNoise(spread=0.1, dropout=0.1).apply(KEY, jnp.ones((1, 2, 2)), jd.Camera(resolution=(2, 2))), 2),
        (lambda: forest(KEY, density=(0.1, 0.2), tilt=9.0, spheres=2, boxes=2), 1 + 4 + 2 + 3),
        (lambda: room(key=KEY, pillars=2, spheres=2, boxes=2), 4 + 2 + 3),
    ],
)
def test_no_two_draws_of_a_device_or_scene_share_a_key(keys, draw, draws):
    jax.eval_shape(draw)
    keys.check(least=draws)

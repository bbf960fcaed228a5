"""The contract of sensors: one drone in the sensor, a team around it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones as jd
from jaxdrones.sensing import Scene
from jaxdrones.sensing.sensor import check_sensors, init_sensors, measure_sensors

KEY = jax.random.key(0)
PARAMS = jd.stack([jd.load_params("cf2x"), jd.load_params("racer")])
STATE = jd.State.at_rest([[0.0, 0.0, 1.0], [1.0, 2.0, 3.0]])


def altimeter() -> jd.Sensor:
    """Height with noise, m."""

    def measure(key, params, state, rate, scene, memory):
        return memory, state.pos[2] + 0.1 * jax.random.normal(key)

    return jd.Sensor("altimeter", measure)


def odometer() -> jd.Sensor:
    """The distance covered at the drone's top speed, m, and the number of measurements: a memory that is a pytree."""

    def init(key, params):
        return {"distance": jnp.zeros(()), "count": jnp.zeros((), jnp.int32)}

    def measure(key, params, state, rate, scene, memory):
        memory = {"distance": memory["distance"] + params.max_speed, "count": memory["count"] + 1}
        return memory, (memory["distance"], memory["count"])

    return jd.Sensor("odometer", measure, init)


def measure(sensors, key=KEY, memories=None):
    memories = init_sensors(sensors, key, PARAMS) if memories is None else memories
    rate = jax.tree.map(jnp.zeros_like, STATE)
    return measure_sensors(sensors, key, PARAMS, STATE, rate, Scene(), memories)


def test_every_drone_has_its_own_constants_memory_and_noise():
    sensors = (altimeter(), odometer())
    memories, readings = measure(sensors)
    memories, readings = measure(sensors, memories=memories)
    assert memories["altimeter"] is None and sorted(readings) == ["altimeter", "odometer"]
    distance, count = readings["odometer"]
    np.testing.assert_allclose(distance, 2 * PARAMS.max_speed)
    assert count.tolist() == [2, 2]
    noise = readings["altimeter"] - STATE.pos[:, 2]
    assert noise.shape == (2,) and noise[0] != noise[1]


def test_equal_keys_give_equal_readings_and_a_further_sensor_changes_none():
    alone, again = (measure((altimeter(),))[1]["altimeter"] for _ in range(2))
    other = measure((altimeter(),), jax.random.key(1))[1]["altimeter"]
    beside = measure((altimeter(), odometer()))[1]["altimeter"]
    np.testing.assert_array_equal(alone, again)
    np.testing.assert_array_equal(alone, beside)
    assert np.all(alone != other)


def test_memories_are_carried_through_a_scan():
    sensors = (altimeter(), odometer())

    @jax.jit
    def run(key):
        start = init_sensors(sensors, key, PARAMS)
        return jax.lax.scan(lambda memories, key: measure(sensors, key, memories), start, jax.random.split(key, 5))

    memories, readings = run(KEY)
    assert memories["odometer"]["count"].tolist() == [5, 5]
    assert readings["altimeter"].shape == (5, 2)


def returning(result):
    return jd.Sensor("odd", lambda key, params, state, rate, scene, memory: result, lambda key, params: jnp.zeros(3))


@pytest.mark.parametrize(
    ("result", "message"),
    [
        (jnp.zeros(3), r"measure of sensor 'odd' returned .*\(memory, reading\)"),
        ((jnp.zeros(2), 0.0), r"returned a memory of float64\[2\], but was given one of float64\[3\]"),
        (((), 0.0), r"returned a memory of \(\), but was given one of float64\[3\]"),
        ((jnp.zeros(3), "far"), "reading with 'far' in it; return arrays"),
    ],
)
def test_what_is_no_memory_and_reading_is_refused(result, message):
    with pytest.raises(ValueError, match=message):
        measure((returning(result),))


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
    ],
)
def test_a_wrong_sensor_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()

"""The four flights do what figures 6 to 9 of the gym-pybullet-drones paper show."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized

from jaxdrones import State, load_params, optimal, repeat
from jaxdrones.control import Setpoint
from jaxdrones.flights.conditions import CONTROLLERS, Conditions
from jaxdrones.flights.controllers import controller_of, setpoints
from jaxdrones.flights.examples import FLIGHTS
from jaxdrones.flights.fly import fly
from jaxdrones.flights.results import diverged
from jaxdrones.flights.results import results as of_flight
from jaxdrones.tasks.curves import figure_eight


@pytest.fixture(scope="module")
def circle():
    return fly("circle")


def results(record):
    return of_flight(record, FLIGHTS[record.conditions.flight].settling_time)


@pytest.mark.slow
def test_the_circle_is_flown_with_the_known_steady_lag(circle):
    # gym-pybullet-drones (2021) lags by 0.093 to 0.098 m with its explicit dynamics: its target velocity is zero.
    error = np.linalg.norm(circle.pos - circle.target_pos, axis=-1)
    np.testing.assert_allclose(error[circle.t > 4].mean(0), 0.097, atol=0.003)
    np.testing.assert_allclose([row["rms_error_m"] for row in results(circle)], 0.0955, atol=0.0025)
    assert diverged(circle) == {}


@pytest.mark.slow
def test_the_circle_has_smooth_rotors_at_120_hz_and_a_limit_cycle_at_48_hz(circle):
    assert max(row["rpm_std"] for row in results(circle)) < 1
    cycling = fly("circle", drones=1, control_hz=48, duration=6)
    assert results(cycling)[0]["rpm_std"] > 300
    assert diverged(cycling) == {}


def test_every_drone_of_the_circle_flies_alike(circle):
    radius = np.linalg.norm(circle.pos[:, :, :2] - [0, -0.3], axis=-1)[circle.t > 4]
    assert np.ptp(radius.mean(0)) < 1e-3
    np.testing.assert_allclose(circle.pos[-1, :, 2], 0.1 + 0.05 * np.arange(4), atol=1e-4)


@pytest.mark.slow
def test_the_velocity_flight_reaches_its_steps_and_reverses_them():
    record = fly("velocity")
    assert diverged(record) == {}
    assert all(row["steady_error_m_s"] < 2e-3 for row in results(record))
    before, after = record.vel[np.searchsorted(record.t, 1.4)], record.vel[-1]
    np.testing.assert_allclose(np.linalg.norm(after, axis=-1), 0.99 * 0.25, atol=2e-3)
    np.testing.assert_allclose(before[0], -after[0], atol=0.02)


@pytest.mark.slow
def test_ground_effect_lifts_a_take_off_higher_and_faster():
    # gym-pybullet-drones (2021): 0.1758 against 0.1650 m and 0.4365 against 0.3607 m/s. It starts with an unpowered
    # control period and Bullet's damping, hence 2 mm and 2 mm/s.
    record = fly("ground-effect")
    rows = results(record)
    assert diverged(record) == {}
    np.testing.assert_allclose([row["highest_z_m"] for row in rows], [0.1758, 0.1650], atol=2.5e-3)
    np.testing.assert_allclose([row["peak_vz_m_s"] for row in rows], [0.4365, 0.3607], atol=2.5e-3)


@pytest.mark.slow
def test_in_downwash_the_lower_drone_dips_and_the_upper_does_not():
    record = fly("downwash")
    upper, lower = results(record)
    assert diverged(record) == {}
    assert abs(lower["lowest_z_m"] - 0.472) < 2e-3  # the dip of gym-pybullet-drones (2021) from 0.5 m
    assert upper["lowest_z_m"] > 0.999
    free = results(fly("downwash", effects=[]))[1]
    assert free["lowest_z_m"] > 0.499


@pytest.mark.slow
def test_the_jet_model_pushes_less_than_equation_6_but_visibly():
    lower = results(fly("downwash", effects=["downwash"], duration=6.0))[1]
    assert 0.48 < lower["lowest_z_m"] < 0.495


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", ["cf2p", "hb", "racer"])
def test_every_vehicle_flies_the_circle(vehicle):
    record = fly("circle", vehicle=vehicle, drones=2, duration=6.0)
    assert all(row["steady_error_m"] < 0.125 for row in results(record))
    assert diverged(record) == {}


@pytest.mark.slow
def test_the_same_seed_is_the_same_flight_and_another_seed_another():
    first, again, other = (fly("circle", drones=1, duration=0.5, seed=seed).pos for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-4


@pytest.mark.slow
def test_the_start_and_the_samples_of_a_seed_are_drawn_from_different_keys():
    conditions = Conditions("circle", controller="mppi", seed=3)
    team, start = repeat(load_params("cf2x"), conditions.drones), FLIGHTS["circle"].start(conditions.drones)
    memory = controller_of(conditions).init(team, start)
    of_start = jax.random.key_data(jax.random.split(jax.random.key(3), conditions.drones))
    assert not np.any(np.all(jax.random.key_data(memory.key) == of_start, axis=-1))


def test_every_drone_plans_with_a_key_of_its_own_for_the_targets_from_now_on(monkeypatch):
    planner = dict(
        settings=lambda step: SimpleNamespace(horizon=2),
        init=lambda settings, params, state, key: key,
        control=lambda settings, params, memory, state, setpoints, dt: (memory, setpoints.pos),
    )
    for name, function in planner.items():
        monkeypatch.setattr(optimal.mppi, name, function)
    conditions, t = Conditions("circle", controller="mppi", seed=3, feedforward=False), 0.5
    team, start = repeat(load_params("cf2x"), conditions.drones), FLIGHTS["circle"].start(conditions.drones)
    controller = controller_of(conditions)
    keys, seen = controller.control(team, controller.init(team, start), start, jnp.array(t))
    assert len(np.unique(jax.random.key_data(keys), axis=0)) == conditions.drones
    ahead = [FLIGHTS["circle"].target(conditions.drones, t + k * conditions.dt, 12.0).pos for k in range(3)]
    np.testing.assert_allclose(seen, np.stack(ahead, axis=1), rtol=1e-12)


def test_progress_goes_from_nothing_to_all():
    told = []
    record = fly("circle", drones=1, duration=1.0, progress=told.append)
    np.testing.assert_allclose(record.t, np.arange(1, 121) / 120, rtol=1e-6)  # rows are states after control steps
    assert sorted(told)[-1] == 1.0 and len(told) > 50


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(flight="loop"), "unknown flight 'loop'.*circle"),
        (dict(flight="circle", vehicle="cf2"), "unknown vehicle 'cf2'; did you mean 'cf2"),
        (dict(flight="circle", drones=0), "drones is 0.*at least 1"),
        (dict(flight="circle", effects=["wind"]), "unknown effect 'wind'.*drag"),
        (dict(flight="circle", integrator="rk5"), "unknown integrator 'rk5'.*'rk4'"),
        (dict(flight="circle", rotors="slow"), "unknown rotors 'slow'.*lagging"),
        (dict(flight="circle", controller="lqg"), "unknown controller 'lqg'.*pid"),
        (dict(flight="circle", duration=-1.0), "duration is -1.0.*positive"),
        (dict(flight="circle", duration=1e-4), "duration is 0.0001 s, less than half a control period"),
        (dict(flight="circle", control_hz=0), "control rate .* is 0"),
        (dict(flight="ground-effect", drones=3), "drones is 3.*takes 2"),
        (dict(flight="velocity", controller="geometric"), "velocity flight is flown by 'pid'"),
        (
            dict(flight="velocity", feedforward=True),
            "feedforward is given; the velocity flight commands velocities",
        ),
        (dict(flight="circle", feedforward=1), "feedforward is 1; give True or False"),
        (dict(flight="velocity", vehicle="hb"), "no PID gains for 'hb'"),
        (
            dict(flight="circle", controller="pdi"),
            r"'pdi'; did you mean 'pid'\? \(known: pid, .*, mppi, or a \.py file\)",
        ),
        (dict(flight="circle", controller="mine.py:control"), "give the whole file, 'mine.py'"),
        (dict(flight="circle", controller="missing.py"), "missing.py: cannot be read"),
    ],
)
def test_a_wrong_option_is_refused_with_what_to_do(options, message):
    with pytest.raises(ValueError, match=message):
        fly(**options)


@pytest.mark.slow
@pytest.mark.parametrize("controller", optimal.CONTROLLERS)
@pytest.mark.parametrize("flight", ["circle", "ground-effect", "downwash"])
def test_optimal_controllers_fly_the_examples_closer_than_pid(flight, controller):
    options = {} if flight == "ground-effect" else {"duration": 4.0}
    by_pid, record = fly(flight, **options), fly(flight, controller=controller, **options)
    assert diverged(record) == {}
    for row, pid_row in zip(results(record), results(by_pid), strict=True):
        assert row["rms_error_m"] < 0.7 * pid_row["rms_error_m"]  # the take-off has only 0.5 s: measured 0.57


def test_a_controller_in_a_file_is_called_as_one_of_the_package_is(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(
        "import jax.numpy as jnp\n"
        "def gains(): return 3.0\n"
        "def init(): return jnp.zeros(2)\n"
        "def control(gains, params, memory, state, setpoint, dt):\n"
        "    return memory + gains * dt, jnp.stack([state.pos[0], setpoint.pos[2], setpoint.vel[0], params.mass])\n"
    )
    conditions = Conditions("circle", controller=str(file))
    assert conditions.feedforward
    params, start = repeat(load_params("cf2x"), 4), State.at_rest(np.eye(4, 3))

    def called(t):
        controller = controller_of(conditions)
        return setpoints(conditions, t), controller.control(params, controller.init(params, start), start, t)

    told, (memory, rpm) = jit_unoptimized(called)(1.3)
    np.testing.assert_allclose(memory, np.full((4, 2), 3.0 / 120), rtol=1e-12)
    np.testing.assert_array_equal(rpm.T, [start.pos[:, 0], told.pos[:, 2], told.vel[:, 0], params.mass])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("def gains(): ...\ndef init(): ...\n", r"mine\.py defines no 'control' \(it defines gains, init\)"),
        ("def control(*x, dt): ...\ndef init(): ...\ngains = 3\n", r"gains of mine\.py: 3 is not a function"),
        ("def control(a, b, dt): ...\ndef init(): ...\ndef gains(): ...\n", r"give a function of \(gains, params, mem"),
        (
            "def control(g, p, m, s, x): ...\ndef init(): ...\ndef gains(): ...\n",
            r"mine\.py has no parameter dt; add it",
        ),
    ],
)
def test_a_file_without_the_functions_of_a_controller_is_refused(text, message, tmp_path):
    (tmp_path / "mine.py").write_text(text)
    with pytest.raises(ValueError, match=message):
        controller_of(Conditions("circle", controller=str(tmp_path / "mine.py")))


def test_every_controller_receives_the_same_motion_of_the_target():
    """Position, velocity, acceleration and heading, but those of the 2021 example, which commands positions alone."""
    t, speed = 1.3, 2 * np.pi / 10  # rad/s
    conditions = {name: Conditions("circle", controller=name, feedforward=True) for name in ("pid", "mrac", "lqr")}
    conditions["positions"] = Conditions("circle")
    told = jax.jit(lambda t: {name: setpoints(of, t) for name, of in conditions.items()})(t)
    assert [name for name in CONTROLLERS if not Conditions("circle", controller=name).feedforward] == ["pid"]
    bare = told.pop("positions")
    for given in told.values():
        place = np.asarray(given.pos) - [[0, -0.3, 0]]
        np.testing.assert_allclose(given.vel, speed * np.cross([0, 0, 1], place * [1, 1, 0]), atol=1e-9)
        np.testing.assert_allclose(given.acc, -(speed**2) * place * [1, 1, 0], atol=1e-9)
        np.testing.assert_allclose(given.yaw, np.arange(4) * np.pi / 8)
    assert not np.any(bare.vel) and not np.any(bare.acc) and np.array_equal(bare.pos, given.pos)


@pytest.mark.slow
def test_given_the_same_motion_geometric_tracking_is_closer_than_pid(monkeypatch):
    """On the circle and on a figure-eight of 5 s, after two seconds: by a factor of 9 and of 4."""

    def eight(n, t, duration=None):
        pos = jnp.array([0, 0, 2.0]) + figure_eight(None, jnp.asarray(t, float) / 5)
        return Setpoint.at(jnp.broadcast_to(pos, (n, 3)))

    start = lambda n: State.at_rest(eight(n, 0.0).pos)  # noqa: E731
    monkeypatch.setitem(FLIGHTS, "eight", dataclasses.replace(FLIGHTS["circle"], target=eight, start=start))
    for flight in "circle", "eight":
        options = dict(drones=1, duration=6.0, feedforward=True)
        names = ("pid", "geometric", "lqr")
        error = {name: results(fly(flight, controller=name, **options))[0]["rms_error_m"] for name in names}
        assert error["geometric"] < error["pid"] / 2 and error["lqr"] < error["geometric"]

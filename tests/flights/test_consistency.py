"""A log that contradicts itself is refused with its likely cause; recorded and simulated flights pass."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxdrones import assets
from jaxdrones.cli import main
from jaxdrones.flights import inconsistencies, load_flights
from jaxdrones.flights.consistency import _check_drift, contradictions
from jaxdrones.flights.motion_tests import Motion, MotionTest, shift_test

NED = np.array([1, -1, -1])
SIGNS = np.array([1, -1, -1, 1])
DOWN = np.array([1, 1, -1])


@pytest.fixture(scope="module", params=[pytest.param("flown", marks=pytest.mark.slow), "B3_figure8_slow_rep2"])
def sound(request, flown, columns_of):
    """The columns of a simulated flight, and those of a recorded one."""
    return columns_of(flown[1] if request.param == "flown" else load_flights(request.param)[0])


def others(columns, **changed):
    return columns | {name: change(columns[name]) for name, change in changed.items()}


def delayed(x, rows):
    return x[np.clip(np.arange(len(x)) - rows, 0, len(x) - 1)]


def motors(order):
    def change(columns):
        name = "rpm" if "rpm" in columns else "pwm"
        return columns | {name: columns[name][:, order]}

    return change


DAMAGE = {
    "a fast clock": (lambda c: others(c, t=lambda t: 1.19 * t), "wrong clock"),
    "a slow clock": (lambda c: others(c, t=lambda t: 0.81 * t), "wrong clock"),
    "w first": (lambda c: others(c, quat=lambda q: q[:, [3, 0, 1, 2]]), "quaternions look like w, x, y, z"),
    "conjugated": (lambda c: others(c, quat=lambda q: q * np.array([-1, -1, -1, 1])), "quaternions look conjugated"),
    "NED": (
        lambda c: others(
            c, pos=lambda x: x * NED, vel=lambda x: x * NED, omega=lambda x: x * NED, quat=lambda q: q * SIGNS
        ),
        "look like NED axes",
    ),
    "motors from the front left": (motors([3, 0, 1, 2]), "the motors turn the drone as if"),
    "two motors swapped": (motors([1, 0, 2, 3]), "columns were back right, front right, back left, front left"),
    "other velocities": (
        lambda c: others(c, vel=lambda x: np.roll(x, len(x) // 3, axis=0)),
        "vel is not the derivative",
    ),
    "a clock that slows down": (
        lambda c: others(
            c, t=lambda t: np.append(t[0], t[0] + np.cumsum(np.diff(t) * np.linspace(0.75, 1.25, len(t) - 1)))
        ),
        "wrong clock",
    ),
    "a world turned about z": (
        lambda c: others(c, quat=lambda q: (Rotation.from_euler("z", -0.5) * Rotation.from_quat(q)).as_quat()),
        "apart about z: the world axes of quat and vel differ",
    ),
    "a body turned about z": (
        lambda c: others(c, quat=lambda q: (Rotation.from_quat(q) * Rotation.from_euler("z", 0.7)).as_quat()),
        "apart about z: the body axes of quat and omega differ",
    ),
    "no rates": (lambda c: others(c, omega=lambda w: 0 * w), "omega is not the rate of quat"),
    "half velocities": (lambda c: others(c, vel=lambda x: x / 2), "vel is not the derivative of pos"),
    "late velocities": (lambda c: others(c, vel=lambda x: delayed(x, 7)), r"vel is about 0\.0[67]\d* s late"),
    "early velocities": (lambda c: others(c, vel=lambda x: delayed(x, -7)), r"vel is about 0\.0[67]\d* s early"),
    "heights downwards": (lambda c: others(c, pos=lambda x: x * DOWN), "z of pos, or that of vel, has the opposite"),
    "climbs downwards": (lambda c: others(c, vel=lambda x: x * DOWN), "z of pos, or that of vel, has the opposite"),
    "heights and climbs downwards": (
        lambda c: others(c, pos=lambda x: x * DOWN, vel=lambda x: x * DOWN),
        "the vertical acceleration falls where the thrust rises: z of vel has the opposite sign",
    ),
}


def load(folder, columns, **options):
    np.savez(folder / "flight.npz", **columns)
    (log,) = load_flights(folder / "flight.npz", **options)
    return log


def test_sound_flights_have_no_contradiction(flown):
    for log in (flown[1], *load_flights(*assets.flights())):
        assert inconsistencies(log) == []


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_flight_that_contradicts_itself_is_refused_with_its_cause(sound, tmp_path, damage):
    change, cause = DAMAGE[damage]
    with pytest.raises(ValueError, match=cause):
        load(tmp_path, change(sound))
    assert load(tmp_path, change(sound), allow_inconsistent=True).name == "flight.npz"


@pytest.mark.parametrize(("turned", "found"), [(0.0, ""), (-0.5, "degrees apart about z")])
@pytest.mark.parametrize("way", [1, -1])
def test_the_thrust_of_a_circle_tilts_against_the_drag_too(turned, found, way):
    """A drag of 0.35 1/s alone puts 19 degrees between the tilt and the acceleration of a circle at 1 rad/s."""
    t = np.arange(0, 12, 0.01)
    pos = np.stack([np.cos(t), way * np.sin(t), 0 * t], axis=1)
    vel = np.stack([-np.sin(t), way * np.cos(t), 0 * t], axis=1)
    up = 0.35 * vel - pos + [0, 0, 9.81]
    about = np.cross([0, 0, 1.0], up)
    angle = np.arccos(up[:, 2] / np.linalg.norm(up, axis=1))
    attitude = Rotation.from_rotvec(about * (angle / np.linalg.norm(about, axis=1))[:, None])
    omega = np.gradient(attitude.as_rotvec(), 0.01, axis=0)
    attitude = Rotation.from_euler("z", way * turned) * attitude
    said = contradictions(Motion(pos, attitude, vel, omega), np.zeros((0, 4)), 0.0)
    assert len(said) == bool(found) and found in "".join(said)


@pytest.mark.parametrize("heading_rate", [0.3, 0.5, 1.5, 3.0])
def test_rates_in_world_axes_are_named_in_a_turning_flight(heading_rate):
    """They have the same heading rate, which alone hides the others in a fast turn."""
    t = np.arange(2000) * 0.01
    angles = np.stack([heading_rate * t, 0.25 * np.cos(1.7 * t), 0.3 * np.sin(2 * t)], axis=1)
    attitude = Rotation.from_euler("ZYX", angles)
    turns = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / 0.01
    omega = np.concatenate([turns[:1], (turns[1:] + turns[:-1]) / 2, turns[-1:]])
    up = attitude.apply([0, 0, 1.0])
    vel = np.cumsum(9.81 * up / up[:, 2:] - [0, 0, 9.81], axis=0) * 0.01
    vel = vel - np.mean(vel, axis=0)
    sound = Motion(np.cumsum(vel, axis=0) * 0.01, attitude, vel, omega)
    assert contradictions(sound, np.zeros((0, 4)), 0.0) == []
    (said,) = contradictions(sound._replace(omega=attitude.apply(omega)), np.zeros((0, 4)), 0.0)
    assert "omega looks like world axes" in said
    (said,) = contradictions(sound._replace(omega=1.3 * omega), np.zeros((0, 4)), 0.0)
    assert "turns of quat" in said and said.endswith("instead of 1: omega has another unit or scale")


def test_a_battery_that_is_charged_by_its_load_is_refused(tmp_path, columns_of):
    sound = columns_of(load_flights("B3_figure8_slow_rep2")[0])
    with pytest.raises(ValueError, match="the load of the battery has the wrong sign"):
        load(tmp_path, others(sound, vbat=lambda v: 2 * v.max() - v))
    with pytest.raises(ValueError, match=r"vbat is -4\.\d+ to -3\.\d+, which looks like a voltage too low"):
        load(tmp_path, others(sound, vbat=np.negative))


def test_rows_at_uneven_times_are_resampled(columns, tmp_path):
    """Rows 8 to 12 ms apart of a smooth motion are those at 100 Hz, with an error of the second order in the gaps."""
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.008, 0.012, 300))

    def motion(t):
        angle = np.sin(2 * t)[:, None] * np.array([0.3, 0.2, 2.0])
        pos = np.stack([np.sin(t), np.cos(t), 0.3 * np.sin(2 * t)], axis=1)
        vel = np.stack([np.cos(t), -np.sin(t), 0.6 * np.cos(2 * t)], axis=1)
        quat = (
            Rotation.from_rotvec(angle).as_quat() * np.where(np.arange(len(t)) % 2, 1, -1)[:, None]
        )  # either sign is the attitude
        return {"pos": pos, "quat": quat, "vel": vel, "omega": 2 * np.cos(2 * t)[:, None] * np.array([0.3, 0.2, 2.0])}

    rpm = 15_000 + 1000 * np.sin(3 * t)[:, None] * np.ones(4)
    target = {"target_pos": motion(t)["pos"], "target_yaw": (2.5 * t + np.pi) % (2 * np.pi) - np.pi}
    log = load(tmp_path, motion(t) | target | {"t": t, "rpm": rpm}, allow_inconsistent=True)
    np.testing.assert_allclose(np.diff(log.t), 0.01, atol=1e-12)
    assert log.t[0] == t[0] and t[-1] - 0.01 < log.t[-1] <= t[-1]
    true = motion(log.t)
    for name, second_derivative in (("pos", 1.5), ("vel", 2.5), ("omega", 16)):
        np.testing.assert_allclose(
            getattr(log, name)[:, 0], true[name], atol=0.012**2 / 8 * second_derivative, err_msg=name
        )
    apart = Rotation.from_quat(true["quat"]).inv() * Rotation.from_quat(log.quat[:, 0])
    assert apart.magnitude().max() < 0.012**2 / 8 * 8.2
    turned = log.target_yaw[:, 0] - 2.5 * log.t  # whole turns, also in between
    np.testing.assert_allclose(turned, 2 * np.pi * np.round(turned / (2 * np.pi)), atol=1e-9)
    np.testing.assert_allclose(log.rpm[:, 0, 0], 15_000 + 1000 * np.sin(3 * log.t), atol=0.012**2 / 8 * 9000)


def test_rows_that_are_mostly_too_far_apart_are_refused(columns, tmp_path):
    t = 2 * columns["t"]
    t[2] = t[1] + 0.005
    with pytest.raises(ValueError, match=r"rows are 0\.02 s apart; record them at least every 0\.012 s"):
        load(tmp_path, columns | {"t": t})


def test_an_integral_of_the_velocity_is_exact_for_a_steady_acceleration():
    t = np.arange(200)[:, None] * 0.01 * np.array([1.0, -2, 3])
    test = shift_test(t**2 / 2, t * np.array([1.0, -2, 3]))
    np.testing.assert_allclose(test.implied, test.has, atol=1e-12)


@pytest.mark.parametrize("halves", [(1.0, 1.2), (1.2, 1.0), (1.1, 1.1)])
def test_a_scale_of_distances_that_rises_or_falls_is_a_wrong_clock(halves):
    way = np.random.default_rng(0).normal(size=(40, 3))
    test = MotionTest(way * np.repeat(halves, 20)[:, None], way, 0.01, 0.05, 0.03)
    assert len(_check_drift(test)) == (halves[0] != halves[1])


def test_even_rows_stay_as_they_are_and_rotor_speeds_leave_out_the_pwm(columns, tmp_path):
    log = load(tmp_path, columns | {"pwm": np.full_like(columns["rpm"], 3e4)})
    assert not log.has("pwm")
    for name in ("pos", "vel", "omega", "rpm"):
        np.testing.assert_array_equal(getattr(log, name)[:, 0], columns[name])
    np.testing.assert_array_equal(log.t, columns["t"])


@pytest.mark.parametrize("command", ["score", "fit"])
def test_commands_refuse_a_contradiction_in_one_line(columns, tmp_path, capsys, command):
    np.savez(tmp_path / "flight.npz", **DAMAGE["w first"][0](columns))
    options = ["--vehicle", "cf2x"] + ["--output", str(tmp_path / "fit")] * (command == "fit")
    assert main([command, str(tmp_path / "flight.npz"), *options]) == 2
    error = capsys.readouterr().err
    assert "quaternions look like w, x, y, z" in error and "--allow-inconsistent" in error and error.count("\n") == 1


@pytest.mark.parametrize("running", [0, 1, 20])
def test_a_log_in_which_not_all_motors_ever_run_is_refused_in_one_line(running, columns_of, tmp_path, capsys):
    """One motor that stands still ended in a report of a fault of the package."""
    (log,) = load_flights("B3_figure8_slow_rep2")
    stands = np.arange(len(log.t)) >= np.argmax(log.in_flight) + running
    columns = others(columns_of(log), pwm=lambda pwm: np.where(stands[:, None] & (np.arange(4) == 2), 0, pwm))
    np.savez(tmp_path / "z.npz", **columns)
    assert main(["score", str(tmp_path / "z.npz"), "--vehicle", "cf21"]) == 2
    assert "the motors never run for 0.5 s without interruption; give a log of a flight" in capsys.readouterr().err


@pytest.mark.parametrize("period", [1 / 120, 1 / 200, 1 / 500])
def test_a_log_whose_times_are_sums_of_periods_is_resampled_up_to_its_last_row(tmp_path, period):
    """Rounded sums end a little before the last multiple of 10 ms."""
    rows = round(3 / period) + 1
    t = np.cumsum(np.full(rows, period))
    assert 0 < t[0] + 3 - t[-1] < 1e-9
    angle = 0.3 * t[:, None] * np.array([0.0, 0.0, 1.0])
    still = {name: np.zeros((rows, 3)) for name in ("pos", "vel", "omega")}
    log = load(
        tmp_path,
        still | {"t": t, "quat": Rotation.from_rotvec(angle).as_quat(), "rpm": np.full((rows, 4), 15_000.0)},
        allow_inconsistent=True,
    )
    assert len(log.t) == 301
    turned = Rotation.from_quat(log.quat[:, 0]).as_rotvec()
    np.testing.assert_allclose(turned[:, 2], 0.3 * log.t, atol=1e-9)

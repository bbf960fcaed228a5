"""A vehicle is identified from its flights, and repeats them."""

import builtins
import dataclasses
import functools
import importlib
import json
import re
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones
from jaxdrones import State, rotation
from jaxdrones.cli import main
from jaxdrones.control import firmware_pid
from jaxdrones.dynamics.propulsion import crazyflie_motors
from jaxdrones.errors import UserError
from jaxdrones.flights import (
    FlightLog,
    Vehicle,
    fit,
    hold_errors,
    least_squares,
    load_flights,
    load_vehicle,
    open_loop_errors,
)
from jaxdrones.flights.fit import Estimate, Report, _estimate, _Problem
from jaxdrones.flights.least_squares import spread, standard_errors
from jaxdrones.flights.open_loop import _rotor_speed, _shifted, residuals, window_starts
from jaxdrones.flights.parameters import PARAMETERS, check_guess, value_of, with_parameters
from jaxdrones.flights.path_fit import _balance_residuals, _least_squares
from jaxdrones.flights.preparation import named_apart
from jaxdrones.flights.report import write_vehicle
from jaxdrones.flights.vehicle import Instruments
from jaxdrones.urdf import parse_params
from jaxdrones.urdf_writer import to_urdf

NANOBENCH = "B3_figure8_slow_rep2"
IDENTIFIABLE = ("kf", "drag_coeff_x", "drag_coeff_y", "flapping_coeff_x", "flapping_coeff_y")


@pytest.mark.slow
def test_the_vehicle_that_flew_repeats_its_flight(flown):
    """Its errors are below 1 % of those of others; rk4 flew, and the midpoint rule repeats."""
    params, log = flown
    own = open_loop_errors(log, Vehicle.of(params), crazyflie_motors())
    other = open_loop_errors(log, Vehicle.of(jaxdrones.load_params("cf2x")), crazyflie_motors())
    assert (own[-1] < 0.01 * other[-1]).all()
    assert (own[-1] < 0.01 * hold_errors(log)[-1]).all()


@pytest.mark.slow
def test_a_fit_finds_the_vehicle_that_flew(flown, tmp_path):
    """From half of the drag and no flapping, thrust is found within 1 %, drag and flapping within 5 %."""
    params, log = flown
    start = params.replace(
        kf=params.kf / 1.2, drag_coeff=params.drag_coeff * jnp.array([0.5, 0.5, 1]), flapping_coeff=jnp.zeros(2)
    )
    report = fit([log], start, IDENTIFIABLE)
    found = report.vehicle.params
    np.testing.assert_allclose(found.kf, params.kf, rtol=0.01)
    np.testing.assert_allclose(found.drag_coeff, params.drag_coeff, rtol=0.05)
    np.testing.assert_allclose(found.flapping_coeff, params.flapping_coeff, rtol=0.05)
    assert all(estimate.identifiable for estimate in report.parameters.values())

    write_vehicle(tmp_path / "fit", report, "test")
    read = load_vehicle(tmp_path / "fit")
    np.testing.assert_allclose(read.params.flapping_coeff, found.flapping_coeff, rtol=1e-6)
    np.testing.assert_allclose(read.params.max_rpm, found.max_rpm, rtol=1e-6)


def test_an_infinite_standard_error_is_null_in_the_report_which_is_strict_json(tmp_path):
    vehicle = Vehicle.of(jaxdrones.load_params("cf2x"))
    found = {"kf": Estimate(value=3e-10, std_error=np.inf, identifiable=False)}
    write_vehicle(tmp_path / "fit", Report(vehicle, found, {}, (np.nan,), {}), "test")
    report = json.loads((tmp_path / "fit" / "report.json").read_text(), parse_constant=pytest.fail)
    assert report["parameters"]["kf"]["std_error"] is None and report["losses"] == [None]


@pytest.mark.slow
def test_unidentifiable_parameters_are_named(flown):
    """With measured rotor speeds, no flight identifies how the rotors follow a command."""
    params, log = flown
    with pytest.raises(ValueError, match=r"do not identify rotor_lag \(\S+ \+- \S+\); leave .* out of --parameters"):
        fit([log], params, ("kf", "rotor_lag"))


@pytest.fixture(scope="module")
def fits(flown):
    """Fits of kf to a flight, to two of them, and to one with a validation flight of a stronger vehicle."""
    params, log = flown
    other = dataclasses.replace(log, name="other.npz", rpm=1.3 * log.rpm)
    start = params.replace(kf=params.kf / 1.2)
    return [
        fit(logs, start, ("kf",), validate).parameters["kf"]
        for logs, validate in (([log], ()), ([log, log], ()), ([log], [other]))
    ]


def test_measured_speeds_are_those_at_the_times_of_the_rows():
    """In the step from one row to the next a speed that rises by 7 RPM a row is on average that of half a row later."""
    rows = jnp.arange(93.0)  # the first step begins at row 36: 30 rows of warm-up and 6 of delay
    speed, rate = _rotor_speed(Vehicle.of(jaxdrones.load_params("cf2x")), jnp.tile(7 * rows[:, None], (1, 4)), None)
    np.testing.assert_allclose(speed[:, 0], 7 * (36.5 + np.arange(50)), rtol=1e-6)
    np.testing.assert_allclose(rate, 7 / 0.01, rtol=1e-4)


def test_rotors_follow_the_pwm_between_the_rows():
    """A PWM that is recorded while it rises is on average that of half a row later; the lag delays it by five rows."""
    params = jaxdrones.load_params("cf2x").replace(rotor_rise_time=jnp.asarray(0.05))
    motors = crazyflie_motors().replace(coefficients=jnp.array([0, 0, params.kf, 0]))  # the speed is the voltage
    rows = jnp.arange(93.0)
    command = jnp.stack([*[7 * rows] * 4, jnp.ones(93), jnp.zeros(93)], axis=1)
    speed, _ = _rotor_speed(Vehicle.of(params), command, motors)
    np.testing.assert_allclose(speed[:, 0], 7 * (36.5 - 5 + np.arange(50)), atol=7 * 0.03)


def test_a_window_is_in_flight_from_its_start_to_its_last_horizon():
    """Fifty rows after its start, which are fifty-one."""
    zero = np.zeros((90, 1, 3))
    for rows, starts in (52, [10, 11]), (51, [10]), (50, None):
        pwm = np.zeros((90, 1, 4))
        pwm[10 : 10 + rows] = 3e4
        log = FlightLog(0.01 * np.arange(90), zero, np.ones((90, 1, 4)) / 2, zero, zero, pwm=pwm)
        if starts is None:
            with pytest.raises(ValueError, match=r"motors never run for 0\.5 s without interruption"):
                window_starts(log)
        else:
            np.testing.assert_array_equal(window_starts(log), starts)


@pytest.mark.parametrize("delay", [-7.0, -0.5, 0.0, 5.8, 6.5, 20.0])
def test_constant_rotor_speeds_have_no_delay(delay):
    """Beyond the six rows of margin the delay is limited: the rotors do not slow down or stop."""
    np.testing.assert_allclose(_shifted(jnp.full((40, 4), 2e4), jnp.array(delay)), 2e4, rtol=1e-6)


@pytest.mark.slow
def test_a_fit_finds_the_thrust_whatever_the_validation_flight(flown, fits):
    """Validation flights choose a round and move no estimate; the start is 17 % off."""
    for estimate in fits:
        np.testing.assert_allclose(estimate.value, flown[0].kf, rtol=0.01)
        assert estimate.identifiable


@pytest.fixture
def problem_of(monkeypatch):
    """Least-squares problems of flights by a model that compiles fast: positions depend on two parameters."""

    def predict(vehicle, start, command, motors):
        x, y = vehicle.params.drag_coeff[0] * 1e7, vehicle.params.trim_torque[0] * 1e4
        pos = start.pos[None] * (1 + 0.3 * jnp.arange(3.0) * (x + y + x * y))[:, None]
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (3, *x.shape)), start).replace(pos=pos)

    def problem(flights, names):
        rng, rows = np.random.default_rng(0), 120
        quat, moved = 0.1 * rng.normal(size=(rows, 1, 4)) + [0, 0, 0, 1], 0.1 * rng.normal(size=(3, rows, 1, 3))
        quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
        log = FlightLog(0.01 * np.arange(rows), moved[0], quat, *moved[1:], rpm=np.full((rows, 1, 4), 14e3))
        logs = named_apart([log] * flights)
        return _Problem(logs, jaxdrones.load_params("cf2x"), names, crazyflie_motors())

    monkeypatch.setattr(least_squares, "predict", predict)
    monkeypatch.setattr(
        importlib.import_module("jaxdrones.flights.fit"), "open_loop_errors", lambda *_: np.ones((3, 4))
    )
    return problem


def test_the_normal_equations_have_half_of_the_gradient_of_their_loss(problem_of):
    """With outlying windows, of which the loss grows slowly, and away from the initial guess, with its prior."""
    problem = problem_of(1, ("drag_coeff_x", "trim_torque_x"))
    normal, x = functools.partial(problem.normal, scales=[np.full((3, 4), 0.1)]), np.array([0.2, -0.3])
    slopes = [normal(x + d).loss - normal(x - d).loss for d in 1e-5 * np.eye(2)]
    np.testing.assert_allclose(normal(x).gradient, np.divide(slopes, 4e-5), rtol=1e-5)


def test_the_error_of_a_median_over_flights_falls_with_the_root_of_their_number(problem_of):
    found = [problem_of(n, ("trim_torque_x",)).solve((), False, lambda _: None) for n in (1, 4)]
    one, four = (report.parameters["trim_torque_x"] for report in found)
    assert len(found[1].per_flight) == 4 and four.value == pytest.approx(one.value)
    assert four.std_error == pytest.approx(one.std_error / 2) and 0 < one.std_error < np.inf


def test_the_error_of_a_median_has_the_scatter_of_the_flights(problem_of):
    """Trims that differed by 1.6e-4 N m had a median with an error of 1e-7 N m, as if each flight had this trim."""
    problem = problem_of(3, ("trim_torque_x",))
    x = np.array([0.1, 0.4, 0.7])
    normal = problem.normal(x, [np.full((3, 4), 1e-6)] * 3)
    estimate = problem._report(x, normal._replace(spread=0 * normal.spread), (), (), False).parameters["trim_torque_x"]
    assert estimate.value == pytest.approx(0.4e-4)
    assert estimate.std_error == pytest.approx(0.3e-4 / np.sqrt(3))


def test_a_coordinate_changes_its_parameter_by_its_scale():
    """A positive parameter becomes exp(0.3) times as large, another one 0.3 scales larger."""
    vehicle = Vehicle.of(jaxdrones.load_params("cf21"))
    for name in ("inertia_y", "rotor_lag", "rate_damping_xy", "center_of_mass_x", "tilt_y"):
        before, after = value_of(vehicle, name), value_of(with_parameters(vehicle, [name], [0.3]), name)
        scale = PARAMETERS[name].scale
        expected = before * np.exp(0.3) if scale is None else before + 0.3 * scale
        assert after == pytest.approx(expected, rel=1e-6), name


def test_a_log_is_that_of_its_instruments():
    """The tilt turns the attitude there and back, and only horizontal distances are scaled."""
    quat, pos = rotation.from_rpy(jnp.array([0.3, -0.2, 1.0])), jnp.array([1.0, 2, 3])
    ours = Instruments.ideal().replace(tilt=jnp.array([0.02, -0.03]), position_scale=jnp.array(0.9))
    true = jax.jit(ours.true_attitude)(quat)
    np.testing.assert_allclose(jax.jit(ours.logged_attitude)(true), quat, rtol=1e-6)
    turned = jax.jit(lambda: rotation.log(rotation.multiply(rotation.conjugate(quat), true)))()
    np.testing.assert_allclose(turned, [0.02, -0.03, 0], atol=1e-6)
    np.testing.assert_allclose(ours.logged_position(pos, jnp.ones(3)), [1, 1.9, 3], rtol=1e-6)


def test_a_vehicle_whose_thrust_carries_and_lifts_it_is_in_balance():
    vehicle, motors = Vehicle.of(jaxdrones.load_params("cf21")), crazyflie_motors()
    duty, battery, up = jnp.full((1, 100, 4), 0.6), jnp.full((1, 100), 3.9), jnp.full((1, 100), 0.9)
    lift = 4 * motors.thrust(jnp.array(0.6 * 3.9)) * 0.9
    acc = lift / vehicle.params.mass - vehicle.params.gravity
    found = _balance_residuals(vehicle, motors, duty, battery, jnp.zeros((1, 1)), up, acc[None], jnp.zeros(2))
    np.testing.assert_allclose(found, 0, atol=1e-9)
    assert abs(acc) > 1


@pytest.mark.slow
def test_standard_errors_fall_with_the_root_of_the_number_of_flights(fits):
    one, two, _ = fits
    assert two.std_error / one.std_error == pytest.approx(2**-0.5, rel=0.05)


def test_residuals_are_predictions_minus_log():
    """A prediction that is ahead and turned about an axis of the body has positive residuals along them."""
    quat = rotation.from_rpy(jnp.array([0.3, -0.2, 1.0]))
    logged = State(jnp.ones(3), quat, jnp.ones(3), jnp.ones(3), jnp.zeros(4))
    pos, vel, turn, omega = 1e-3 * (1 + jnp.arange(12.0).reshape(4, 3))
    turned = jax.jit(lambda: rotation.multiply(quat, rotation.exp(turn)))()
    predicted = State(1 + pos, turned, 1 + vel, 1 + omega, jnp.zeros(4))
    np.testing.assert_allclose(jax.jit(residuals)(predicted, logged), [pos, vel, turn, omega], rtol=1e-4)


@pytest.mark.parametrize(
    ("name", "error", "identifiable"),
    [
        ("trim_torque_x", 0.24, False),  # 1.8e-5 +- 2.4e-5 N m
        ("trim_torque_x", 0.091, False),  # a bit more than half of the value
        ("trim_torque_x", 0.089, True),
        ("kf", 0.51, False),
        ("kf", 0.49, True),
        ("position_scale", 1.1, False),  # 1 +- 0.022, which says nothing of a scale error
        ("position_scale", 0.9, True),
    ],
)
def test_an_estimate_whose_interval_has_zero_is_not_identifiable(name, error, identifiable):
    params = jaxdrones.load_params("cf2x").replace(trim_torque=jnp.array([1.8e-5, 0, 0]))
    assert _estimate(Vehicle.of(params), name, error).identifiable is identifiable


def test_a_resting_drone_is_no_flight(flown):
    params, log = flown
    rest = dataclasses.replace(log, name="rest.npz", pos=0 * log.pos, vel=0 * log.vel)
    for logs, validate in (([log], [rest]), ([rest], ())):
        with pytest.raises(ValueError, match=r"rest\.npz: the drone rests"):
            fit(logs, params, ("kf",), validate)


def test_logs_of_equal_names_are_different_flights(flown, tmp_path):
    log = flown[1]
    files = [tmp_path / folder / "log.npz" for folder in ("a", "b")]
    logs = named_apart([dataclasses.replace(log, name="log.npz", file=file) for file in files])
    assert [log.name for log in logs] == ["a/log.npz", "b/log.npz"]
    with pytest.raises(ValueError, match="is given twice"):
        named_apart([dataclasses.replace(log, file=files[0])] * 2)
    assert [log.name for log in named_apart([log, log])] == ["flown.npz", "flown.npz (2)"]


def test_the_firmware_has_the_gains_of_the_propellers(monkeypatch, tmp_path):
    """`--propellers 2.1` flies its motors with its gains, not with those of the 2.1+."""
    given = []

    def stop(*arguments):
        given.append(arguments)
        raise UserError("seen enough")

    monkeypatch.setattr(importlib.import_module("jaxdrones.flights.fit"), "fit_path", stop)
    assert main(["fit", NANOBENCH, "--propellers", "2.1", "--output", str(tmp_path)]) == 2
    ((_, _, motors, gains, _),) = given
    jax.tree.map(np.testing.assert_array_equal, gains, firmware_pid.gains(propellers="2.1"))
    jax.tree.map(np.testing.assert_array_equal, motors, crazyflie_motors("2.1"))


def test_a_default_fit_repeats_without_parameters_that_would_be_negative(flown, monkeypatch):
    """Perfect logs gave a damping of -2e-6 +- 4e-7 N m s, and a vehicle that no command accepted."""
    params, log = flown
    problems, said = [], []

    class Fitted:
        def __init__(self, logs, start, names, motors):
            self.start, self.names = start, names
            problems.append(self)

        def solve(self, validate, named, progress):
            noise = jnp.array([1e-6, 1e-6, -2e-6]) * ("rate_damping_z" in self.names)
            return SimpleNamespace(vehicle=Vehicle.of(self.start.replace(rate_damping=self.start.rate_damping + noise)))

    monkeypatch.setattr(importlib.import_module("jaxdrones.flights.fit"), "_Problem", Fitted)
    start = params.replace(rate_damping=jnp.array([0.0, 0.0, 1e-6]))
    assert fit([log], start, progress=said.append).vehicle.params.rate_damping.tolist() == [0, 0, 0]
    first, second = problems
    assert set(first.names) - set(second.names) == {"rate_damping_z"}
    assert said == ["rate_damping_z would be negative; fitting again with zero in place of them"]
    fit([log], start, ("rate_damping",))
    assert len(problems) == 3  # named parameters are the user's choice


def test_a_fitted_vehicle_that_no_command_accepts_is_written_with_a_warning(monkeypatch, tmp_path, capsys):
    """A drag that noise made negative was written without a word, and refused by the next command."""
    params = jaxdrones.load_params("cf2x")
    vehicle = Vehicle.of(params.replace(drag_coeff=params.drag_coeff.at[2].set(-1e-8)))
    report = Report(vehicle, {"drag_coeff_z": Estimate(-1e-8, 2e-9, True)}, {}, (), {})
    monkeypatch.setattr(importlib.import_module("jaxdrones.cli.fit"), "fit", lambda *arguments: report)
    assert main(["fit", NANOBENCH, "--output", str(tmp_path / "fit"), "--no-figure"]) == 0
    said = capsys.readouterr()
    assert "drag_coeff_z  -1e-08" in said.out and (tmp_path / "fit" / "vehicle.urdf").exists()
    assert re.search(r"no command accepts .*drag_coeff=.* should be 0 to 1\); leave such parameters out", said.err)


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [False, True])
def test_a_fit_is_written_without_matplotlib_and_never_over_another(
    flown, columns, monkeypatch, tmp_path, capsys, hidden
):
    params = flown[0]
    np.savez(tmp_path / "a---.npz", **columns)
    real = builtins.__import__

    def missing(name, *args, **others):
        if hidden and name.partition(".")[0] == "matplotlib":
            raise ImportError("No module named 'matplotlib'")
        return real(name, *args, **others)

    monkeypatch.setattr(builtins, "__import__", missing)
    (tmp_path / "x---y.urdf").write_text(to_urdf(params, "x"))
    command = ["fit", str(tmp_path / "a---.npz"), "--vehicle", str(tmp_path / "x---y.urdf"), "--parameters", "kf"]
    command += ["--output", str(tmp_path / "fit")]
    assert main(command) == 0
    said = capsys.readouterr()
    assert re.search(r"kf +\S+ \+- ", said.out)
    assert ('[cli]"' in said.err) is hidden
    assert (tmp_path / "fit" / "errors.png").exists() is not hidden
    load_vehicle(tmp_path / "fit")
    before = {file: file.read_bytes() for file in (tmp_path / "fit").iterdir()}
    assert main(command) == 2
    assert "exists already; remove it, or give another --output" in capsys.readouterr().err
    assert {file: file.read_bytes() for file in (tmp_path / "fit").iterdir()} == before


def test_a_parameter_without_a_positive_variance_has_an_infinite_standard_error():
    """The inverse of a nearly singular matrix is rounded below zero: its second parameter has no information."""
    errors = standard_errors(np.diag([4.0, -1e-20]), np.diag([4.0, 0]))
    np.testing.assert_array_equal(errors, [0.5, np.inf])


def test_standard_errors_of_a_path_fit_are_those_of_the_flights_not_of_the_prior():
    """A parameter without effect had a standard error of 1, its prior's, and was called identifiable."""
    noise = np.repeat(np.random.default_rng(4).normal(size=500), 5)  # 500 values, not 2500
    _, errors = _least_squares(lambda x: (x[0] - 2) + noise + 0 * x[1], 2, np.inf)
    assert errors[1] > 10
    assert errors[0] == pytest.approx(500**-0.5, rel=0.05)


def test_residuals_that_repeat_increase_the_standard_error():
    """If each value comes three times, the mean of n values has the variance of n / 3; here less a tapered share."""
    values = np.repeat(np.random.default_rng(0).normal(size=(20000, 1)), 3, axis=0)
    information = np.array([[float(len(values))]])
    expected = 1 + 2 * (4 / 5 * 2 / 3 + 3 / 5 * 1 / 3)
    error = standard_errors(information, np.asarray(spread(values, 4)))
    np.testing.assert_allclose(error**2 * len(values), expected, rtol=0.03)
    np.testing.assert_allclose(standard_errors(information, 0 * information) ** 2 * len(values), 1)


def test_the_errors_of_a_fit_have_the_spread_of_its_gradient(problem_of):
    """The gradients of two flights are independent, and four times their variance doubles the standard errors."""
    names, scales = ("drag_coeff_x", "trim_torque_x"), [np.full((3, 4), 0.1)] * 2
    one, two = (problem_of(n, names).normal(np.array([0.2, *[-0.3] * n]), scales[:n]) for n in (1, 2))
    assert two.spread[0, 0] == pytest.approx(2 * one.spread[0, 0]) and one.spread[0, 0] > 0
    problem, information = problem_of(1, names), one.matrix - 0.999 * np.diag([0.01, 0.01])
    normals = (one._replace(spread=k * information) for k in (0, 4))
    first, second = (problem._report(np.zeros(2), normal, (), (), False).parameters for normal in normals)
    for name in names:
        assert second[name].std_error == pytest.approx(2 * first[name].std_error)


@pytest.mark.parametrize("text", ["a---b", "--", "ends with -", "-->", 'quo"te & <tag>', "bell \x07 \x00"])
def test_any_name_and_comment_make_a_sound_urdf(text):
    params = jaxdrones.load_params("cf2x")
    np.testing.assert_allclose(parse_params("x.urdf", to_urdf(params, text, text)).kf, params.kf, rtol=1e-6)


def test_what_cannot_be_fitted_is_named(flown):
    params, log = flown
    with pytest.raises(ValueError, match="no flights"):
        fit([], params)
    with pytest.raises(ValueError, match=r"unknown parameter 'color'"):
        fit([log], params, ("color",))
    with pytest.raises(ValueError, match="one after the other"):
        fit([log, *load_flights(NANOBENCH)], params)


@pytest.mark.parametrize("vehicle", ["cf2x", "hb"])
def test_a_written_vehicle_is_read_as_it_was(vehicle):
    params = jaxdrones.load_params(vehicle)
    read = parse_params("written.urdf", to_urdf(params, vehicle))
    for name, value in vars(params).items():
        if name != "aux":
            np.testing.assert_allclose(getattr(read, name), value, rtol=1e-6, err_msg=name)


@pytest.mark.slow
def test_a_recorded_flight_is_simulated_in_closed_loop(capsys, tmp_path):
    """The nominal Crazyflie stays within 8 cm of the real one in the plane, and needs less thrust than it."""
    figure = tmp_path / "paths.png"
    assert main(["score", NANOBENCH, "--vehicle", "cf2x", "--json", "--figure", str(figure)]) == 0
    results = json.loads(capsys.readouterr().out)
    assert set(results["open_loop"]) == {"hold", "nominal", "vehicle"}
    assert set(results["open_loop"]["vehicle"]) == {"10", "25", "50"}
    assert results["open_loop"]["vehicle"] == results["open_loop"]["nominal"]
    (flight,) = results["closed_loop"]
    assert flight["xy_rms_m"] < 0.08
    assert flight["pwm_sim"] < 0.9 * flight["pwm_real"]
    assert abs(flight["tracking_sim_m"] / flight["tracking_real_m"] - 1) < 0.12
    assert figure.stat().st_size > 1e4
    assert main(["score", NANOBENCH, "--vehicle", "cf2x", "--nominal", "hb"]) == 0
    named = {line.split("  ")[0] for line in capsys.readouterr().out.splitlines()}
    assert named == {"vehicle", "hold", "hb (nominal)", "cf2x"}


@pytest.mark.slow
def test_a_fitted_crazyflie_needs_the_thrust_of_the_real_one(capsys, tmp_path):
    assert main(["fit", NANOBENCH, "--output", str(tmp_path / "fit")]) == 0
    assert "unfelt_sag" in capsys.readouterr().out
    assert main(["score", NANOBENCH, "--vehicle", str(tmp_path / "fit"), "--json"]) == 0
    results = json.loads(capsys.readouterr().out)
    (flight,), (nominal,) = results["closed_loop"], results["closed_loop_nominal"]
    assert abs(flight["pwm_sim"] / flight["pwm_real"] - 1) < 0.015
    assert flight["xy_rms_m"] < nominal["xy_rms_m"]


def test_a_parameter_of_which_there_is_nothing_to_multiply_is_refused():
    params = jaxdrones.load_params("cf2x")
    check_guess(Vehicle.of(params), ["rotor_lag", "km", "drag_coeff_x"])
    still = params.replace(rotor_rise_time=jnp.zeros(()), drag_coeff=jnp.zeros(3))
    with pytest.raises(ValueError, match=r"the vehicle has a rotor_lag of 0, .* with a first guess"):
        check_guess(Vehicle.of(still), ["drag_coeff_x", "rotor_lag"])
    with pytest.raises(ValueError, match=r"the vehicle has a rotor_lag of 0, .* with a first guess"):
        fit(load_flights(NANOBENCH), still)

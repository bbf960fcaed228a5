"""Flights with Betaflight itself; `make betaflight` builds it."""

import dataclasses
import os
import signal

import numpy as np
import pytest

from jaxdrones import rotation
from jaxdrones.errors import UserError
from jaxdrones.firmware.betaflight import BetaflightLost, Flight, Flip, Hover, Link, Process, Simulation, find_program
from jaxdrones.firmware.drone import Recorder, Sample

try:
    PROGRAM = find_program()
    MISSING = ""
except UserError as error:
    PROGRAM, MISSING = None, str(error)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.float32,
    pytest.mark.xdist_group("betaflight"),  # its ports are fixed
    pytest.mark.skipif(PROGRAM is None, reason=MISSING),
]
TARGET = np.array([0.0, 0.0, 1.5])
TAKE_OFF = 4.0  # s


@dataclasses.dataclass
class Trial:
    """Flight of a racer and its rows since arming."""

    flight: Flight
    rows: list
    warnings: list

    @property
    def t(self):
        return np.array([row[0] for row in self.rows]) - self.rows[0][0]

    @property
    def error(self):
        return np.linalg.norm(np.array([row[1] for row in self.rows]) - TARGET, axis=1)


@pytest.fixture
def link():
    with Link() as link:
        yield link


def fly(link, seconds, pilot=lambda hover: hover, act=lambda t, process: None, **options):
    simulation, rows, warnings = Simulation("racer"), [], []
    hover = Hover(simulation.params, tuple(TARGET))
    hover(0.0, simulation.sample)

    def on_row(t, sample, sticks):
        if sticks.armed and flight.flown.armed_s:
            rows.append((t, sample.pos, sample.quat, sample.omega))
            act(t - rows[0][0], process)

    with Process(PROGRAM) as process:
        flight = Flight(
            simulation, link, pilot(hover), process=process, on_row=on_row, warn=warnings.append, wait=120, **options
        )
        flight.run(seconds)
    return Trial(flight, rows, warnings)


def test_a_racer_hovers_within_20_cm_for_30_s(link):
    trial = fly(link, TAKE_OFF + 30)
    assert trial.error[trial.t > TAKE_OFF].max() < 0.2, trial.flight.flown
    assert trial.flight.flown.armed_s == pytest.approx(TAKE_OFF + 30, abs=0.01)
    assert trial.flight.flown.lost == 0 and trial.flight.flown.motors >= trial.flight.flown.armed_s * 1000


def test_a_racer_hovers_by_the_clock(link):
    trial = fly(link, TAKE_OFF + 10, lockstep=False)
    if trial.flight.flown.late:
        pytest.skip(f"this computer is too busy for real time: {trial.flight.flown}")
    assert trial.error[trial.t > TAKE_OFF].max() < 0.2
    assert trial.flight.flown.real_time_factor > 0.99


def test_a_racer_flips_in_acro_and_hovers_again(link):
    simulation_params = Simulation("racer").params
    trial = fly(link, 12, pilot=lambda hover: Flip(simulation_params, hover, at=TAKE_OFF))
    roll_rate = np.array([row[3][0] for row in trial.rows])
    turned = np.cumsum(roll_rate) * 0.01
    assert turned[-1] == pytest.approx(2 * np.pi, abs=0.15)
    up = np.array([rotation.to_matrix(row[2])[2, 2] for row in trial.rows[::2]])
    assert up.min() < -0.9 and up[-50:].min() > 0.99
    assert trial.error[trial.t > 10].max() < 0.5  # m; 0.02 on idle cores, 0.25 on busy ones


class Lossy(Link):
    """Link that loses a tenth of all packets, and gets datagrams that are no packets."""

    def __init__(self):
        super().__init__()
        self._rng, self.lost = np.random.default_rng(0), 0

    def _keeps(self):
        kept = self._rng.random() > 0.1
        self.lost += not kept
        return kept

    def send_state(self, packet):
        if self._keeps():
            super().send_state(packet)
        if self._rng.random() < 0.01:
            super().send_state(packet[:-8])
            self._sender.sendto(b"noise", self._motors.getsockname())

    def send_sticks(self, packet):
        if self._keeps():
            super().send_sticks(packet)

    def outputs(self, wait=0.0):
        return [outputs for outputs in super().outputs(wait) if self._keeps()]


def test_a_racer_hovers_while_a_tenth_of_all_packets_is_lost():
    with Lossy() as link:
        trial = fly(link, TAKE_OFF + 10)
        assert link.lost > 0.05 * trial.flight.flown.states
    assert trial.error[trial.t > TAKE_OFF].max() < 0.2
    assert trial.flight.flown.lost == 0


def test_after_a_restart_betaflight_is_armed_again_and_the_racer_hovers(link):
    killed = []

    def kill(t, process):
        if t > TAKE_OFF and not killed:
            killed.append(t)
            os.kill(process.pid, signal.SIGKILL)

    trial = fly(link, TAKE_OFF + 12, act=kill)
    assert trial.flight.flown.lost == 1 and killed
    assert any("sent no motor outputs" in text for text in trial.warnings)
    assert any("it is restarted" in text for text in trial.warnings)
    assert trial.error[-200:].max() < 0.2


def test_a_betaflight_that_never_comes_is_reported(link):
    simulation = Simulation("racer")
    flight = Flight(simulation, link, Hover(simulation.params), wait=0.3)
    with pytest.raises(BetaflightLost, match=r"was not armed within 0\.3 s: its MSP port does not answer"):
        flight.run(1.0)


def test_a_second_simulator_is_refused(link):
    with pytest.raises(UserError, match="port 9001 of the motors cannot be opened: Address already in use"):
        Link()


def test_a_recorded_flight_is_a_log():
    recorder, params = Recorder(), Simulation("racer").params
    for k in range(3):
        zero = np.zeros(3)
        recorder.add(0.01 * k, Sample(np.array([0, 0, k]), np.eye(4)[3], zero, zero, np.ones(4), zero), TARGET)
    log = recorder.log(params, {"vehicle": "racer"}, "a flight")
    assert log.pos.shape == (3, 1, 3) and log.has("target_pos", "rpm") and str(log.conditions) == "a flight"
    np.testing.assert_allclose(log.error[:, 0, 0], [1.5, 0.5, 0.5])

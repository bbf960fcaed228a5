"""Flight of a simulated drone with Betaflight in the loop, in lockstep or in real time."""

import contextlib
import dataclasses
import time
from collections.abc import Callable

import numpy as np

from jaxdrones.firmware.betaflight import msp, settings
from jaxdrones.firmware.betaflight.link import Link, connect_msp
from jaxdrones.firmware.betaflight.packets import Sticks, rc_packet
from jaxdrones.firmware.betaflight.pilots import PERIOD, Pilot
from jaxdrones.firmware.betaflight.process import Process
from jaxdrones.firmware.betaflight.simulation import Simulation
from jaxdrones.firmware.drone import LATE, Pace, Sample

_SILENT, _SILENT_IN_LOCKSTEP = 0.5, 3.0  # s of real time without motors after which Betaflight is lost
_REPLY = 0.01  # s for the motors of a step in lockstep, after which the state is sent again
_BOOT = 1.0  # s after its port of MSP opens, until it takes settings
_FIRST = 5  # packets with the first time: Betaflight's clock takes its pace from two times that differ
_STUCK = 1.5  # s after which a loop that does not run is started again; about one start in ten ends so
_UPRIGHT = 0.9  # cosine of the tilt above which Betaflight arms
_NOT_ARMED = "arm switch"  # reason that follows from the others


class BetaflightLost(Exception):
    """Failure of Betaflight to start, arm or recover."""


@dataclasses.dataclass
class Flown(Pace):
    """Statistics of a flight."""

    armed_s: float = 0.0
    """Simulated time with motors armed."""
    states: int = 0
    motors: int = 0
    """Packets of the motors."""
    repeated: int = 0
    """States in lockstep that were sent again, because no motor outputs arrived within 10 ms."""
    lost: int = 0
    """Number of times that Betaflight was silent for 0.5 s, or 3 s in lockstep."""


class Flight:
    """Loop: physics, state to Betaflight, sticks of the pilot, motors from Betaflight."""

    def __init__(
        self,
        simulation: Simulation,
        link: Link,
        pilot: Pilot,
        *,
        process: Process | None = None,
        lockstep: bool = True,
        wait: float = 30.0,
        on_row: Callable[[float, Sample, Sticks], None] = lambda t, sample, sticks: None,
        warn: Callable[[str], None] = lambda text: None,
    ):
        """Prepare a flight.

        Args:
            simulation: drone on the ground.
            link: to Betaflight.
            pilot: function for the sticks, called 100 times per second of simulated time once Betaflight is armed.
            process: of Betaflight, restarted if it ends; `None` for a program that this object does not control.
            lockstep: whether each step waits for motor outputs and resends its state until they arrive; without it
                a flight needs two idle cores. A flight is never faster than the clock.
            wait: longest time until Betaflight is armed, at the start and after a loss of connection, s.
            on_row: called with time (s), sample and sticks 100 times a second.
            warn: function of a line of text for warnings.
        """
        self._simulation, self._link, self._pilot, self._process = simulation, link, pilot, process
        self._lockstep, self._wait, self._on_row, self._warn = lockstep, wait, on_row, warn
        self._silent = _SILENT_IN_LOCKSTEP if lockstep else _SILENT
        self.flown = Flown()
        self._outputs = np.zeros(4)
        self._sticks = Sticks()
        self._armed_at: float | None = None
        self._booted = False  # packets are sent from then on; see _BOOT
        self._per_stick = max(round(PERIOD / simulation.dt), 1)
        self._begin = self._due = self._heard = self._last = time.monotonic()

    def run(self, duration: float | None = None) -> Flown:
        """Arm and fly for a time with motors armed (s), by default until it is interrupted; then disarm."""
        self._begin = self._due = self._heard = self._last = time.monotonic()
        try:
            while duration is None or self.flown.armed_s < duration - 1e-9:
                if self._armed_at is None:
                    self._arm()
                self._step()
                if time.monotonic() - self._heard > self._silent:
                    self._lose()
        finally:
            self._armed_at, self._sticks = None, Sticks()
            self._link.send_sticks(rc_packet(self._simulation.time, self._sticks))
        return self.flown

    def _lose(self) -> None:
        """Stop the motors after a loss of connection; Betaflight must be armed again."""
        self.flown.lost += 1
        self._warn(f"Betaflight sent no motor outputs for {self._silent:g} s; the motors stop")
        self._armed_at, self._sticks, self._outputs, self._booted = None, Sticks(), np.zeros(4), False

    def _arm(self) -> None:
        """Wait for Betaflight, configure it, and arm it; the simulation continues."""
        end, why = time.monotonic() + self._wait, "its MSP port does not answer"
        while time.monotonic() < end:
            if self._process is not None and self._process.ended:
                self._warn(f"Betaflight has ended ({self._process.last_words}); it is restarted")
                self._process.restart()
            connection = connect_msp()
            if connection is None:
                self._run_for(0.05)
                continue
            with contextlib.closing(connection):
                try:
                    why = self._arm_by(msp.Client(connection, self._step), end)
                except msp.NoAnswer as error:
                    why = str(error)
            if not why:
                return
            self._booted = False
            self._run_for(0.2)
        raise BetaflightLost(f"Betaflight was not armed within {self._wait:g} s: {why}")

    def _arm_by(self, client: msp.Client, end: float) -> str:
        """Configure and arm until the time `end`; return the reason for a failure, or an empty string."""
        self._run_for(_BOOT)
        for _ in range(_FIRST):  # disarms a Betaflight whose simulator was killed, which takes no settings while armed
            self._link.send_sticks(rc_packet(self._simulation.time, Sticks()))
            self._run_for(0.02)
        plant = self._simulation
        again = settings.configure(client, plant.params, 1 / plant.dt, reversed_yaw=plant.reversed_yaw)
        if again and self._process is not None:
            self._process.restart()
            return "it is restarting with new settings"
        if again:
            self._warn("the running Betaflight keeps its old loop rate until you restart it")
        first = plant.packet()
        for _ in range(_FIRST):  # with one time: the pace of Betaflight's clock begins afterwards
            self._link.send_state(first)
            time.sleep(0.001)
        self._booted, why = True, ""
        ran = time.monotonic()
        while time.monotonic() < end:
            now = settings.parse_status(client.request(msp.STATUS))
            ran = time.monotonic() if now.cycle else ran
            if time.monotonic() > ran + _STUCK:
                if self._process is not None:
                    self._warn("Betaflight's loop does not run; it is restarted")
                    self._process.restart()
                return "its loop does not run; restart it"
            reasons = [reason for reason in now.reasons if reason != _NOT_ARMED]
            why = f"it reports {', '.join(reasons) or 'nothing'}"
            x, y = self._simulation.sample.quat[:2]
            if 1 - 2 * (x * x + y * y) < _UPRIGHT and self.flown.lost:
                self._warn("the drone is set upright")
                self._simulation.set_upright()
            if now.armed and self._sticks.armed:
                self._armed_at, self._heard = self._simulation.time, time.monotonic()
                return ""
            self._sticks = Sticks(armed=not reasons)
            self._run_for(0.05)
        self._sticks = Sticks()
        return why

    def _run_for(self, seconds: float) -> None:
        """Take steps for a real time (s)."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._step()

    def _step(self) -> None:
        """One step: motors, physics, state, sticks."""
        simulation = self._simulation
        sample = simulation.advance(self._outputs)
        t = simulation.time
        packet = simulation.packet()
        if self._lockstep:
            self._link.outputs()  # drops late answers to the last state
        if self._booted:
            self._link.send_state(packet)
            self.flown.states += 1
        if simulation.steps % self._per_stick == 0:
            if self._armed_at is not None:
                self._sticks = self._pilot(t - self._armed_at, sample)._replace(armed=True)
            if self._booted:
                self._link.send_sticks(rc_packet(t, self._sticks))
            self._on_row(t, sample, self._sticks)
        self._receive(packet)
        self._pace()
        self.flown.armed_s += simulation.dt if self._armed_at is not None else 0.0
        self.flown.simulated_s += simulation.dt
        self.flown.real_s = time.monotonic() - self._begin

    def _receive(self, packet: bytes) -> None:
        """Receive motor outputs; in lockstep, resend the state until they arrive or Betaflight is lost."""
        waits = self._lockstep and self._booted
        found = self._link.outputs(_REPLY if waits else 0.0)
        while waits and not found and time.monotonic() - self._heard < self._silent:
            self._link.send_state(packet)
            self.flown.repeated += 1
            found = self._link.outputs(_REPLY)
        if found:
            self._outputs, self._heard = found[-1], time.monotonic()
        self.flown.motors += len(found)

    def _pace(self) -> None:
        """Wait for the clock; the interval between steps that make up for a late one is at least half of a step."""
        dt, now = self._simulation.dt, time.monotonic()
        self._due += dt
        if now > self._due + LATE:
            self.flown.late += not self._lockstep
            self._due = now
        time.sleep(max(self._due - now, self._last + dt / 2 - now, 0.0))
        self._last = time.monotonic()

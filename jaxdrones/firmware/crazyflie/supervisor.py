"""Supervisor: arming, tumbling and emergency stops."""

import dataclasses

from jaxdrones.firmware.crazyflie.vehicle import Sample

_CAN_BE_ARMED, _ARMED, _AUTO_ARMED, _CAN_FLY, _FLYING, _TUMBLED, _LOCKED, _CRASHED, _PLANNED, _FINISHED = range(10)
_INFO, _COMMAND = 0, 1
_STATE, _ARM, _RECOVER, _STOP, _STOP_WATCHDOG = 12, 1, 2, 3, 4
_ANSWER = 0x80
_TUMBLED_AFTER = 1.0  # s upside down
_WATCHDOG = 1.0  # s
_TURNING = 1000.0  # 16 bit, thrust above which the vehicle counts as flying


@dataclasses.dataclass
class Supervisor:
    """State of the vehicle that decides whether its motors may turn."""

    armed: bool = True
    """Whether the motors are armed; true at the start, as for a vehicle with brushed motors."""
    locked: bool = False
    """Whether the motors are locked: after an emergency stop, until the simulation is restarted."""
    tumbled: bool = False
    recovery_asked: bool = False
    """Whether the vehicle is to be set upright."""
    _upside_down: float = 0.0
    _watchdog: float | None = None

    @property
    def can_fly(self) -> bool:
        """Whether the motors may turn."""
        return self.armed and not (self.locked or self.tumbled)

    def watch(self, sample: Sample, t: float, dt: float) -> None:
        """Update from the state of the vehicle at time t (s), dt (s) after the last call."""
        x, y = sample.quat[:2]
        self._upside_down = self._upside_down + dt if 2 * (x * x + y * y) > 1 else 0.0
        self.tumbled |= self._upside_down > _TUMBLED_AFTER
        self.locked |= self._watchdog is not None and t > self._watchdog

    def status(self, sample: Sample, planned: bool, finished: bool) -> int:
        """State bits; `planned`: the high-level commander flies, `finished`: its trajectory has ended."""
        bits = {
            _CAN_BE_ARMED: not (self.locked or self.tumbled),
            _ARMED: self.armed,
            _AUTO_ARMED: True,
            _CAN_FLY: self.can_fly,
            _FLYING: bool(sample.motors.max() > _TURNING),
            _TUMBLED: self.tumbled,
            _LOCKED: self.locked,
            _CRASHED: self.tumbled,
            _PLANNED: planned,
            _FINISHED: finished,
        }
        return sum(1 << bit for bit, on in bits.items() if on)

    def answer(self, channel: int, data: bytes, t: float, status: int) -> bytes:
        """Answer to a packet at time t (s); empty for an invalid one."""
        command = data[0] if data else -1
        if channel == _INFO and command == _STATE:
            return bytes([_STATE | _ANSWER]) + status.to_bytes(2, "little")
        if channel != _COMMAND:
            return b""
        if command == _ARM and len(data) == 2:
            accepted = not data[1] or not (self.locked or self.tumbled)
            self.armed = bool(data[1]) if accepted else self.armed
            return bytes([_ARM | _ANSWER, accepted, self.armed])
        if command == _RECOVER:
            self.recovery_asked, self.tumbled, self._upside_down = self.tumbled, False, 0.0
            return bytes([_RECOVER | _ANSWER, True, not self.locked])
        if command in (_STOP, _STOP_WATCHDOG):
            self.emergency(command == _STOP_WATCHDOG, t)
            return bytes([command | _ANSWER, True])
        return b""

    def emergency(self, watchdog: bool, t: float) -> None:
        """Stop and lock the motors: now, or with `watchdog` unless the call is repeated within a second."""
        if watchdog:
            self._watchdog = t + _WATCHDOG
        else:
            self.locked = True

"""Conditions of a flight: kind, vehicle, physics and controller."""

import dataclasses
import math
import os
import re
from typing import Annotated

from jaxdrones import arguments, control, optimal
from jaxdrones.arguments import Count, Seconds, Switch, checked, choice, choices, whole
from jaxdrones.checks import hint
from jaxdrones.control import pid
from jaxdrones.dynamics import EFFECTS, INTEGRATORS, PAIRS, ROTORS
from jaxdrones.errors import UserError
from jaxdrones.flights.examples import FLIGHTS
from jaxdrones.limits import check_memory
from jaxdrones.user_code import is_reference

BACKENDS = ("explicit", "bullet")
CONTROLLERS = (*control.CONTROLLERS, *optimal.CONTROLLERS)
PHYSICS_HZ = 240  # lowest rate; rounded up to a multiple of the control rate

_FIRMWARE_HZ = 500  # of the inner loops of the firmware's controllers

_MAX_HZ = 20_000  # above it a step of 1 mm/s is below the rounding of a float32 position of 1 m
_MAX_DURATION = 1e5  # s; beyond, the resolution of float32 times is coarser than control steps at 120 Hz
_LOG_BYTES = 400  # per drone and control step: trajectory, log, figure
_PAIR_BYTES = 32  # per pair of drones, while the effects between them are summed


def _check_controller(argument: str, name: str) -> None:
    if is_reference(name):
        if not name.endswith(".py"):
            raise UserError(f"controller is {name!r}; give the whole file, {name.partition(':')[0]!r}")
    elif name not in CONTROLLERS:
        known = ", ".join(CONTROLLERS)
        raise UserError(f"unknown controller {name!r}{hint(name, CONTROLLERS)} (known: {known}, or a .py file)")


@checked
@dataclasses.dataclass(frozen=True)
class Conditions:
    """Options of a flight; `None` is replaced by the default of the flight."""

    flight: Annotated[str, choice("flight", FLIGHTS)]
    """`circle`, `velocity`, `ground-effect` or `downwash`."""
    vehicle: str | os.PathLike = "cf2x"
    """A bundled vehicle or the path of a URDF."""
    drones: Count | None = None
    effects: Annotated[tuple[str, ...] | None, choices("effect", EFFECTS | PAIRS, "'drag'")] = None
    """Names of `EFFECTS` and `PAIRS`."""
    controller: Annotated[str | None, _check_controller] = None
    """A name of `CONTROLLERS`, or the path of a file with `gains`, `init` and `control`; by default the vehicle's."""
    feedforward: Switch | None = None
    """Whether the controller receives velocity and acceleration of the target beside position and heading. By default
    all but `pid` do: the examples of gym-pybullet-drones (2021) command positions alone."""
    control_hz: Annotated[int | None, whole("control rate (Hz)", limit=_MAX_HZ)] = None
    duration: Seconds | None = None
    """Duration of the flight, s."""
    rotors: Annotated[str, choice("rotors", ROTORS)] = "instant"
    """`instant` or `lagging`."""
    integrator: Annotated[str, choice("integrator", INTEGRATORS)] = "semi_implicit_euler"
    """A name of `INTEGRATORS`; Bullet has its own."""
    backend: Annotated[str, choice("backend", BACKENDS)] = "explicit"
    """`explicit` or `bullet`."""
    obstacles: bool = False
    """Whether to add the obstacles of gym-pybullet-drones (2021), in Bullet only."""
    seed: Annotated[int | None, arguments.seed] = None
    """Seed of a random displacement of the start, 1 cm standard deviation; by default none."""

    def __post_init__(self):
        flight = FLIGHTS[self.flight]
        default = {name: getattr(flight, name) for name in ("drones", "effects", "control_hz", "duration")}
        default["controller"] = "pid" if self.flight == "velocity" or self.vehicle in pid.VEHICLES else "geometric"
        if self.controller in ("firmware_pid", "mellinger"):
            default["control_hz"] = _FIRMWARE_HZ
        default["feedforward"] = (self.controller or default["controller"]) != "pid"
        for name, value in default.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)
        object.__setattr__(self, "effects", tuple(self.effects))
        object.__setattr__(self, "vehicle", str(self.vehicle))
        if self.duration > _MAX_DURATION:
            raise UserError(f"duration is {self.duration} s; give at most {_MAX_DURATION:g} s")
        seen = {}
        for effect in self.effects:
            kind = re.sub("(_2021|_world_axes)$", "", effect)  # other models of the same effect
            if kind in seen:
                both = "twice" if seen[kind] == effect else f"beside {seen[kind]!r}, another model of the same effect"
                raise UserError(f"effect {effect!r} is given {both}; give one of them, once")
            seen[kind] = effect
        if flight.labels and self.drones != len(flight.labels):
            who = ", ".join(flight.labels)
            raise UserError(f"drones is {self.drones}; the {self.flight} flight takes {flight.drones}: {who}")
        if self.flight == "velocity" and self.controller != "pid":
            raise UserError(f"controller is {self.controller!r}; the velocity flight is flown by 'pid'")
        if self.flight == "velocity" and self.feedforward:
            raise UserError("feedforward is given; the velocity flight commands velocities, leave it out")
        if self.steps == 0:
            raise UserError(
                f"duration is {self.duration} s, less than half a control period; give {self.dt:.4g} s or more"
            )
        size = self.drones * self.steps * _LOG_BYTES
        if any(effect in PAIRS for effect in self.effects):
            size += self.drones**2 * _PAIR_BYTES
        check_memory(
            f"a flight of {str(self.drones)[:30]} drones for {self.duration:g} s at {self.control_hz} Hz",
            size,
            "give fewer drones, a shorter duration or a lower control rate",
        )
        if self.backend == "bullet" and self.integrator != "semi_implicit_euler":
            raise UserError(f"integrator is {self.integrator!r}; the bullet backend integrates by itself, leave it out")
        if self.obstacles and self.backend != "bullet":
            raise UserError("obstacles are given; the explicit backend ignores them, use the bullet backend")

    @property
    def dt(self) -> float:
        """Control period, s."""
        return 1 / self.control_hz

    @property
    def steps(self) -> int:
        """Control steps of the flight."""
        return round(self.duration * self.control_hz)

    @property
    def substeps(self) -> int:
        """Physics steps per control step."""
        return math.ceil(PHYSICS_HZ / self.control_hz)

    @property
    def physics_hz(self) -> int:
        """Physics steps per second."""
        return self.control_hz * self.substeps

    def as_dict(self) -> dict[str, object]:
        """The conditions as entries of a JSON object."""
        return dataclasses.asdict(self) | {"physics_hz": self.physics_hz}

    def __str__(self) -> str:
        integrator = "Bullet" if self.backend == "bullet" else self.integrator
        controller = f"{self.controller} with feedforward" if self.feedforward else self.controller
        return (
            f"{self.flight}: {self.drones} x {self.vehicle}, {controller} at {self.control_hz} Hz, "
            f"{integrator} at {self.physics_hz} Hz, {self.rotors} rotors, "
            f"effects: {', '.join(self.effects) or 'none'}, {self.steps * self.dt:g} s"
        )

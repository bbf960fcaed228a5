"""Betaflight in the loop: its own program flies a simulated drone."""

from jaxdrones.firmware.betaflight.flight import BetaflightLost, Flight, Flown
from jaxdrones.firmware.betaflight.link import Link
from jaxdrones.firmware.betaflight.packets import Sticks
from jaxdrones.firmware.betaflight.pilots import Flip, Hover, Pilot, TakeOff, sticks_for
from jaxdrones.firmware.betaflight.process import Process, find_program
from jaxdrones.firmware.betaflight.simulation import Simulation

__all__ = ["BetaflightLost", "Flight", "Flown", "Link", "Process", "Simulation", "find_program"]
__all__ += ["Flip", "Hover", "Pilot", "Sticks", "TakeOff", "sticks_for"]

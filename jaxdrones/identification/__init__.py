"""Recorded flights: how well a vehicle repeats them, and which vehicle repeats them best."""

from jaxdrones.identification.closed_loop import Twin, fly_again
from jaxdrones.identification.fit import Estimate, Report, fit
from jaxdrones.identification.instruments import Instruments
from jaxdrones.identification.log import FlightLog
from jaxdrones.identification.open_loop import HORIZONS, QUANTITIES, held_errors, open_loop_errors
from jaxdrones.identification.parameters import PARAMETERS
from jaxdrones.identification.vehicle import Vehicle

__all__ = [
    "HORIZONS",
    "PARAMETERS",
    "QUANTITIES",
    "Estimate",
    "FlightLog",
    "Instruments",
    "Report",
    "Twin",
    "Vehicle",
    "fit",
    "fly_again",
    "held_errors",
    "open_loop_errors",
]

"""System identification: compares a vehicle with recorded flights, and estimates its parameters from them."""

from jaxdrones.identification.closed_loop import ClosedLoopResult, simulate_closed_loop
from jaxdrones.identification.fit import Estimate, Report, fit
from jaxdrones.identification.instruments import Instruments
from jaxdrones.identification.log import FlightLog
from jaxdrones.identification.open_loop import HORIZONS, QUANTITIES, hold_errors, open_loop_errors
from jaxdrones.identification.parameters import PARAMETERS
from jaxdrones.identification.vehicle import Vehicle

__all__ = [
    "HORIZONS",
    "PARAMETERS",
    "QUANTITIES",
    "ClosedLoopResult",
    "Estimate",
    "FlightLog",
    "Instruments",
    "Report",
    "Vehicle",
    "fit",
    "hold_errors",
    "open_loop_errors",
    "simulate_closed_loop",
]

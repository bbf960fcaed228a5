"""Demonstration flights, logs, and identification of vehicles from logs."""

from jaxdrones.flights.closed_loop import ClosedLoopResult, simulate_closed_loop
from jaxdrones.flights.files import read_log, save_csv, save_npz
from jaxdrones.flights.fit import Estimate, Report, fit
from jaxdrones.flights.log import FlightLog, ImageSequence, LoggedConditions
from jaxdrones.flights.open_loop import HORIZONS, QUANTITIES, hold_errors, open_loop_errors
from jaxdrones.flights.parameters import PARAMETERS
from jaxdrones.flights.preparation import inconsistencies, load_flights, prepare
from jaxdrones.flights.report import errors_as_dict
from jaxdrones.flights.vehicle import Instruments, Vehicle, load_vehicle

__all__ = ["FlightLog", "ImageSequence", "LoggedConditions", "inconsistencies", "load_flights", "prepare"]
__all__ += ["read_log", "save_csv", "save_npz"]
__all__ += ["PARAMETERS", "Estimate", "Instruments", "Report", "Vehicle", "fit", "load_vehicle"]
__all__ += ["HORIZONS", "QUANTITIES", "ClosedLoopResult", "errors_as_dict"]
__all__ += ["hold_errors", "open_loop_errors", "simulate_closed_loop"]

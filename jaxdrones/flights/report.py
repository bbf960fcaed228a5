"""Report of a fit: `vehicle.urdf` and `report.json`."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from jaxdrones.errors import UserError
from jaxdrones.flights.fit import Report
from jaxdrones.flights.open_loop import HORIZONS, QUANTITIES
from jaxdrones.flights.vehicle import REPORT, URDF
from jaxdrones.urdf_writer import to_urdf
from jaxdrones.writing import as_json, write


def write_vehicle(folder: Path, report: Report, started_from: str) -> None:
    """Write `vehicle.urdf` and `report.json` into a new or empty folder."""
    check_no_fit(folder)
    folder.mkdir(parents=True, exist_ok=True)
    flights = ", ".join(report.per_flight) or "flights"
    comment = (
        f"Identified by `jaxdrones fit` from {started_from} and {flights}.\n     {REPORT} has the standard errors."
    )
    write(folder / URDF, to_urdf(report.vehicle.params, "identified", comment).encode())
    content = as_json(report_as_dict(report) | {"started_from": started_from}, indent=1)
    write(folder / REPORT, (content + "\n").encode())


def check_no_fit(folder: Path) -> None:
    """Raise `ValueError` for a folder with the files of a fit."""
    for file in (folder / URDF, folder / REPORT):
        if file.exists():
            raise UserError(f"{file} exists already; remove it, or give another --output")


def report_as_dict(report: Report) -> dict[str, Any]:
    """Result of a fit for JSON, in SI units."""
    instruments = report.vehicle.instruments
    return {
        "parameters": {name: dataclasses.asdict(estimate) for name, estimate in report.parameters.items()},
        "instruments": {name: np.asarray(getattr(instruments, name), float).tolist() for name in vars(instruments)},
        "per_flight": report.per_flight,
        "losses": list(report.losses),
        "errors": {flight: errors_as_dict(errors) for flight, errors in report.errors.items()},
    }


def errors_as_dict(errors: np.ndarray) -> dict[str, dict[str, float]]:
    """Open-loop errors (horizons, 4) as a dictionary by horizon, in rows of 0.01 s, and by quantity."""
    return {
        str(h): dict(zip(QUANTITIES, map(float, row), strict=True)) for h, row in zip(HORIZONS, errors, strict=True)
    }

"""The recorded cases in `tests/golden`; set JAXDRONES_GOLDEN to a folder with others to run those.

A case is two files, arrays (.npz) and a sidecar (.json) that says what was recorded. Tests choose their cases by the
sidecar: the names of the files do not matter.
"""

import json
import os
from collections.abc import Callable, Collection
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

import jaxdrones
from jaxdrones import Params

BUNDLED = Path(__file__).parent / "golden"
FOLDER = Path(os.environ.get("JAXDRONES_GOLDEN", BUNDLED))


class Case(NamedTuple):
    arrays: dict[str, np.ndarray]
    about: dict

    @property
    def constants(self) -> dict:
        return self.about["vehicle_constants"]


def names(*arrays: str, **about: Any) -> list:
    """Names of the cases of a kind, as parameters of a test.

    There is always one in the bundled folder, so that no test passes by being empty; without one in another folder the
    test is skipped and says so.

    Args:
        *arrays: that a case must have.
        **about: what its sidecar must say: a value (`None`: nothing), one of a collection, or a condition on the value.
    """
    found = select(FOLDER, arrays, about)
    if found:
        return found
    reason = f"{FOLDER} has no case with arrays {arrays} and {about}"
    if FOLDER == BUNDLED:
        raise FileNotFoundError(reason)
    return [pytest.param("none", marks=pytest.mark.skip(reason=reason))]


def select(folder: Path, arrays: Collection[str], about: dict[str, Any]) -> list[str]:
    """Names of the cases in a folder that have some arrays and whose sidecar says something."""
    return [
        name
        for name, sidecar in _sidecars(folder).items()
        if sidecar["arrays"].keys() >= set(arrays) and all(_says(sidecar.get(key), x) for key, x in about.items())
    ]


def _says(value: Any, wanted: Any | Collection | Callable[[Any], bool]) -> bool:
    if callable(wanted):
        return value is not None and wanted(value)
    return value in wanted if isinstance(wanted, tuple | list) else value == wanted


@lru_cache
def _sidecars(folder: Path) -> dict[str, dict]:
    return {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))}


def load(name: str) -> Case:
    with np.load(FOLDER / f"{name}.npz") as arrays:
        return Case(dict(arrays), _sidecars(FOLDER)[name])


def recorded_params(case: Case) -> Params:
    """One drone with the rotor positions of the sidecar: those of the engine and of the aerodynamic forces."""
    rotor_pos = jnp.array(case.constants["rotor_positions"])
    return jaxdrones.load_params(case.about["vehicle"]).replace(rotor_pos=rotor_pos)


def explicit_params(case: Case) -> Params:
    """One drone with the rotor positions of the explicit update: the arm over root two on both axes of an x frame.

    The signs are those of the sidecar, in which the paper's cf2x is a mirror image of today's.
    """
    params = recorded_params(case)
    if case.about["vehicle"] in ("cf2p", "hb"):
        return params
    return params.replace(rotor_pos=jnp.sign(params.rotor_pos) * case.constants["arm"] / np.sqrt(2))


def unlimited(params: Params) -> Params:
    """The same with motors without a limit, for rotor speeds as they were recorded."""
    return params.replace(max_rpm=jnp.full_like(params.max_rpm, jnp.inf))


def flown(case: Case, params: Params) -> tuple[Params, np.ndarray]:
    """The drone of a flight and its commands, which our motors clip where gym-pybullet-drones clipped them."""
    if "rpm_cmd" in case.arrays:
        return params, case.arrays["rpm_cmd"]
    return unlimited(params), case.arrays["rpm_applied"]

"""The recorded cases in `tests/golden`; set JAXDRONES_GOLDEN to a folder with more of them to run those."""

import json
import os
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxdrones
from jaxdrones import Params

FOLDER = Path(os.environ.get("JAXDRONES_GOLDEN", Path(__file__).parent / "golden"))


class Case(NamedTuple):
    arrays: dict[str, np.ndarray]
    about: dict

    @property
    def constants(self) -> dict:
        return self.about["vehicle_constants"]


def names(pattern: str) -> list[str]:
    """Names of the cases that match; there is always one, so that no test passes by being empty."""
    found = sorted(path.stem for path in FOLDER.glob(f"{pattern}.npz"))
    if not found:
        raise FileNotFoundError(f"no golden case {pattern} in {FOLDER}")
    return found


def load(name: str) -> Case:
    with np.load(FOLDER / f"{name}.npz") as arrays:
        return Case(dict(arrays), json.loads((FOLDER / f"{name}.json").read_text()))


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

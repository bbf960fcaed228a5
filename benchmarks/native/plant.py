"""Compiles `plant.c` for this machine and calls it."""

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path

import jax
import numpy as np

import jaxdrones as jd

FLAGS = ("-O3", "-march=native", "-ffast-math", "-fopenmp", "-shared", "-fPIC")

_SOURCE = Path(__file__).parent / "plant.c"
ROWS = ("pos", "quat", "vel", "omega", "rpm")


class NoCompilerError(RuntimeError):
    """The limit is a program in C."""


class _Vehicle(ctypes.Structure):
    """`Vehicle` of plant.c."""

    _fields_ = (
        ("mass", ctypes.c_float),
        ("inertia", ctypes.c_float * 3),
        ("rotor_x", ctypes.c_float * 4),
        ("rotor_y", ctypes.c_float * 4),
        ("spin", ctypes.c_float * 4),
        ("kf", ctypes.c_float),
        ("km", ctypes.c_float),
        ("rise_time", ctypes.c_float),
        ("fall_time", ctypes.c_float),
        ("gravity", ctypes.c_float),
        ("drag", ctypes.c_float * 3),
        ("dt", ctypes.c_float),
    )


class Plant:
    """The compiled plant of one vehicle."""

    def __init__(self, params: jd.Params, dt: float):
        self.compiler = compiler()
        self._fly = _compiled(self.compiler).fly
        x, y, _ = np.asarray(params.rotor_pos, np.float32).T
        triple, quadruple = ctypes.c_float * 3, ctypes.c_float * 4
        self._vehicle = _Vehicle(
            mass=params.mass,
            inertia=triple(*params.inertia),
            rotor_x=quadruple(*x),
            rotor_y=quadruple(*y),
            spin=quadruple(*params.rotor_spin),
            kf=params.kf,
            km=params.km,
            rise_time=params.rotor_rise_time,
            fall_time=params.rotor_fall_time,
            gravity=params.gravity,
            drag=triple(*params.drag_coeff),
            dt=dt,
        )

    def fly(self, rows: np.ndarray, command: np.ndarray, steps: int, threads: int) -> np.ndarray:
        """Flies `rows` (17, n) in place with `command` (4, n), float32, and returns it."""
        n = rows.shape[1]
        assert rows.flags.c_contiguous and command.flags.c_contiguous
        assert rows.shape == (17, n) and command.shape == (4, n) and rows.dtype == command.dtype == np.float32
        self._fly(
            ctypes.byref(self._vehicle),
            rows.ctypes.data_as(ctypes.c_void_p),
            command.ctypes.data_as(ctypes.c_void_p),
            ctypes.c_long(n),
            ctypes.c_long(steps),
            ctypes.c_int(threads),
        )
        return rows


def rows_of(states: jd.State) -> np.ndarray:
    """(17, n) of the states of n worlds with one drone each."""
    return np.concatenate([np.asarray(getattr(states, name))[:, 0].T for name in ROWS]).copy()


def states_of(rows: np.ndarray) -> jd.State:
    """The other way."""
    ends = np.cumsum([3, 4, 3, 3])
    return jax.tree.map(lambda x: x.T[:, None], jd.State(*np.split(rows, ends)))


def compiler() -> str:
    """The system's C compiler.

    Raises:
        NoCompilerError: there is none.
    """
    found = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if found is None:
        raise NoCompilerError("no C compiler: found none of cc, gcc, clang; install one, for example `apt install gcc`")
    return found


def _compiled(found: str) -> ctypes.CDLL:
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "plant.so"
        done = subprocess.run([found, *FLAGS, str(_SOURCE), "-o", str(library), "-lm"], capture_output=True, text=True)
        if done.returncode:
            raise NoCompilerError(f"{found} {' '.join(FLAGS)} fails on plant.c:\n{done.stderr}")
        return ctypes.CDLL(str(library))

"""The notebooks run from top to bottom, without PyBullet."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.py"))
CACHE = Path(__file__).parent.parent / ".jax_cache"
WITHOUT_PYBULLET = "import sys, runpy; sys.modules['pybullet'] = None; runpy.run_path(sys.argv[1])"


@pytest.mark.slow
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(notebook):
    environment = os.environ | {"MPLBACKEND": "Agg", "JAX_COMPILATION_CACHE_DIR": str(CACHE)}
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_PYBULLET, str(notebook)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_there_are_notebooks():
    assert len(NOTEBOOKS) >= 5

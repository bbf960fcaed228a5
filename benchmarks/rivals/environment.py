"""Environment with other simulators and jaxdrones, `.venv-rivals`, made once and ignored by git.

The simulators pin their own versions of jax, so they cannot be in the environment of the project.
"""

import json
import os
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

RIVALS = ("torch==2.13.0", "crazyflow==0.4.0", "rotorpy[batched]==3.0.0")

_ROOT = Path(__file__).parents[2]
_FOLDER = _ROOT / ".venv-rivals"


def run(module: str, *arguments: str) -> dict:
    """The JSON object that a module prints in the environment of the rivals."""
    return _run(_python(), module, *arguments)


def run_here(module: str, *arguments: str) -> dict:
    """The same in the environment at hand, which has no rivals."""
    return _run(Path(sys.executable), module, *arguments)


def add(package: str) -> bool:
    """Install a package into the environment of the rivals where it can be; whether it is there now."""
    pip = [str(_python()), "-m", "pip", "install", "--quiet", package]
    return subprocess.run(pip, stdout=sys.stderr, check=False).returncode == 0


def _run(python: Path, module: str, *arguments: str) -> dict:
    command = [str(python), "-m", module, *arguments]
    variables = {"PYTHONPATH": str(_ROOT), "SCIPY_ARRAY_API": "1"}  # crazyflow wants the latter before scipy
    with tempfile.TemporaryDirectory() as folder:  # MuJoCo leaves a log where it runs
        done = subprocess.run(
            command, stdout=subprocess.PIPE, text=True, check=True, cwd=folder, env=os.environ | variables
        )
    return json.loads(done.stdout.splitlines()[-1])


def _python() -> Path:
    """The interpreter; the environment is made where it lacks a rival."""
    python, holds = _FOLDER / "bin" / "python", _FOLDER / "holds.txt"
    wanted = "\n".join(RIVALS)
    if not holds.exists() or holds.read_text() != wanted:
        print(f"making {_FOLDER} with {', '.join(RIVALS)}", file=sys.stderr)
        venv.create(_FOLDER, with_pip=True, clear=True)
        (_FOLDER / ".gitignore").write_text("*\n")
        pip = [str(python), "-m", "pip", "install", "--quiet"]
        torch, *others = RIVALS  # torch first: a later pip does not exchange it for one that needs a GPU
        subprocess.run([*pip, torch], check=True, stdout=sys.stderr)
        subprocess.run([*pip, *others, "--editable", str(_ROOT)], check=True, stdout=sys.stderr)
        holds.write_text(wanted)
    return python

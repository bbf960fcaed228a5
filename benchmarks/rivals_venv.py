"""An environment in which rivals and this library live together: `.venv-rivals`, made once, which git does not see.

Rivals pin their own versions of jax, so the project's environment cannot hold them.
"""

import json
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

RIVALS = ("crazyflow==0.4.0",)

_HERE = Path(__file__).parent
_FOLDER = _HERE.parent / ".venv-rivals"


def run(script: str, *arguments: str) -> dict:
    """What a benchmark prints with `--json` in the environment of the rivals."""
    command = [str(_python()), str(_HERE / script), *arguments, "--json"]
    with tempfile.TemporaryDirectory() as folder:  # MuJoCo leaves a log where it runs
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, cwd=folder)
    return json.loads(done.stdout.splitlines()[-1])


def _python() -> Path:
    """The interpreter; the environment is made where it lacks a rival."""
    python, holds = _FOLDER / "bin" / "python", _FOLDER / "holds.txt"
    wanted = "\n".join(RIVALS)
    if not holds.exists() or holds.read_text() != wanted:
        print(f"making {_FOLDER} with {', '.join(RIVALS)}", file=sys.stderr)
        venv.create(_FOLDER, with_pip=True, clear=True)
        (_FOLDER / ".gitignore").write_text("*\n")
        pip = [str(python), "-m", "pip", "install", "--quiet", *RIVALS, "--editable", str(_HERE.parent)]
        subprocess.run(pip, check=True, stdout=sys.stderr)
        holds.write_text(wanted)
    return python

"""Process of Betaflight's SITL."""

import contextlib
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from jaxdrones.errors import UserError

VARIABLE = "BETAFLIGHT_SITL"
"""Environment variable with the path of the program."""
PROGRAM = "betaflight_SITL"
_END = 2.0  # s to end by itself
_LAST_LINES = 3


def cache_folder() -> Path:
    """Folder where the program is built: `jaxdrones/betaflight` in the user's cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxdrones" / "betaflight"


def find_program() -> Path:
    """Path of the program.

    Raises:
        UserError: it was not built.
    """
    given = os.environ.get(VARIABLE)
    program = Path(given) if given else cache_folder() / PROGRAM
    if program.is_file() and os.access(program, os.X_OK):
        return program
    what = f"{VARIABLE} is {given}, not a program" if given else f"Betaflight is not built: {program} is missing"
    raise UserError(f"{what}; run `jaxdrones betaflight --build`, which downloads its source and needs gcc and make")


class Process(contextlib.AbstractContextManager["Process"]):
    """Running program, in a folder of its own."""

    def __init__(self, program: Path):
        self._folder = tempfile.TemporaryDirectory(prefix="jaxdrones-betaflight-")
        self._program = program
        self._output = Path(self._folder.name) / "output.txt"
        self._process = self._start()

    def __exit__(self, *_: Any) -> None:
        self._end()
        self._folder.cleanup()

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    @property
    def ended(self) -> bool:
        """Whether the program has ended."""
        return self._process.poll() is not None

    @property
    def last_words(self) -> str:
        """End of its output."""
        lines = self._output.read_text(errors="replace").splitlines()
        return " / ".join(line for line in lines[-_LAST_LINES:] if line)

    def restart(self) -> None:
        """Start the program again, with its saved settings."""
        self._end()
        self._process = self._start()

    def _start(self) -> subprocess.Popen:
        with self._output.open("wb") as output:
            return subprocess.Popen(
                [str(self._program), "127.0.0.1"],
                cwd=self._folder.name,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C is for the simulator, which then ends this program
            )

    def _end(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(_END)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

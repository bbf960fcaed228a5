"""Versions of libraries, and description of the machine."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path

import jax

from jaxdrones.errors import UserError

LIBRARIES = ("jaxdrones", "jax", "jaxlib", "flax", "numpy", "gymnasium")
NOT_INSTALLED = "not installed"


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
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def devices() -> list[str]:
    """Devices of JAX, such as `gpu: NVIDIA H200`.

    Raises:
        UserError: no device, for example of the platforms in `JAX_PLATFORMS`.
    """
    try:
        return [f"{device.platform}: {device.device_kind}" for device in jax.devices()]
    except (AssertionError, RuntimeError) as error:  # an assertion, if the only requested platform has no driver
        platforms = os.environ.get("JAX_PLATFORMS", "")
        why = str(error) or f"JAX_PLATFORMS is {platforms!r}"
        raise UserError(f"jax finds no device: {why}; JAX_PLATFORMS=cpu leaves accelerators out") from error


def cores() -> int:
    """Number of processor cores for this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

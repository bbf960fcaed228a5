"""The versions of the libraries, and the machine."""

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
    """The version of an installed library, by the name under which it is installed."""
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return NOT_INSTALLED


def versions() -> dict[str, str]:
    """The versions of this library, of what it is built on, and of Python."""
    return {library: version(library) for library in LIBRARIES} | {"python": platform.python_version()}


def processor() -> str:
    """Name of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def devices() -> list[str]:
    """The devices that JAX computes on, such as `gpu: NVIDIA H200`.

    Raises:
        UserError: JAX finds none, for example none of the platforms that `JAX_PLATFORMS` names.
    """
    try:
        return [f"{device.platform}: {device.device_kind}" for device in jax.devices()]
    except (AssertionError, RuntimeError) as error:  # an assertion, where the only platform asked for has no driver
        platforms = os.environ.get("JAX_PLATFORMS", "")
        why = str(error) or f"JAX_PLATFORMS is {platforms!r}"
        raise UserError(f"jax finds no device: {why}; JAX_PLATFORMS=cpu leaves accelerators out") from error


def cores() -> int:
    """Number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

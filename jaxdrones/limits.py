"""Limits on memory, seeds and counts."""

import os
from pathlib import Path

from jaxdrones.errors import UserError

LARGEST_SEED = 2**31 - 1
"""JAX uses only 32 bits of a larger seed, so two seeds could be equivalent."""
LARGEST_COUNT = 2**31 - 1
"""Counters of updates and steps are int32."""

_UNKNOWN_MEMORY = 2**40  # bytes
_CGROUPS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


def check_memory(what: str, size: int, advice: str) -> None:
    """Raise if `what` needs more bytes than this computer has, with advice; `size` is a lower bound."""
    held = memory()
    if size > held:
        raise UserError(f"{what} needs about {_readable(size)} of memory, and there are {_readable(held)}; {advice}")


def memory() -> int:
    """Memory available to this process, bytes: of the machine, or of its container if less."""
    try:
        held = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError):  # as on Windows, which has no sysconf
        held = _UNKNOWN_MEMORY
    limits = (Path(file).read_text().strip() for file in _CGROUPS if Path(file).is_file())
    return min([held, *(int(text) for text in limits if text.isdecimal())])


def _readable(size: int) -> str:
    return f"{size / 1e9:.3g} GB" if size < 10**15 else "more than a million GB"

"""What this computer cannot hold, and what a random key cannot be made of, said before anything is computed."""

import os
from pathlib import Path

from jaxdrones.checks import check_whole
from jaxdrones.errors import UserError

LARGEST_SEED = 2**31 - 1
"""JAX would use only 32 bits of a larger one, so that two seeds could mean the same."""
LARGEST_COUNT = 2**31 - 1
"""What counts updates and steps is an int32."""

_UNKNOWN_MEMORY = 2**40  # bytes
_CGROUPS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


def check_seed(name: str, seed: int) -> None:
    """Raise unless a random key can be made of a seed, and of no other the same."""
    check_at_most(name, seed, LARGEST_SEED, minimum=0)


def check_at_most(name: str, value: int, limit: int, minimum: int = 1) -> None:
    """Raise unless `value` is an integer from `minimum` to `limit`."""
    check_whole(name, value, minimum)
    if value > limit:
        raise UserError(f"{name} is {str(value)[:30]}; give at most {limit}")


def check_memory(what: str, size: int, advice: str) -> None:
    """Raise if `size` bytes are more than this computer has.

    Args:
        what: would need them; the subject of the sentence.
        size: bytes, estimated from below.
        advice: what to do instead.
    """
    held = memory()
    if size > held:
        raise UserError(f"{what} needs about {_readable(size)} of memory, there are {_readable(held)}; {advice}")


def memory() -> int:
    """Bytes of memory that this process may use: of the machine, or of its container if that is less."""
    try:
        held = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError):  # as on Windows, which has no sysconf
        held = _UNKNOWN_MEMORY
    limits = (Path(file).read_text().strip() for file in _CGROUPS if Path(file).is_file())
    return min([held, *(int(text) for text in limits if text.isdecimal())])


def _readable(size: int) -> str:
    return f"{size / 1e9:.3g} GB" if size < 10**15 else "more than a million GB"

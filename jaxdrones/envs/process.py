"""Refuses processes in which JAX would hang."""

from __future__ import annotations

import os

_processes: set[int] = set()  # in which environments were made


def check_process() -> None:
    """Raise in a process that was forked from one in which environments were made, as JAX would wait there for ever.

    Raises:
        RuntimeError: this is such a process; says how to start another one.
    """
    if os.getpid() not in _processes:
        if _processes:
            raise RuntimeError(
                f"process {os.getpid()} was forked from process {next(iter(_processes))}, in which JAX runs, and JAX "
                "hangs in a forked process; start processes by 'spawn', for example "
                "gymnasium.vector.AsyncVectorEnv(..., context='spawn')"
            )
        _processes.add(os.getpid())

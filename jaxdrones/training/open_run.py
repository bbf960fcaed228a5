"""Opening the folder of a run, whichever library trained it."""

from __future__ import annotations

import os
from pathlib import Path

from jaxdrones.training.run import Run


def open_run(folder: str | os.PathLike) -> Run:
    """The run in a folder.

    Raises:
        ImportError: Stable-Baselines3 trained it, and is not installed; says which extra to install.
    """
    if (Path(folder) / "best.zip").exists():
        from jaxdrones.training.stable_baselines import SB3Run  # needs an optional library

        return SB3Run(folder)
    return Run(folder)

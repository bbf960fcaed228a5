"""Paths of bundled files."""

from pathlib import Path

_PACKAGE = Path(__file__).parent


def folder() -> Path:
    """Folder of bundled files: inside the wheel, or `assets/` of the checkout."""
    bundled = _PACKAGE / "_assets"
    return bundled if bundled.is_dir() else _PACKAGE.parent / "assets"


def vehicles() -> dict[str, Path]:
    """Bundled vehicles: name -> URDF."""
    return {path.stem: path for path in sorted(folder().glob("*.urdf"))}


def policies() -> dict[str, Path]:
    """Bundled policies: name of the task -> folder of the run that trained it, without its training state."""
    return {path.name: path for path in sorted((folder() / "policies").glob("*/"))}


def flights() -> dict[str, Path]:
    """Bundled flight logs of NanoBench (BSD-3): name -> .npz."""
    return {path.stem: path for path in sorted((folder() / "flights").glob("*.npz"))}

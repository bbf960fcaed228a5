"""A scene as JSON, for logs and pages."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxdrones.sensing.files import File, Mesh, Urdf
from jaxdrones.sensing.scene import KINDS, Scene

_CLASSES: dict[str, Any] = {kind.__name__: kind for kind in (*KINDS.values(), Mesh, Urdf)}


def scene_to_dict(scene: Scene) -> dict[str, Any]:
    """The scene of one world as entries of a JSON object; obstacles that are not active are left out.

    Args:
        scene: with values, not traced.

    Returns:
        `ground`, whether there is a ground plane, and `obstacles`, a list with an object for each: its `kind`, such as
        `Box`, and its fields by their names.
    """
    return {"ground": scene.ground, "obstacles": [_to_dict(solid) for solid in scene.numbered.values()]}


def scene_from_dict(entries: dict[str, Any]) -> Scene:
    """The scene of which `scene_to_dict` made these entries; obstacles are in the order of their numbers."""
    obstacles = []
    for entry in entries["obstacles"]:
        fields = {name: tuple(x) if isinstance(x, list) else x for name, x in entry.items() if name != "kind"}
        obstacles.append(_CLASSES[entry["kind"]](**fields))
    return Scene.of(*obstacles, ground=entries["ground"])


def _to_dict(solid: Any) -> dict[str, Any]:
    fields = {name: x for name, x in vars(solid).items() if name != "active"}
    if isinstance(solid, File):
        fields["path"] = str(solid.path)
    return {"kind": type(solid).__name__} | {
        name: x if isinstance(x, str) else np.asarray(x, float).tolist() for name, x in fields.items()
    }

"""Scenes as JSON."""

from typing import Any

import numpy as np

from jaxdrones.sensing.files import File, Mesh, Urdf
from jaxdrones.sensing.scene import KINDS, Scene

_CLASSES: dict[str, Any] = {kind.__name__: kind for kind in (*KINDS.values(), Mesh, Urdf)}


def scene_to_dict(scene: Scene) -> dict[str, Any]:
    """Convert the concrete scene of one world to a JSON object; inactive obstacles are left out.

    It has `ground`, whether there is a ground plane, and `obstacles`, a list of objects with the `kind` (such as `Box`)
    and the fields of each obstacle.
    """
    obstacles = []
    for solid in scene.numbered.values():
        fields = {name: x for name, x in vars(solid).items() if name not in ("active", "path")}
        entry = {"kind": type(solid).__name__} | {name: np.asarray(x, float).tolist() for name, x in fields.items()}
        obstacles.append(entry | {"path": str(solid.path)} if isinstance(solid, File) else entry)
    return {"ground": scene.ground, "obstacles": obstacles}


def scene_from_dict(entries: dict[str, Any]) -> Scene:
    """Inverse of `scene_to_dict`; obstacles are in the order of their numbers."""
    obstacles = []
    for entry in entries["obstacles"]:
        fields = {name: tuple(x) if isinstance(x, list) else x for name, x in entry.items() if name != "kind"}
        obstacles.append(_CLASSES[entry["kind"]](**fields))
    return Scene.of(*obstacles, ground=entries["ground"])

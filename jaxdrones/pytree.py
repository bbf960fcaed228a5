"""Base class of pytrees."""

import json
from typing import Any

import flax.struct
from jax import export


class PyTreeNode(flax.struct.PyTreeNode):
    """Flax `PyTreeNode` with support for `jax.export`.

    Static fields are saved as JSON. Only the first class of a name is registered, for example when a notebook cell runs
    twice.
    """

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        name = f"{cls.__module__}.{cls.__qualname__}"
        if name not in _registered:
            _registered.add(name)
            export.register_pytree_node_serialization(
                cls,
                serialized_name=name,
                serialize_auxdata=lambda data: json.dumps(data).encode(),
                deserialize_auxdata=lambda data: as_tuple(json.loads(bytes(data))),
            )


_registered: set[str] = set()


def as_tuple(value: Any) -> Any:
    """Convert lists, which JSON has in place of tuples, to tuples."""
    return tuple(map(as_tuple, value)) if isinstance(value, list | tuple) else value

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
                cls, serialized_name=name, serialize_auxdata=_to_bytes, deserialize_auxdata=_from_bytes
            )


_registered: set[str] = set()


def _to_bytes(auxdata: Any) -> bytes:
    return json.dumps(auxdata).encode()


def _from_bytes(data: bytes | bytearray) -> Any:
    return as_tuple(json.loads(bytes(data)))


def as_tuple(value: Any) -> Any:
    """Convert lists, which JSON has in place of tuples, to tuples."""
    return tuple(map(as_tuple, value)) if isinstance(value, list | tuple) else value

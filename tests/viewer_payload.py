"""Decoder of the payload of a page: what `jaxdrones.visualization.viewer.payload` encodes, and the page decodes."""

import base64
import json
import math
import zlib
from typing import Any

import numpy as np


def decode(payload: str) -> dict[str, Any]:
    """Decode a payload to its header with arrays in place of their entries."""
    data = zlib.decompress(base64.b64decode(payload))
    start = 4 + int.from_bytes(data[:4], "little")
    return _resolved(json.loads(data[4:start]), data[start:])


def _resolved(value: Any, data: bytes) -> Any:
    if isinstance(value, list):
        return [_resolved(x, data) for x in value]
    if not isinstance(value, dict):
        return value
    if "dtype" not in value:
        return {name: _resolved(x, data) for name, x in value.items()}
    stored = np.frombuffer(data, "<" + value["dtype"], math.prod(value["shape"]), value["offset"])
    stored = stored.reshape(value["shape"])
    if value["dtype"] != "i2":
        return stored
    counts = np.cumsum(stored, axis=0, dtype=np.int16).astype(float) + 32768
    return (value["low"] + value["step"] * counts).astype(np.float32)

"""Files of named arrays (.npz) from elsewhere, read without pickle and without trust in their headers."""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import IO

import numpy as np

from jaxdrones.errors import UserError

_MAX_BYTES = 2**31  # of an array


def read_arrays(path: Path, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of an .npz file by name, of all names or of those given.

    Raises:
        ValueError: the file cannot be read, or is not one of arrays, is damaged, or claims more than it holds.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            sizes = {entry.filename.removesuffix(".npy"): entry.file_size for entry in archive.infolist()}
            wanted = [name for name in sizes if names is None or name in names]
            arrays = {}
            for name in wanted:
                with archive.open(f"{name}.npy") as file:
                    version = np.lib.format.read_magic(file)
                    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else _header_2_0
                    shape, _, dtype = header(file)
                claimed = math.prod(shape) * dtype.itemsize
                if claimed > min(sizes[name], _MAX_BYTES):
                    raise UserError(
                        f"{path}: {name} claims {claimed:,} bytes and the file has {sizes[name]:,} of it; "
                        "the file is damaged or too large, record it again"
                    )
                with archive.open(f"{name}.npy") as file:
                    arrays[name] = np.lib.format.read_array(file, allow_pickle=False)
            return arrays
    except UserError:
        raise
    except OSError as error:
        raise UserError(
            f"{path}: cannot be read ({error.strerror or error}); give the log of a flight (.npz)"
        ) from None
    except (ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError):
        raise UserError(f"{path}: is not an .npz file of arrays; give the log of a flight") from None


def _header_2_0(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    return np.lib.format.read_array_header_2_0(file)

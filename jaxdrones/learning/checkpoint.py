"""Policies and training on disk: numbers as flax msgpack, and beside them what they mean, as JSON (the sidecar).

The sidecar holds the SHA-256 of the numbers and one of its own content, so a file that was changed, cut short or taken
from another checkpoint is refused. It is the file that counts: numbers are read from `.msgpack`, or from the
`.msgpack.new` that a process which was killed between two renames left behind, whichever of them it describes.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from pathlib import Path
from typing import Any

import flax
import flax.serialization
import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.learning.networks import MLP, Policy, VisionMLP
from jaxdrones.learning.normalize import Statistics

FORMAT = 2

ANOTHER = "take another checkpoint, or train anew"


def save(path: str | os.PathLike, policy: Policy, **about: Any) -> None:
    """Write `path`.msgpack and `path`.json, both or none.

    Args:
        path: without an ending; missing folders are made.
        policy: what flies.
        **about: anything JSON can hold, or a dataclass, to be found by `about`: env, options, algorithm, config.

    Raises:
        ValueError: the policy has numbers that are not finite.
    """
    _check_finite(_numbers(Path(path)), policy)
    own = {"network": _settings(policy.network), "per_agent": policy.per_agent}
    save_tree(path, policy, **about, policy=own)


def load(path: str | os.PathLike) -> Policy:
    """The policy that `save` wrote, bit for bit.

    Raises:
        FileNotFoundError: there is none.
        ValueError: the files are damaged or do not fit each other, or the numbers are of a precision that JAX has
            switched off.
    """
    path = Path(path)
    kept = about(path)
    if "policy" not in kept:
        raise ValueError(f"{path} holds no policy; found {', '.join(kept)}")
    numbers = _restored(path, kept)
    try:
        settings: dict[str, Any] = {
            name: tuple(x) if isinstance(x, list) else x for name, x in kept["policy"]["network"].items()
        }
        network = VisionMLP(**settings) if "channels" in settings else MLP(**settings)
        statistics = Statistics(**{name: jnp.asarray(x) for name, x in numbers["statistics"].items()})
        params = jax.tree.map(jnp.asarray, numbers["params"])
        policy = Policy(params, statistics, network, kept["policy"]["per_agent"])
    except (AttributeError, KeyError, TypeError) as error:
        raise ValueError(f"{path} does not hold a policy of this version ({line(error)}); {ANOTHER}") from error
    _check_shapes(path, kept, policy)
    _check_finite(_numbers(path), policy)
    return policy


def save_tree(path: str | os.PathLike, tree: Any, **about: Any) -> None:
    """Write any pytree, such as a training state, with what it means; keys are kept too."""
    path = Path(path)
    tree = _without_keys(tree)
    versions = {"jax": jax.__version__, "flax": flax.__version__}
    content = flax.serialization.to_bytes(tree)
    save_bytes(_numbers(path), content, **about, versions=versions, shapes=_shapes(tree))


def save_bytes(file: Path, content: bytes, **about: Any) -> None:
    """Write a file, and beside it, as .json, what it means; a crash leaves both, or both of before."""
    kept = {name: _plain(x) for name, x in about.items()} | {"format": FORMAT, "sha256": _digest(content)}
    kept = json.loads(json.dumps(kept, default=str))
    kept["sidecar_sha256"] = _seal(kept)
    sidecar = file.with_suffix(".json")
    file.parent.mkdir(parents=True, exist_ok=True)
    _write_beside(file, content)
    try:
        write(sidecar, json.dumps(kept, indent=2).encode())
    except OSError:
        _beside(file).unlink(missing_ok=True)
        raise
    _rename(file)  # a crash before this line is mended by `load_bytes`


def load_bytes(file: Path, kept: dict[str, Any]) -> bytes:
    """The content of the file that `save_bytes` wrote.

    Args:
        file: with its ending.
        kept: what `about` says of it.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it cannot be read, or is not the one that the sidecar describes.
    """
    found = [content for content in map(_content, (file, _beside(file))) if content is not None]
    for content in found:
        if _digest(content) == kept["sha256"]:
            return content
    path = file.with_suffix("")
    if not found:
        raise FileNotFoundError(f"no checkpoint at {path}: {file} does not exist")
    raise ValueError(
        f"{file} is damaged, or of another checkpoint than {file.with_suffix('.json').name}: its checksum differs; "
        + ANOTHER
    )


def write(file: Path, content: bytes) -> None:
    """Write a file whole or not at all.

    Raises:
        OSError: it cannot be written; names the file.
    """
    _write_beside(file, content)
    try:
        _rename(file)
    except OSError:
        _beside(file).unlink(missing_ok=True)
        raise


def load_tree(path: str | os.PathLike, like: Any) -> Any:
    """What `save_tree` wrote, bit for bit.

    Args:
        path: without an ending.
        like: a tree of the same structure, shapes and kinds of numbers; `jax.eval_shape` makes one for nothing.

    Raises:
        FileNotFoundError: there is none.
        ValueError: the files are damaged, or shapes differ.
    """
    path = Path(path)
    wanted, kept = jax.eval_shape(_without_keys, like), about(path)
    _check_shapes(path, kept, wanted)
    zeros = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), wanted)
    try:
        numbers = flax.serialization.from_state_dict(zeros, _restored(path, kept))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} does not hold what is asked for ({line(error)}); {ANOTHER}") from error
    _check_shapes(path, kept, numbers)

    def restored(x, like):
        if not _is_key(like):
            return jnp.asarray(x)
        return jax.random.wrap_key_data(x, impl=jax.random.key_impl(jnp.empty((), like.dtype)))

    return jax.tree.map(restored, numbers, like)


def about(path: str | os.PathLike) -> dict[str, Any]:
    """What was written beside the numbers.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is damaged, or of another version of this library.
    """
    path = Path(path)
    file = _sidecar(path)
    content = _content(file)
    if content is None:
        raise FileNotFoundError(f"no checkpoint at {path}: {file} does not exist")
    try:
        kept = json.loads(content)
        if not isinstance(kept, dict):
            raise ValueError("it holds no JSON object")
        seal, found = kept.pop("sidecar_sha256", None), _seal(kept)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file} is damaged: {line(error)}; {ANOTHER}") from None
    if kept.get("format") != FORMAT:
        raise ValueError(
            f"{file} is of format {repr(kept.get('format'))[:20]}, this version reads {FORMAT}; train anew"
        )
    if seal != found:
        raise ValueError(f"{file} is damaged, or was edited after it was saved: its checksum differs; {ANOTHER}")
    return kept


def _settings(network: MLP | VisionMLP) -> dict[str, Any]:
    names = {field.name for field in dataclasses.fields(network)} - {"parent", "name"}  # those are flax's own
    return {name: getattr(network, name) for name in names}


def _restored(path: Path, kept: dict[str, Any]) -> Any:
    """The numbers as NumPy arrays, in dictionaries."""
    content = load_bytes(_numbers(path), kept)
    try:
        return flax.serialization.msgpack_restore(content)
    except Exception as error:  # msgpack has several of its own
        raise ValueError(f"{_numbers(path)} is damaged: {line(error)}; {ANOTHER}") from error


def _check_shapes(path: Path, kept: dict[str, Any], tree: Any) -> None:
    """Raise unless a tree has the shapes and the kinds of numbers that were saved."""
    expected, found = _shapes(tree), kept.get("shapes", {})
    for name in expected | found:
        if expected.get(name) != found.get(name):
            raise ValueError(
                f"{path}: {name} is {found.get(name, 'missing')}, expected {expected.get(name, 'nothing')}; load it "
                "with the environment, the settings and the precision (JAX_ENABLE_X64) that it was saved with"
            )


def _check_finite(file: Path, policy: Policy) -> None:
    for path, x in jax.tree_util.tree_leaves_with_path(policy):
        if not np.isfinite(x).all():
            where = jax.tree_util.keystr(path)
            raise ValueError(f"{file}: the policy's {where} holds numbers that are not finite; {ANOTHER}")


def line(error: Exception) -> str:
    """What an error says, in one line that is not too long."""
    return " ".join(str(error).split())[:120] or type(error).__name__


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _seal(kept: dict[str, Any]) -> str:
    """Of what a sidecar says, however it is laid out."""
    return _digest(json.dumps(kept, sort_keys=True).encode())


def _content(file: Path) -> bytes | None:
    """Of a file; `None` where there is none."""
    try:
        return file.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error.strerror}; {ANOTHER}") from error


def _is_key(x) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _without_keys(tree):
    return jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else x, tree)


def _shapes(tree) -> dict[str, str]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): f"{np.dtype(x.dtype)}{list(x.shape)}" for path, x in leaves}


def _plain(x):
    return dataclasses.asdict(x) if dataclasses.is_dataclass(x) else x


def _write_beside(file: Path, content: bytes) -> None:
    """Under another name first, so that a crash or a full disk leaves what was there."""
    new = _beside(file)
    try:
        new.write_bytes(content)
    except OSError as error:  # of a full disk, which names no file
        new.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(file)) from error


def _rename(file: Path) -> None:
    """What was written beside the file becomes the file."""
    try:
        os.replace(_beside(file), file)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(file)) from error


def _beside(file: Path) -> Path:
    return file.with_name(file.name + ".new")


def _numbers(path: Path) -> Path:
    return path.with_name(path.name + ".msgpack")


def _sidecar(path: Path) -> Path:
    return path.with_name(path.name + ".json")

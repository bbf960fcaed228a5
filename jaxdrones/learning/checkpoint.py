"""Policies and training on disk: numbers as flax msgpack, and beside them what they mean, as JSON."""

from __future__ import annotations

import dataclasses
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

FORMAT = 1


def save(path: str | os.PathLike, policy: Policy, **about: Any) -> None:
    """Write `path`.msgpack and `path`.json, each whole or not at all.

    Args:
        path: without an ending; missing folders are made.
        policy: what flies.
        **about: anything JSON can hold, or a dataclass, to be found by `about`: env, options, algorithm, config.
    """
    own = {"network": _settings(policy.network), "per_role": policy.per_role}
    save_tree(path, policy, **about, policy=own)


def load(path: str | os.PathLike) -> Policy:
    """The policy that `save` wrote.

    Raises:
        FileNotFoundError: there is none.
        ValueError: the files are damaged or do not fit each other.
    """
    kept = about(path)
    if "policy" not in kept:
        raise ValueError(f"{path} holds no policy; found {', '.join(kept)}")
    settings: dict[str, Any] = {
        name: tuple(x) if isinstance(x, list) else x for name, x in kept["policy"]["network"].items()
    }
    network = VisionMLP(**settings) if "channels" in settings else MLP(**settings)
    numbers = _restored(path)
    return Policy(numbers["params"], Statistics(**numbers["statistics"]), network, kept["policy"]["per_role"])


def save_tree(path: str | os.PathLike, tree: Any, **about: Any) -> None:
    """Write any pytree, such as a training state, with what it means; keys are kept too."""
    path = Path(path)
    tree = _without_keys(tree)
    versions = {"jax": jax.__version__, "flax": flax.__version__}
    content = flax.serialization.to_bytes(tree)
    save_bytes(_numbers(path), content, **about, versions=versions, shapes=_shapes(tree))


def save_bytes(file: Path, content: bytes, **about: Any) -> None:
    """Write a file, and beside it, as .json, what it means."""
    kept = {name: _plain(x) for name, x in about.items()} | {"format": FORMAT}
    file.parent.mkdir(parents=True, exist_ok=True)
    _write(file, content)
    _write(file.with_suffix(".json"), json.dumps(kept, indent=2, default=str).encode())


def load_tree(path: str | os.PathLike, like: Any) -> Any:
    """What `save_tree` wrote, bit for bit.

    Args:
        path: without an ending.
        like: a tree of the same structure, shapes and kinds of numbers; `jax.eval_shape` makes one for nothing.

    Raises:
        FileNotFoundError: there is none.
        ValueError: the files are damaged, or shapes differ.
    """
    wanted = jax.eval_shape(_without_keys, like)
    expected, found = _shapes(wanted), about(path)["shapes"]
    for name in expected | found:
        if expected.get(name) != found.get(name):
            raise ValueError(
                f"{path}: {name} is {found.get(name, 'missing')}, expected {expected.get(name, 'nothing')}; "
                "load it with the environment and settings it was saved with"
            )
    zeros = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), wanted)
    numbers = flax.serialization.from_state_dict(zeros, _restored(path))

    def restored(x, like):
        if not _is_key(like):
            return jnp.asarray(x)
        return jax.random.wrap_key_data(x, impl=jax.random.key_impl(jnp.empty((), like.dtype)))

    return jax.tree.map(restored, numbers, like)


def about(path: str | os.PathLike) -> dict[str, Any]:
    """What was written beside the numbers.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is damaged, or of a later version of this library.
    """
    try:
        kept = json.loads(_sidecar(Path(path)).read_bytes())
    except FileNotFoundError:
        raise FileNotFoundError(f"no checkpoint at {path}: {_sidecar(Path(path))} does not exist") from None
    except ValueError as error:
        raise ValueError(f"{_sidecar(Path(path))} is damaged: {error}") from None
    if kept.get("format") != FORMAT:
        raise ValueError(f"{path} is of format {kept.get('format')}, this version reads {FORMAT}; train anew")
    return kept


def _settings(network: MLP | VisionMLP) -> dict[str, Any]:
    names = {field.name for field in dataclasses.fields(network)} - {"parent", "name"}  # those are flax's own
    return {name: getattr(network, name) for name in names}


def _restored(path: str | os.PathLike) -> Any:
    file = _numbers(Path(path))
    try:
        return jax.tree.map(jnp.asarray, flax.serialization.msgpack_restore(file.read_bytes()))
    except FileNotFoundError:
        raise FileNotFoundError(f"no checkpoint at {path}: {file} does not exist") from None
    except Exception as error:  # msgpack has several of its own
        raise ValueError(f"{file} is damaged: {error}; take another checkpoint") from error


def _is_key(x) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _without_keys(tree):
    return jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else x, tree)


def _shapes(tree) -> dict[str, str]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): f"{np.dtype(x.dtype)}{list(x.shape)}" for path, x in leaves}


def _plain(x):
    return dataclasses.asdict(x) if dataclasses.is_dataclass(x) else x


def _write(file: Path, content: bytes) -> None:
    """Beside it first, so that a crash or a full disk leaves what was there."""
    new = file.with_name(file.name + ".new")
    try:
        new.write_bytes(content)
        os.replace(new, file)
    except OSError as error:  # of a full disk, which names no file
        new.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(file)) from error


def _numbers(path: Path) -> Path:
    return path.with_name(path.name + ".msgpack")


def _sidecar(path: Path) -> Path:
    return path.with_name(path.name + ".json")

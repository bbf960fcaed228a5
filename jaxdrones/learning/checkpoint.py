"""Checkpoints of policies and training states: arrays as flax msgpack, with a JSON sidecar.

Modified, truncated and mismatched files are rejected; see `learning.files`.
"""

import dataclasses
import os
from pathlib import Path
from typing import Any

import flax
import flax.serialization
import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.checks import short_repr
from jaxdrones.errors import UserError
from jaxdrones.learning.files import ADVICE, load_bytes, one_line, read_sidecar, save_bytes
from jaxdrones.learning.networks import MLP, Network, OwnNetwork, Policy
from jaxdrones.learning.normalize import RunningStatistics
from jaxdrones.pytree import as_tuple


def save(path: str | os.PathLike, policy: Policy, **about: Any) -> None:
    """Write a policy to `path`.msgpack and `path`.json, both or none; missing folders are created.

    `about` are entries of the sidecar, such as task, algorithm and settings: JSON values or dataclasses.

    Raises:
        ValueError: no policy, or a parameter that is not finite.
    """
    if not isinstance(policy, Policy):
        raise UserError(f"policy is {short_repr(policy)}; give a Policy, such as result.policy")
    _check_finite(_arrays_file(Path(path)), policy)
    own = {"network": _settings(policy.network), "per_agent": policy.per_agent}
    save_tree(path, policy, **about, policy=own)


def load(path: str | os.PathLike, network: Any = None) -> Policy:
    """Load a policy of `save`, bit for bit; `network` is the user's, see `learning.networks.OwnNetwork`.

    Raises:
        FileNotFoundError: there is no checkpoint.
        ValueError: damaged or mismatched files, a network of another class, or a precision that is disabled in JAX.
    """
    path = Path(path)
    sidecar = read_sidecar(path)
    if "policy" not in sidecar:
        raise UserError(f"{path} holds no policy; found {', '.join(sidecar)}")
    arrays = _restore(path, sidecar)
    try:
        settings: dict[str, Any] = {name: as_tuple(x) for name, x in sidecar["policy"]["network"].items()}
        obs_stats = RunningStatistics(**{name: jnp.asarray(x) for name, x in arrays["obs_stats"].items()})
        params = jax.tree.map(jnp.asarray, arrays["params"])
        if "own" in settings:
            if network is None:
                raise UserError(f"{path} holds a network of your own, {settings['own']}; give load(path, network=...)")
            if _class_name(network) != settings["own"].rpartition(".")[2]:
                raise UserError(
                    f"{path} holds a network of class {settings['own']}, not {_class_name(network)}; give one"
                )
            network = OwnNetwork(network, settings["output_size"])
            params = network.restored(params, len(obs_stats.mean), sidecar["policy"]["per_agent"])
        else:
            if network is not None:
                raise UserError(f"{path} holds a built-in network, not {_class_name(network)}; give load(path)")
            network = Network(**settings) if "recurrent_size" in settings else MLP(**settings)
        policy = Policy(params, obs_stats, network, sidecar["policy"]["per_agent"])
    except (AttributeError, KeyError, TypeError) as error:
        raise UserError(f"{path} does not hold a policy of this version ({one_line(error)}); {ADVICE}") from error
    _check_shapes(path, sidecar, policy)
    _check_finite(_arrays_file(path), policy)
    return policy


def save_tree(path: str | os.PathLike, tree: Any, **about: Any) -> None:
    """Write any pytree, such as a training state, with its description; random keys are supported."""
    path = Path(path)
    tree = _without_keys(tree)
    versions = {"jax": jax.__version__, "flax": flax.__version__}
    content = flax.serialization.to_bytes(tree)
    save_bytes(_arrays_file(path), content, **about, versions=versions, shapes=_shapes(tree))


def load_tree(path: str | os.PathLike, like: Any) -> Any:
    """Load a tree of `save_tree`, bit for bit.

    `like` has its structure, shapes and dtypes, for example from `jax.eval_shape`; `path` has no suffix.
    """
    path = Path(path)
    wanted, sidecar = jax.eval_shape(_without_keys, like), read_sidecar(path)
    _check_shapes(path, sidecar, wanted)
    zeros = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), wanted)
    try:
        arrays = flax.serialization.from_state_dict(zeros, _restore(path, sidecar))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{path} does not hold a tree of the requested structure ({one_line(error)}); {ADVICE}"
        ) from error
    _check_shapes(path, sidecar, arrays)

    def restored(x, like):
        if not _is_key(like):
            return jnp.asarray(x)
        return jax.random.wrap_key_data(x, impl=jax.random.key_impl(jnp.empty((), like.dtype)))

    return jax.tree.map(restored, arrays, like)


def _class_name(network: Any) -> str:
    return type(network).__name__


def _settings(network: MLP | Network | OwnNetwork) -> dict[str, Any]:
    if isinstance(network, OwnNetwork):
        return {"own": type(network.module).__qualname__, "output_size": network.output_size}
    names = {field.name for field in dataclasses.fields(network)} - {"parent", "name"}  # flax adds these fields
    return {name: getattr(network, name) for name in names}


def _restore(path: Path, sidecar: dict[str, Any]) -> Any:
    content = load_bytes(_arrays_file(path), sidecar)
    try:
        return flax.serialization.msgpack_restore(content)
    except Exception as error:  # msgpack raises errors of several types
        raise UserError(f"{_arrays_file(path)} is damaged: {one_line(error)}; {ADVICE}") from error


def _check_shapes(path: Path, sidecar: dict[str, Any], tree: Any) -> None:
    expected, found = _shapes(tree), sidecar.get("shapes", {})
    for name in expected | found:
        if expected.get(name) != found.get(name):
            raise UserError(
                f"{path}: {name} is {found.get(name, 'missing')}, expected {expected.get(name, 'nothing')}; load it "
                "with the environment, the settings and the precision (JAX_ENABLE_X64) that it was saved with"
            )


def _check_finite(file: Path, policy: Policy) -> None:
    for path, x in jax.tree_util.tree_leaves_with_path(policy):
        if not np.isfinite(x).all():
            where = jax.tree_util.keystr(path)
            raise UserError(f"{file}: the policy's {where} holds numbers that are not finite; {ADVICE}")


def _is_key(x) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _without_keys(tree):
    return jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else x, tree)


def _shapes(tree) -> dict[str, str]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): f"{np.dtype(x.dtype)}{list(x.shape)}" for path, x in leaves}


def _arrays_file(path: Path) -> Path:
    return path.with_name(path.name + ".msgpack")

"""Validation of arguments.

A message names the problem, the given value and the remedy. Traced values pass, as do the placeholders of tree
transformations.
"""

import difflib
import functools
import inspect
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.errors import UserError

_SMALLEST = np.finfo(np.float64).tiny
_LONGEST = 120  # characters of a value in an error
UNIT_LENGTH = 1e-3  # tolerance of the length of a unit quaternion, far above float32 and integrator errors
_NUMBERS = "biuf"  # kinds of dtypes
POSITIVE = ("mass", "inertia", "kf", "rotor_rise_time", "rotor_fall_time", "max_rpm", "prop_radius")
"""Constants of a vehicle that must be positive."""
NOT_NEGATIVE = ("km", "gravity", "air_density", "collision_radius", "collision_height")
"""Constants that must not be negative."""
_LARGEST_THRUST = 100.0  # over the weight
_MAY_BE_INFINITE = ("max_rpm",)
_BY_NAME = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
_NO_ARRAYS = (list, tuple, dict, str, type(None))
_UNKNOWN = (jax.core.Tracer, jax.ShapeDtypeStruct)


class UnexpectedKeyword(TypeError):
    """Python's `TypeError` for an unknown keyword argument, with a hint."""


def is_concrete(value: Any) -> bool:
    """Whether a value is concrete, not traced."""
    return not isinstance(value, _UNKNOWN) and type(value) is not object


def short_repr(value: Any) -> str:
    """Representation of a value in one short line; of a concrete array, its numbers."""
    is_array = isinstance(value, np.ndarray | np.generic | jax.Array) and is_concrete(value)
    text = repr(np.asarray(value).tolist() if is_array else value)
    text = " ".join(text.split())
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


def check_shape(name: str, array: Any, shape: tuple[int | str, ...], meaning: str, *, finite: bool = False) -> None:
    """Raise unless `array` has `shape`, and finite numbers; a string entry is any length of at least one."""
    if isinstance(array, list | tuple):  # of numbers, some of which may be traced
        array = (np if all(map(is_concrete, jax.tree.leaves(array))) else jnp).asarray(array)
    given = np.shape(array)
    fits = len(given) == len(shape) and all(
        n >= 1 if isinstance(wanted, str) else n == wanted for n, wanted in zip(given, shape, strict=True)
    )
    if not fits:
        wanted = "(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")"
        raise UserError(f"{name} has shape {given}; expected {wanted}: {meaning}")
    if finite:
        check_finite(name, array)


def check_finite(name: str, tree: Any) -> None:
    """Raise if a concrete array of `tree` has NaN or infinity."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if is_concrete(leaf) and not np.all(np.isfinite(leaf)):
            where = name + jax.tree_util.keystr(path)
            raise UserError(f"{where} is not finite: {short_repr(leaf)}; give finite numbers")


def check_number(
    name: str,
    value: Any,
    unit: str = "",
    *,
    at_least: float | None = None,
    above: float | None = None,
    at_most: float | None = None,
    below: float | None = None,
    infinite: bool = False,
) -> None:
    """Raise unless `value` is one real number within the bounds, also after rounding to float32.

    Traced values pass. The bounds `above` and `below` are exclusive; `infinite` allows infinity, `unit` is for the
    message.
    """
    if not is_concrete(value):
        return
    given = {"at least": at_least, "above": above, "at most": at_most, "below": below}
    bounds = {word: bound for word, bound in given.items() if bound is not None}
    if not (_is_number(value) and _within(float(value), bounds, infinite)):
        words = " and ".join(f"{word} {bound:g}" for word, bound in bounds.items())
        wanted = {"": "a finite number", "above 0": "a positive number"}.get(words, f"a number of {words}")
        wanted = wanted.replace("number of above", "number above").replace("number of below", "number below")
        raise UserError(f"{name} is {short_repr(value)}; give {wanted}" + (f" ({unit})" if unit else ""))


def _is_number(value: Any) -> bool:
    if isinstance(value, bool | str | bytes) or np.shape(value) != ():
        return False
    return np.asarray(value).dtype.kind in _NUMBERS


def _within(value: float, bounds: dict[str, float], infinite: bool) -> bool:
    with np.errstate(over="ignore", under="ignore"):
        rounded = float(np.float32(value))
    if np.isnan(value) or (not infinite and not np.isfinite(rounded)):
        return False
    if bounds.get("above") == 0 and rounded == 0:
        return False
    holds = {"at least": operator.ge, "above": operator.gt, "at most": operator.le, "below": operator.lt}
    return all(holds[word](value, bound) for word, bound in bounds.items())


def check_whole(name: str, value: int, minimum: int = 1, limit: int | None = None) -> None:
    """Raise unless `value` is an integer from `minimum` to `limit`."""
    try:
        whole = not isinstance(value, bool) and operator.index(value) >= minimum
    except TypeError:
        whole = False
    if not whole:
        raise UserError(f"{name} is {short_repr(value)}; give a whole number of at least {minimum}")
    if limit is not None and value > limit:
        raise UserError(f"{name} is {str(value)[:30]}; give at most {limit}")


def check_switch(name: str, value: bool | str, others: tuple[str, ...] = ()) -> None:
    """Raise unless `value` is true or false, or one of the `others`."""
    if not isinstance(value, bool | np.bool_) and not (isinstance(value, str) and value in others):
        raise UserError(f"{name} is {short_repr(value)}; give {' or '.join(['True', 'False', *map(repr, others)])}")


def check_choice(kind: str, name: str, known: Iterable[str]) -> None:
    """Raise unless `name` is one of the `known` names."""
    known = sorted(known)
    if name not in known:
        raise UserError(f"unknown {kind} {name!r}{hint(name, known)} (known: {', '.join(known)})")


def look_up(kind: str, name: str, table: Mapping[str, Any]) -> Any:
    """Entry of a table by its name."""
    check_choice(kind, name, table)
    return table[name]


def check_keyword(function: str, keyword: str, known: Iterable[str]) -> None:
    """Raise unless `keyword` is one of the `known` keyword arguments of a function; name the closest one."""
    known = sorted(known)
    if keyword not in known:
        said = f"{function}() got an unexpected keyword argument {keyword!r}"
        raise UnexpectedKeyword(f"{said}{hint(keyword, known)} (known: {', '.join(known)})")


def hint(name: str, known: Iterable[str]) -> str:
    """Suggestion for an unknown name; empty if none is close."""
    close = difflib.get_close_matches(str(name), known, n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def check_sequence(name: str, value: Any, example: str) -> tuple:
    """Validated entries of a sequence; iterators, which can be read only once, are rejected."""
    if isinstance(value, str | Iterator) or callable(value) or not isinstance(value, Iterable):
        raise UserError(f"{name} is {short_repr(value)}; give a sequence, for example ({example},)")
    return tuple(value)


def check_function(
    name: str, value: Any, arguments: tuple[str, ...] | None = None, *, example: str = "", hint: str = ""
) -> None:
    """Raise unless `value` is a function, and accepts these arguments if it has a signature."""
    wanted = f"give a function of ({', '.join(arguments or ())})"
    if not callable(value):
        remedy = f"give for example {example}" if example else wanted
        raise UserError(f"{name}: {short_repr(value)} is not a function; {remedy}")
    if arguments is None:
        return
    try:
        signature = inspect.signature(value)
    except (TypeError, ValueError):
        return
    try:
        signature.bind(*arguments)
    except TypeError:
        called = getattr(value, "__name__", repr(value))
        raise UserError(f"{name}: {called} takes {signature}; {wanted}{hint}") from None


def takes(function: Callable, name: str) -> bool:
    """Whether a function has a parameter of this name that is not bound by `partial`."""
    try:
        parameter = inspect.signature(function).parameters.get(name)
    except (TypeError, ValueError):
        return False
    is_bound = isinstance(function, functools.partial) and name in function.keywords
    return parameter is not None and parameter.kind in _BY_NAME and not is_bound


def bind(function: Callable, **values: Any) -> Callable:
    """Bind the values for which a function has a parameter."""
    bound = {name: value for name, value in values.items() if takes(function, name)}
    return functools.partial(function, **bound) if bound else function


def depends_on(function: Callable, value: Any) -> bool:
    """Whether the traced program of a function of one array uses it."""
    program = jax.make_jaxpr(function)(value).jaxpr
    used = {id(x) for equation in program.eqns for x in equation.invars} | set(map(id, program.outvars))
    return any(id(x) in used for x in program.invars)


def check_arrays(**trees: Any) -> None:
    """Raise unless every field but `aux` of these objects by name is an array or a number.

    JAX treats lists, tuples and `None` as trees, not as arrays.
    """
    for name, tree in trees.items():
        for field, leaf in vars(tree).items():
            if field != "aux" and isinstance(leaf, _NO_ARRAYS):
                remedy = "give an array, for example jax.numpy.array(...)"
                raise UserError(f"{name}.{field} is {short_repr(leaf)}; {remedy}")


def check_params(params: Any, finite: bool = True) -> None:
    """Raise for concrete constants of a drone or a team that cannot fly; without `finite`, only signs are checked."""
    constants = vars(params)
    check_arrays(params=params)
    if finite:
        check_finite(
            "params", params.replace(**{name: _without_infinity(constants[name]) for name in _MAY_BE_INFINITE})
        )
    for bound, words, names in (0, "positive numbers", POSITIVE), (-_SMALLEST, "numbers of at least 0", NOT_NEGATIVE):
        for name in names:
            leaf = constants[name]
            if is_concrete(leaf) and not (np.asarray(leaf) > bound).all():
                raise UserError(f"params.{name} is {short_repr(leaf)}; give {words}")
    health = params.aux.get("rotor_health", 1) if isinstance(params.aux, dict) else 1
    if is_concrete(health) and not ((np.asarray(health) >= 0) & (np.asarray(health) <= 1)).all():
        raise UserError(f"params.aux['rotor_health'] is {short_repr(health)}; give numbers from 0 to 1")


def check_vehicle(params: Any) -> None:
    """Raise for concrete constants of a team that are not finite, or with which it cannot hover."""
    check_finite("vehicle", params)
    if not all(map(is_concrete, (params.mass, params.gravity, params.kf, params.max_rpm))):
        return
    weight, thrust = np.asarray(params.weight, float), np.asarray(params.max_thrust, float)
    wrong = (weight > 0) & ~((weight < thrust) & (thrust <= _LARGEST_THRUST * weight))
    if wrong.any():
        ratio, hover, fastest = (np.asarray(x)[wrong][0] for x in (thrust / weight, params.hover_rpm, params.max_rpm))
        raise UserError(
            f"vehicle hovers at {hover:.4g} RPM of at most {fastest:.4g}, with a highest thrust of {ratio:.4g} times "
            f"its weight; give a ratio above 1 and up to {_LARGEST_THRUST:g}, mass in kg, max_rpm in RPM, and kf in "
            "N/RPM^2, which is 0.010966 times that in N/(rad/s)^2"
        )


def _without_infinity(leaf: Any) -> Any:
    return np.where(np.isposinf(leaf), 0, leaf) if is_concrete(leaf) else leaf


def check_quaternion(name: str, quat: Any) -> None:
    """Raise unless concrete quaternions (..., 4) have unit length."""
    if not is_concrete(quat) or np.shape(quat)[-1:] != (4,):  # what else it is, is said where shapes are checked
        return
    quat = np.asarray(quat, float)
    length = np.sqrt((quat * quat).sum(axis=-1))
    off = ~(np.abs(length - 1) <= UNIT_LENGTH)
    if off.any():
        given, length = quat[off][0].tolist(), np.atleast_1d(length[off])[0]
        raise UserError(f"{name} has length {length:g}: {given}; give a unit quaternion (x, y, z, w)")


def check_key(name: str, key: Any) -> None:
    """Raise unless `key` is one random key, typed or raw, concrete or traced."""
    example = "give a random key, for example jax.random.key(0)"
    if not isinstance(key, jax.Array | np.ndarray):
        raise UserError(f"{name} is {short_repr(key)}; {example}")
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    one = () if typed else jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0))).shape
    if not typed and (key.dtype != np.uint32 or key.shape[key.ndim - len(one) :] != one):
        raise UserError(f"{name} is an array of {key.dtype} and shape {key.shape}; {example}")
    if key.shape != one:
        raise UserError(f"{name} has shape {key.shape}; give one key, and use jax.vmap for many")

"""Random programs of one world: what JAX can trace, put together by chance.

`program(seed)` is a function of a vector, a matrix, a whole number and a random key. The same seed gives the same
program. Numbers stay of the order of one, so that rounding is not amplified.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

LENGTH = 4
"""Of a program's vector; its matrix is (2, LENGTH)."""


def program(seed: int, arithmetic: bool = False) -> Callable:
    """`(vector, matrix, count, key) -> arrays`; what is `arithmetic` needs no key, and can be a single kernel."""
    rng = np.random.default_rng(seed)
    parts = [_part(rng, 2, arithmetic) for _ in range(rng.integers(1, 4))]
    constant = rng.normal(size=LENGTH)
    outer = rng.choice(["none", "none", "gradient", "hessian", "jit", "tangent"])
    if not all(part.differentiable for part in parts):
        outer = "none"

    def flow(x, matrix, count, key):
        x = x + jnp.asarray(constant, x.dtype)

        def passage(x, _):
            for part in parts:
                x = part(x, matrix, count, key)
            return x, None

        return jax.lax.scan(passage, x, length=2)[0] if arithmetic else passage(x, None)[0]

    def function(x, matrix, count, key=None):
        match outer:
            case "gradient":
                return jax.grad(lambda x, matrix: _scalar(flow(x, matrix, count, key)), (0, 1))(x, matrix)
            case "hessian":
                return jax.jacfwd(jax.jacrev(lambda x: _scalar(flow(x, matrix, count, key))))(x)
            case "jit":
                return jax.jit(flow)(x, matrix, count, key)
            case "tangent":
                return jax.jvp(lambda x: flow(x, matrix, count, key), (x,), (jnp.ones_like(x),))
        return flow(x, matrix, count, key), count + 1, x > 0

    return function


def worlds(seed: int, number: int, dtype, arithmetic: bool = False) -> tuple[jax.Array, ...]:
    """Arguments of a program, of a number of worlds."""
    rng = np.random.default_rng(seed)
    x, matrix = rng.normal(size=(number, LENGTH)), rng.normal(size=(number, 2, LENGTH))
    count = jnp.asarray(rng.integers(0, 9, number), jnp.int32)
    keys = () if arithmetic else (jax.random.split(jax.random.key(seed), number),)
    return jnp.asarray(x, dtype), jnp.asarray(matrix, dtype), count, *keys


def _scalar(x):
    return jnp.sum(jnp.sin(x) * jnp.arange(1.0, 1 + len(x), dtype=x.dtype))


def _part(rng: np.random.Generator, depth: int, arithmetic: bool) -> Callable:
    """A function of (vector, matrix, count, key) that gives a vector; `differentiable` if it is so in every way."""
    leaves = [name for name in _LEAVES if not arithmetic or name in _ARITHMETIC]
    nests = [name for name in _NESTS if not arithmetic or name in _ARITHMETIC]
    name = rng.choice(leaves + 3 * nests if depth else leaves)
    if name in _LEAVES:
        function, differentiable = _LEAVES[name](rng), name not in _WITHOUT
    else:
        inner = [_part(rng, depth - 1, arithmetic) for _ in range(rng.integers(1, 4))]

        def body(x, matrix, count, key):
            for part in inner:
                x = part(x, matrix, count, key)
            return jnp.tanh(x)

        differentiable = all(part.differentiable for part in inner) and name not in _WITHOUT
        name = "scan" if name == "gradient" and not differentiable else name
        function = _NESTS[name](rng, body)

    def part(x, matrix, count, key):
        return function(x, matrix, count, key)

    part.differentiable = differentiable
    return part


_LEAVES: dict[str, Callable] = {}
_NESTS: dict[str, Callable] = {}
_ARITHMETIC = {
    *(
        "elementwise",
        "square roots",
        "sums",
        "logic",
        "whole numbers",
        "bits",
        "shapes",
        "transposes",
        "padding",
        "parts",
    ),
    *(
        "gather",
        "stop",
        "error function",
        "norm",
        "dynamic slice",
        "dynamic update",
        "indexed",
        "custom_jvp",
        "custom_vjp",
    ),
    *("scan", "counted loop", "jit", "checkpoint", "vmap", "map", "gradient"),
}
"""Of which XLA's CPU compiler can make a single kernel."""
_WITHOUT = {"while", "reduce_window", "reduce", "custom_vjp"}


def _leaf(name: str):
    def register(make):
        _LEAVES[name] = make
        return make

    return register


def _nest(name: str):
    def register(make):
        _NESTS[name] = make
        return make

    return register


def _plain(name: str, function: Callable) -> None:
    _LEAVES[name] = lambda rng: lambda x, matrix, count, key: function(x, matrix)


_plain("elementwise", lambda x, m: jnp.where(x > 0.1, jnp.sin(x), x**2 / (1 + jnp.abs(x))) + 0.1 * jnp.exp(-(x**2)))
_plain("square roots", lambda x, m: jnp.sqrt(1 + x * x) - jnp.log1p(x * x) * jnp.arctan2(x, 1 + x * x))
_plain("matrix product", lambda x, m: m.T @ jnp.tanh(m @ x))
_plain("outer product", lambda x, m: jnp.tanh(jnp.outer(x, m[0])) @ m[1] / LENGTH)
_plain("solve", lambda x, m: jnp.linalg.solve(3 * jnp.eye(LENGTH, dtype=x.dtype) + 0.1 * jnp.outer(x, x), x))
_plain("sort", lambda x, m: jnp.sort(x)[::-1] * 0.9)
_plain("argsort", lambda x, m: x[jnp.argsort(-x)])
_plain("cumulative sum", lambda x, m: jnp.cumsum(x) / LENGTH)
_plain("cumulative extremes", lambda x, m: jax.lax.cummax(x) - 0.5 * jax.lax.cumlogsumexp(x))
_plain("argmax", lambda x, m: x * (1 + 0.1 * jnp.argmax(x)) - 0.1 * jnp.argmin(m[0]))
_plain("sums", lambda x, m: x - jnp.mean(x) + jnp.max(m, axis=0) * jnp.prod(jnp.tanh(x)))
_plain("logic", lambda x, m: x * jnp.any(x > 1) + jnp.all(m > -1, axis=0) * 0.5)
_plain("whole numbers", lambda x, m: x + 0.1 * (jnp.round(3 * m[0]).astype(jnp.int32) // 2 % 3))
_plain("bits", lambda x, m: x + 0.01 * ((jnp.floor(5 * x).astype(jnp.int32) << 1) & 7 ^ 3).astype(x.dtype))
_plain("shapes", lambda x, m: jnp.flip(jnp.concatenate([m, m[:, ::2]], axis=1).reshape(3, LENGTH), 0)[1] + x)
_plain("transposes", lambda x, m: (jnp.stack([x, m[0], m[1]]).T.reshape(-1)[:LENGTH] + jnp.roll(x, 1)) / 2)
_plain("padding", lambda x, m: jax.lax.pad(x, jnp.asarray(0.3, x.dtype), [(1, -2, 1)])[:LENGTH] + x)
_plain("parts", lambda x, m: jnp.stack([part[0] for part in jnp.split(x, LENGTH)]) - sum(jnp.unstack(m)))
_plain("gather", lambda x, m: x[jnp.array([2, 0, 1, 1])] + m[1, jnp.array([0, 0, 3, 2])])
_plain("scatter", lambda x, m: x.at[jnp.array([0, 2, 0])].add(m[0, :3]).at[1].set(0.5))
_plain("einsum", lambda x, m: jnp.einsum("ij,j->j", m, x) / 2)
_plain("segment sum", lambda x, m: jax.ops.segment_sum(x, jnp.array([0, 1, 1, 3]), LENGTH))
_plain("fast fourier transform", lambda x, m: jnp.abs(jnp.fft.fft(x)).astype(x.dtype) / LENGTH + x)
_plain("convolution", lambda x, m: jnp.convolve(x, jnp.tanh(m[0, :3]), "same"))
_plain("associative scan", lambda x, m: jax.lax.associative_scan(lambda a, b: a * 0.5 + b, x))
_plain("reshaped sum", lambda x, m: x + m.reshape(2, 2, -1).sum((0, 2)).repeat(2) * 0.2)
_plain("empty", lambda x, m: x + jnp.zeros((0, LENGTH), x.dtype).sum(0))
_plain("error function", lambda x, m: jax.scipy.special.erf(x) + jax.nn.gelu(m[1]) * 0.1)
_plain("stop", lambda x, m: x * jax.lax.stop_gradient(jnp.cos(x)))
_plain("complex", lambda x, m: jnp.real(jnp.exp(1j * x) * (m[0] + 0.5j)).astype(x.dtype))
_plain("half precision", lambda x, m: x + jnp.clip(m[0], -0.5, 0.5).astype(jnp.float16).astype(x.dtype) * 0.1)
_plain("top", lambda x, m: x + jax.lax.top_k(m[0], 2)[0].sum())
_plain("norm", lambda x, m: x / (1 + jnp.linalg.norm(m)))


@_leaf("dynamic slice")
def _(rng):
    return lambda x, m, count, key: x + jax.lax.dynamic_slice(m, (jnp.zeros_like(count), count % LENGTH), (1, 1))[0]


@_leaf("dynamic update")
def _(rng):
    return lambda x, m, count, key: jax.lax.dynamic_update_slice(x, 0.5 * m[0, :2], (count % LENGTH,))


@_leaf("indexed")
def _(rng):
    table = rng.normal(size=(40, LENGTH))
    return lambda x, m, count, key: x + jnp.asarray(table, x.dtype)[count % 40]


@_leaf("random numbers")
def _(rng):
    salt = int(rng.integers(100))
    return lambda x, m, count, key: x + 0.1 * jax.random.normal(jax.random.fold_in(key, salt), x.shape, x.dtype)


@_leaf("random choice")
def _(rng):
    return lambda x, m, count, key: (
        jax.random.permutation(key, x) + jax.random.uniform(jax.random.split(key, 2)[1], (), x.dtype)
    )


@_leaf("reduce")
def _(rng):
    factor = float(rng.uniform(0.1, 0.5))

    def function(x, m, count, key):
        zero = jnp.zeros((), x.dtype)
        return x + jax.lax.reduce(jnp.tanh(m), zero, lambda a, b: a + factor * b * b, (0,))

    return function


@_leaf("reduce_window")
def _(rng):
    width = int(rng.integers(2, 4))

    def function(x, m, count, key):
        zero = jnp.zeros((), x.dtype)
        return jax.lax.reduce_window(jnp.tanh(x), zero, lambda a, b: a + b * b, (width,), (1,), "SAME")

    return function


@_leaf("several reduced")
def _(rng):
    def function(x, m, count, key):
        first = (jnp.asarray(-9.0, x.dtype), jnp.asarray(0, jnp.int32))
        pairs = (jax.lax.stop_gradient(x), jnp.arange(LENGTH, dtype=jnp.int32))

        def larger(a, b):
            first = a[0] >= b[0]
            return jnp.where(first, a[0], b[0]), jnp.where(first, a[1], b[1])

        largest, index = jax.lax.reduce(pairs, first, larger, (0,))
        return x + 0.1 * largest + 0.1 * index

    return function


@_leaf("custom_jvp")
def _(rng):
    @jax.custom_jvp
    def function(x):
        return jnp.sin(x) + x

    function.defjvp(lambda x, dx: (function(*x), 0.5 * dx[0]))
    return lambda x, m, count, key: function(x)


@_leaf("custom_vjp")
def _(rng):
    @jax.custom_vjp
    def function(x, m):
        return jnp.cos(x) * m[0]

    function.defvjp(lambda x, m: (function(x, m), m), lambda m, bar: (0.7 * bar * m[1], jnp.zeros_like(m)))
    return lambda x, m, count, key: function(x, m)


@_nest("scan")
def _(rng, body):
    length, reverse, unroll = int(rng.integers(1, 6)), bool(rng.integers(2)), int(rng.choice([1, 1, 2]))
    constant = rng.normal(size=LENGTH) * 0.1

    def function(x, m, count, key):
        def advance(carry, row):
            x, count = carry
            own_key = None if key is None else jax.random.fold_in(key, count)
            x = body(x + jnp.asarray(constant, x.dtype), m, count, own_key) + 0.1 * row
            return (x, count + 1), (x[0], count)

        (x, count), (firsts, counts) = jax.lax.scan(
            advance, (x, count), jnp.tile(m, (3, 1))[:length], reverse=reverse, unroll=unroll
        )
        return x + jnp.mean(firsts) + 0.01 * counts[-1].astype(x.dtype)

    return function


@_nest("scan of nothing")
def _(rng, body):
    return lambda x, m, count, key: jax.lax.scan(lambda x, _: (body(x, m, count, key), x), x, length=0)[0]


@_nest("counted loop")
def _(rng, body):
    times = int(rng.integers(1, 5))
    return lambda x, m, count, key: jax.lax.fori_loop(
        0, times, lambda i, x: body(x, m, (count + i).astype(jnp.int32), key), x
    )


@_nest("while")
def _(rng, body):
    def function(x, m, count, key):
        def unfinished(carry):
            i, _, on = carry
            return (i < count % 5) & on

        def advance(carry):
            i, x, _ = carry
            x = body(x, m, i, key)
            return i + 1, x, jnp.max(x) < 0.9

        return jax.lax.while_loop(unfinished, advance, (0 * count, x, jnp.ones((), bool)))[1]

    return function


@_nest("cond")
def _(rng, body):
    return lambda x, m, count, key: jax.lax.cond(
        x[0] > 0.2, lambda x: body(x, m, count, key), lambda x: 0.5 * x + m[0], x
    )


@_nest("switch")
def _(rng, body):
    return lambda x, m, count, key: jax.lax.switch(
        count % 3, [jnp.sin, lambda x: body(x, m, count, key), lambda x: x * m[1]], x
    )


@_nest("jit")
def _(rng, body):
    return lambda x, m, count, key: jax.jit(lambda x: body(x, m, count, key))(x)


@_nest("checkpoint")
def _(rng, body):
    return lambda x, m, count, key: jax.checkpoint(lambda x: body(x, m, count, key))(x)


@_nest("vmap")
def _(rng, body):
    return lambda x, m, count, key: jax.vmap(lambda row: body(row + x, m, count, key))(m).sum(0)


@_nest("map")
def _(rng, body):
    return lambda x, m, count, key: jax.lax.map(lambda row: body(row + x, m, count, key), m).sum(0)


@_nest("gradient")
def _(rng, body):
    return lambda x, m, count, key: jnp.tanh(jax.grad(lambda x: _scalar(body(x, m, count, key)))(x))

"""Strict JAX for all tests: float64 (float32 where marked), no rank promotion, one shared compilation cache."""

import functools
import gc
import importlib.metadata
import importlib.util
import os
from pathlib import Path

# Before JAX is imported, and for the processes that tests start, too.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parent.parent / ".jax_cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "0")
# Compile without most optimizations, in half of the time; with `XLA_FLAGS=`, as in `make test-slow`, as for users. Laws
# about compiled programs ask for the latter by `helpers.jit_optimized`. Later versions of JAX lack one of the flags.
if importlib.metadata.version("jaxlib").startswith("0.10."):
    flags = "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0"
    # One part of a program at a time: two workers keep two cores busy, and to split costs a quarter of the time.
    os.environ.setdefault("XLA_FLAGS", f"{flags} --xla_cpu_parallel_codegen_split_count=1")
# Instructions do not name the lines of source that they come from: a sixth of the time of lowering.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")

import jax
import jaxtyping
import pytest
import shapes
from jax._src.interpreters import mlir

PACKAGE = Path(importlib.util.find_spec("jaxdrones").submodule_search_locations[0])
MODULES = {".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in PACKAGE.rglob("*.py")}
jaxtyping.jaxtyped = shapes.jaxtyped
jaxtyping.install_import_hook(sorted(MODULES), "shapes.checked")

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.devices()  # one, whichever test comes first: `jaxdrones train` makes each core one if JAX does not run

# All programs are lowered in one context: to make one is a third of lowering, and each slows down those after it.
if hasattr(mlir, "make_ir_context"):  # not promised by JAX
    mlir.make_ir_context = functools.cache(mlir.make_ir_context)

gc.freeze()
gc.set_threshold(50_000)  # tracing makes many objects and little garbage: a twentieth of the time

pytest_plugins = ["shards"]


def pytest_runtest_setup(item):
    """Skip a test marked with `needs` where a library that it names is not installed."""
    for mark in item.iter_markers("needs"):
        for library in mark.args:
            if importlib.util.find_spec(library) is None:
                pytest.skip(f"{library} is not installed")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """Skip a test of the viewer where its page could not be built, because there is no npm."""
    try:
        return (yield)
    except ImportError as error:
        if "page is not built" in str(error):
            pytest.skip(str(error))
        raise


@pytest.fixture(autouse=True)
def precision(request):
    with jax.enable_x64(request.node.get_closest_marker("float32") is None):
        yield


def pytest_sessionfinish():
    """Leave what the tests made to the end of the process, not to pytest's collections of garbage: three seconds."""
    gc.freeze()

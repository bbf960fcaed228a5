"""Programs for an accelerator, lowered on a machine without one: nothing that is meant for CPUs is in them."""

import functools

import jax
import jax.numpy as jnp
import pytest
from jax import export

import jaxdrones as jd
from benchmarks.cameras_scenes import objects20, poses
from jaxdrones.accelerate import compiler
from jaxdrones.learning import compilation
from jaxdrones.training import presets
from jaxdrones.training.algorithms import ALGORITHMS, learner

pytestmark = [pytest.mark.float32, pytest.mark.slow]

FOR_CPUS = ("xla_cpu", "inlineable", "custom_call", "callback")
"""Attributes of a single kernel and of stored results; calls of libraries or of Python."""


@pytest.fixture
def accelerator(monkeypatch):
    """What the package sees on a machine with an accelerator, by which it chooses while it is traced.

    Traced programs are forgotten before and after.
    """
    with monkeypatch.context() as patch:
        patch.setattr(jax, "default_backend", lambda: "gpu")
        _forget()
        yield
    _forget()


def _forget():
    jax.clear_caches()
    compiler._known.cache_clear()


def lowered(function, *arguments) -> str:
    """The program for CUDA; compiler options are not in its text."""
    exported = export.export(jax.jit(function), platforms=["cuda"])(*arguments)
    assert exported.platforms == ("cuda",)
    return exported.mlir_module()


def found(program: str) -> list[str]:
    return [name for name in FOR_CPUS if name in program]


STEP = jd.make_step(effects=(jd.drag,), rotors=jd.lagging_rotors)


def world():
    state = jd.State.at_rest(jnp.array([[0.0, 0.0, 1.0]]))
    return state, jnp.full((1, 4), 15000.0)


def worlds(count=8):
    return jax.tree.map(lambda x: jnp.stack([x] * count), world())


def fly(state, rpm):
    return STEP(jd.repeat(jd.load_params("cf2x"), 1), state, rpm).pos


def test_a_step_for_a_cpu_holds_what_the_other_tests_look_for():
    assert found(lowered(fly, *world()))


def test_no_compiler_option_is_for_an_accelerator(accelerator):
    assert compiler.kernel_options() == {}
    assert compiler.training_options(large_arrays=True) == compiler.training_options(large_arrays=False) == {}


def test_the_plant_and_its_gradient_hold_nothing_for_cpus(accelerator):
    def miss(state, rpm):
        return jnp.sum(fly(state, rpm) ** 2)

    assert not found(lowered(fly, *world()))
    gradient = lowered(jax.grad(miss, 1), *world())
    assert not found(gradient)
    assert gradient.count("optimization_barrier") <= 1  # of jax.checkpoint; none that only forces storage


def test_over_worlds_is_vmap_on_an_accelerator(accelerator):
    """No chunks, which are loops over worlds."""
    program = lowered(jd.over_worlds(fly), *worlds())
    assert not found(program) and "stablehlo.while" not in program
    assert program.count("stablehlo.") == lowered(jax.vmap(fly), *worlds()).count("stablehlo.")


def test_an_environment_step_holds_nothing_for_cpus(accelerator):
    episodes = jd.envs.AutoReset(jd.make("hover"))
    key = jax.random.key(0)
    _, episode = jax.eval_shape(episodes.reset, key)
    action = jnp.zeros((1, episodes.env.action_size))
    assert not found(lowered(episodes.step, key, episode, action))


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_an_update_of_a_learner_holds_nothing_for_cpus(algorithm, accelerator):
    trained_by = learner(algorithm)
    env, config = presets.preset("hover", algorithm)
    update = compilation.jit(functools.partial(trained_by.update, env, config), env, config)
    state = jax.eval_shape(lambda key: trained_by.init(key, env, config), jax.random.key(0))
    assert not found(lowered(update, state))


def test_a_camera_holds_nothing_for_cpus(accelerator):
    camera = jd.Camera(resolution=(8, 6), field_of_view=80, far=12.0)
    scene, params = objects20(), jd.repeat(jd.load_params("cf2x"), 1)
    assert not found(lowered(jax.vmap(lambda state: jd.render(scene, params, state, camera).depth), poses(2)))

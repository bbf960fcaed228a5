"""Programs for an accelerator, lowered on a machine without one: nothing that is meant for CPUs is in them."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

import jaxdrones as jd
from benchmarks.cameras_scenes import objects20, poses
from jaxdrones.accelerate import compiler, fitting
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


def test_a_step_over_worlds_is_no_loop_over_worlds_on_an_accelerator(accelerator):
    program = lowered(jd.over_worlds(fly), *worlds())
    assert not found(program) and "stablehlo.while" not in program


def flight(state, rpm, length=12):
    """Final position after 12 steps with the same command."""
    params = jd.repeat(jd.load_params("cf2x"), 1)
    return jax.lax.scan(lambda state, _: (STEP(params, state, rpm), None), state, length=length)[0].pos


def miss(state, rpms):
    params = jd.repeat(jd.load_params("cf2x"), 1)
    return jnp.sum(jax.lax.scan(lambda state, rpm: (STEP(params, state, rpm), None), state, rpms)[0].pos ** 2)


def of_loops(program: str) -> set[str]:
    """Types of the numbers that the arithmetic of a program's loops and functions is of."""
    _, _, loops = program.partition("stablehlo.while")
    return set(re.findall(r"stablehlo\.(?:add|multiply|subtract) .*: tensor<(\w+)>", loops))


def test_the_loop_of_a_flight_on_an_accelerator_is_of_one_array_per_number(accelerator):
    """Each array of `vmap`, (worlds, 1, 3), would be a kernel of its own."""
    program = lowered(jd.over_worlds(flight), *worlds())
    assert not found(program) and of_loops(program) == {"8xf32", "f32", "i32"}


def test_a_kernel_of_an_accelerator_has_as_many_steps_as_divide_the_flight(accelerator):
    def steps(length):
        program = jax.make_jaxpr(jd.over_worlds(functools.partial(flight, length=length)))(*worlds())
        loops = [eqn for eqn in fitting._equations(program.jaxpr) if eqn.primitive.name == "scan"]
        return {eqn.params["unroll"] for eqn in loops}

    assert (steps(12), steps(11)) == ({4}, {1})


def test_a_step_within_vmap_on_an_accelerator_is_of_one_array_per_number(accelerator):
    step = jd.make_step(effects=(jd.drag,), rotors=jd.lagging_rotors, substeps=11)
    params = jd.repeat(jd.load_params("cf2x"), 1)
    program = lowered(jax.vmap(lambda state, rpm: step(params, state, rpm)), *worlds())
    assert not found(program) and of_loops(program) == {"8xf32", "f32", "i32"}


def test_flights_and_gradients_over_worlds_on_an_accelerator_are_those_of_vmap():
    states, rpm = worlds()
    rpms = jnp.stack([rpm * (1 + 0.01 * k) for k in range(6)], axis=1)
    gradient = jax.value_and_grad(miss, 1)
    expected = jax.jit(jax.vmap(flight))(states, rpm), jax.jit(jax.vmap(gradient))(states, rpms)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax, "default_backend", lambda: "gpu")
        _forget()
        around = jax.jit(jax.grad(lambda rpms: jnp.sum(jd.over_worlds(miss)(states, rpms))))(rpms)
        flown = jd.over_worlds(flight)(states, rpm), jd.over_worlds(gradient)(states, rpms)
    _forget()
    for ours, theirs in zip(jax.tree.leaves((flown, around)), jax.tree.leaves((expected, expected[1][1])), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-5 * np.abs(theirs).max())


def test_several_iterations_of_a_loop_are_a_kernel_and_divide_its_length():
    def looped(numbers, inner=1):
        def body(x, _):
            x = jax.lax.scan(lambda x, _: (jnp.sin(x), None), x, length=inner)[0] if inner > 1 else jnp.sin(x)
            return x, None

        program = jax.make_jaxpr(lambda x: body(x, None)[0])(jnp.zeros(numbers))
        return lambda length: fitting.iterations_at_once(program.jaxpr, length)

    of_a_third = looped(fitting._MAX_AT_ONCE // 3)
    assert [of_a_third(length) for length in (1, 2, 3, 4, 7, 9, 100)] == [1, 2, 3, 2, 1, 3, 2]
    assert looped(2 * fitting._MAX_AT_ONCE)(12) == 1
    assert looped(1, inner=3)(12) == 1


def test_an_environment_step_holds_nothing_for_cpus(accelerator):
    episodes = jd.envs.AutoReset(jd.make("hover"))
    key = jax.random.key(0)
    _, episode = jax.eval_shape(episodes.reset, key)
    action = jnp.zeros((1, episodes.env.action_size))
    assert not found(lowered(episodes.step, key, episode, action))


def test_an_environment_multiplies_matrices_in_the_precision_of_their_type():
    """A GPU would round the positions of a race to millimeters."""
    env = jd.make("race")
    _, world = jax.eval_shape(env.reset, jax.random.key(0))
    action = jnp.zeros((env.drones, env.action_size))
    for program in lowered(env.reset, jax.random.key(0)), lowered(env.step, jax.random.key(0), world, action):
        products = [line for line in program.splitlines() if "stablehlo.dot_general" in line]
        assert products and all("[HIGHEST, HIGHEST]" in line for line in products)


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

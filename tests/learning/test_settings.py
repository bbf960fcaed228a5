"""Settings that make no sense are refused before anything is trained; those that do, and traced ones, are not."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import mostly_slow_rows

from jaxdrones import envs
from jaxdrones.learning import bptt, ppo, shac
from jaxdrones.training import presets
from jaxdrones.training.recipe import Recipe

LEARNERS = {"bptt": bptt, "shac": shac, "ppo": ppo}
KEY = jax.random.key(0)
WORDS = {"hidden_sizes", "set_sizes", "critic_hidden_sizes", "gradient", "surrogate"}
SWITCHES = {"per_agent", "centralized_critic", "privileged_critic", "image_gradient"}
ZERO_MAKES_SENSE = {
    *("obs_stats_freeze", "restart_fraction", "anneal_fraction", "gradient_decay"),
    *("gamma", "gae_lambda", "adam_b2", "entropy_coef", "value_coef", "recurrent_size"),
}
FRACTIONS = {
    *("obs_stats_freeze", "restart_fraction", "anneal_fraction", "gradient_decay"),
    *("gamma", "gae_lambda", "adam_b2", "terminal_value_warmup", "target_update_rate"),
}
INFINITY_MAKES_SENSE = {"obs_stats_window", "max_grad_norm", "outlier_gradient"}


def numbers(learner):
    return [f.name for f in dataclasses.fields(learner.Config) if f.name not in WORDS | SWITCHES]


def nonsense_of(name, default):
    yield from (-1, np.nan, -np.inf, "a", None, [1.0], True, 1j)
    if name not in ZERO_MAKES_SENSE and default != 0:
        yield 0
    if name not in INFINITY_MAKES_SENSE:
        yield np.inf
    if name in FRACTIONS:
        yield from (1.0001, 2)
    if isinstance(default, int):
        yield 2.5


NUMBERS = [(name, field) for name, learner in LEARNERS.items() for field in numbers(learner)]


@pytest.mark.parametrize(("learner", "field"), NUMBERS)
def test_every_number_is_refused_where_it_makes_no_sense(learner, field):
    for value in nonsense_of(field, getattr(LEARNERS[learner].Config(), field)):
        with pytest.raises(ValueError, match=rf"^{field} is .*; give "):
            LEARNERS[learner].Config(**{field: value})


@pytest.mark.parametrize("learner", LEARNERS)
def test_layers_switches_and_words_are_refused_where_they_make_no_sense(learner):
    config = LEARNERS[learner].Config
    for sizes in ((), (0,), (-1,), (2.5,), 32, "32", None, (32, "a")):
        with pytest.raises(ValueError, match=r"sizes is .*; give"):
            config(hidden_sizes=sizes)
        with pytest.raises(ValueError, match=r"sizes is .*; give"):
            config(set_sizes=sizes)
    for value in ("yes", 1, None, np.nan):
        with pytest.raises(ValueError, match=r"per_agent is .*; give True or False"):
            config(per_agent=value)
    for field, value in ("gradient", "surogate"), ("surrogate", "a step"), ("critic_hidden_sizes", (0,)):
        if field in {f.name for f in dataclasses.fields(config)}:
            with pytest.raises(ValueError, match=field):
                config(**{field: value})


@pytest.mark.parametrize("learner", [shac, ppo])
def test_a_value_of_an_infinite_sum_needs_a_discount_below_one(learner):
    with pytest.raises(ValueError, match="gamma is 1; give a number of at least 0 and below 1"):
        learner.Config(gamma=1)
    assert bptt.Config(gamma=1).gamma == 1


def test_what_vanishes_or_overflows_in_single_precision_is_refused():
    for value in ("1e-50", "1e.50"):
        with pytest.raises(ValueError, match=f"learning_rate is {value}; give a positive number"):
            bptt.Config(learning_rate=float(value.replace(".", "")))


def test_settings_that_contradict_each_other_are_refused():
    with pytest.raises(
        ValueError,
        match=r"max_learning_rate is 1e-06; give a number of at least 1e-05 \(not below min_learning_rate",
    ):
        ppo.Config(max_learning_rate=1e-6)
    with pytest.raises(ValueError, match="worlds is 100; give a multiple of minibatches, 8"):
        ppo.Config(worlds=100)


@pytest.mark.slow
@pytest.mark.parametrize("task, algorithm", presets._CONFIGS)
def test_every_preset_makes_sense(task, algorithm):
    for realistic in (False, True):
        Recipe.of(task, algorithm, realistic)


@pytest.mark.parametrize(
    "task, options",
    mostly_slow_rows([("crowd", {"obstacles": 1.0}), ("race", {"contact": True})], [("race", {"contact": True})]),
)
def test_contact_can_be_trained(task, options):
    """Two physics steps in a control step, as in training without contact, are too few: contact would be unstable."""
    practice, _ = presets.preset(task, "bptt", practice=True, **options)
    flown, _ = presets.preset(task, "bptt", **options)
    assert practice.physics.dt == flown.physics.dt


@pytest.mark.parametrize("rotors, gradient", [("instant", "surrogate"), ("lagging", "exact")])
def test_the_preset_of_hover_has_no_surrogate_without_the_lag_of_the_rotors(rotors, gradient):
    """Trained with it, not one of 1,000 starts succeeded; with the exact gradient 998 or more, three seeds."""
    assert presets.preset("hover", "bptt", rotors=rotors)[1].gradient == gradient


def test_arrays_of_one_number_and_numbers_of_numpy_are_numbers():
    ppo.Config(updates=np.int64(3), worlds=jnp.asarray(8), learning_rate=np.float32(1e-3), gamma=jnp.asarray(0.9))


@pytest.mark.parametrize("learner", LEARNERS)
def test_numbers_that_are_not_shapes_may_be_traced(learner):
    shapes = {"worlds", "horizon", "recurrent_size", "epochs", "minibatches", "critic_steps"}
    traced = [name for name in numbers(LEARNERS[learner]) if name not in shapes]

    def made(x):
        config = LEARNERS[learner].Config(**dict.fromkeys(traced, x))
        return sum(getattr(config, name) for name in traced)

    np.testing.assert_allclose(jax.jit(jax.vmap(made))(-jnp.arange(3.0)), -len(traced) * np.arange(3.0))


@pytest.mark.parametrize("learner", LEARNERS)
def test_settings_pass_through_trees_of_jax(learner):
    """Registered as a tree by a user, they are rebuilt with placeholders, shapes and traced numbers in place."""
    config = dataclasses.make_dataclass("Config", [], bases=(LEARNERS[learner].Config,), frozen=True)
    jax.tree_util.register_dataclass(
        config, ["learning_rate", "restart_fraction"], _rest(config, ["learning_rate", "restart_fraction"])
    )
    doubled = jax.jit(lambda c: jax.tree.map(lambda x: -2 * x, c.learning_rate))(config())
    np.testing.assert_allclose(doubled, -2 * config().learning_rate, rtol=1e-6)
    assert jax.eval_shape(lambda c: c, config()).restart_fraction.shape == ()
    jax.vmap(lambda c, x: c.restart_fraction * x, in_axes=(None, 0))(config(), jnp.arange(3.0))


def _rest(config, names):
    return [f.name for f in dataclasses.fields(config) if f.name not in names]


@pytest.mark.parametrize("learner", LEARNERS)
def test_an_unknown_setting_names_the_closest_one(learner):
    config = LEARNERS[learner].Config
    with pytest.raises(TypeError, match=r"unexpected keyword argument 'learning_rat'; did you mean 'learning_rate'\?"):
        config(learning_rat=1e-3)
    with pytest.raises(TypeError, match=r"did you mean 'horizon'\?"):
        dataclasses.replace(config(), horizn=3)


@pytest.mark.parametrize("name", LEARNERS)
def test_a_learner_takes_its_own_settings_and_no_others(name):
    env, learner = envs.make("hover"), LEARNERS[name]
    for other, module in LEARNERS.items():
        if other != name:
            with pytest.raises(ValueError, match=rf"config is {other}\.Config; give .*{name}\.Config"):
                learner.train(KEY, env, module.Config())
    with pytest.raises(ValueError, match=rf"config is a dictionary; give jaxdrones\.learning\.{name}\.Config"):
        learner.train(KEY, env, dict(updates=3))
    with pytest.raises(ValueError, match=r"config is 'fast'"):
        learner.train(KEY, env, "fast")
    with pytest.raises(ValueError, match=r"key is 0; give a random key, for example jax\.random\.key\(0\)"):
        learner.train(0, env, learner.Config())


@pytest.mark.parametrize(
    "setting",
    [dict(learning_rate=-1), dict(gradient_decay=2.0), dict(updates=0), dict(worlds=-3), dict(hidden_sizes=(0,))],
)
def test_a_recipe_refuses_nonsense_too(setting):
    with pytest.raises(ValueError, match=rf"{next(iter(setting))} is .*; give"):
        Recipe.of("hover", "bptt", **setting)

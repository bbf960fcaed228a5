"""`train` with a user's own network, callbacks, loggers, and a state to continue from."""

import contextlib
import csv
import dataclasses
import itertools
import sys
import types

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from double_integrator import SMALL, Cue, DoubleIntegrator
from flax import nnx
from helpers import assert_close, jit_unoptimized, mostly_slow, name_of

from jaxdrones.learning import Diverged, bptt, checkpoint, evaluate, loggers, ppo, result
from jaxdrones.learning.networks import MLP, OwnNetwork, Policy

KEY = jax.random.key(0)
SIZES = (2, 8, 1)
EACH_LEARNER = pytest.mark.parametrize("learner", mostly_slow(SMALL, [ppo]), ids=name_of)


class NnxNetwork(nnx.Module):
    def __init__(self, kernels):
        self.layers = nnx.List([nnx.Linear(*kernel.shape, rngs=nnx.Rngs(0)) for kernel, _ in kernels])
        for layer, (kernel, bias) in zip(self.layers, kernels, strict=True):
            layer.kernel[...], layer.bias[...] = kernel, bias

    def __call__(self, x):
        return self.layers[1](jnp.tanh(self.layers[0](x)))


def equinox_network(kernels):
    eqx = pytest.importorskip("equinox")
    network = eqx.nn.MLP(*(SIZES[0], SIZES[2], SIZES[1]), depth=1, activation=jnp.tanh, key=KEY)
    weights = [x for kernel, bias in kernels for x in (kernel.T, bias)]
    return eqx.tree_at(lambda n: [x for layer in n.layers for x in (layer.weight, layer.bias)], network, weights)


class Remember(nn.Module):
    """The sum of the observations, kept in a dictionary."""

    def initial_hidden_state(self):
        return {"sum": jnp.zeros(1)}

    @nn.compact
    def __call__(self, state, obs):
        total = state["sum"] + obs
        return {"sum": total}, nn.Dense(1)(total)


OWN = {"nnx": NnxNetwork, "equinox": equinox_network}


@pytest.mark.slow
@pytest.mark.parametrize("library", mostly_slow(OWN, ["equinox"]))
def test_the_gradient_of_a_network_is_the_same_in_every_library(library):
    """The gradient of a flight of the double integrator, of the same weights; that of flax linen is the reference."""
    params = MLP(SIZES[1:2], SIZES[2]).init(KEY, jnp.zeros(2))
    kernels = [(layer["kernel"], layer["bias"]) for layer in params["params"].values()]
    network = OWN[library](kernels)
    env, config = DoubleIntegrator(), dataclasses.replace(SMALL[bptt], max_grad_norm=1e-3, learning_rate=1e-3)
    state = bptt.init(KEY, env, config, network)
    reference = state.replace(policy=state.policy.replace(params=params, network=MLP(SIZES[1:2], SIZES[2])))
    reference = reference.replace(opt_state=bptt.init(KEY, env, config, None).opt_state)
    update = jit_unoptimized(lambda state: bptt.update(env, config, state))
    (mine, metrics), (theirs, expected) = update(state), update(reference)
    # Parameters of flax are float32, and the sums are in another order.
    np.testing.assert_allclose(metrics["gradient_norm"], expected["gradient_norm"], rtol=1e-6)
    entries = lambda tree: np.sort(np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)]))  # noqa: E731
    np.testing.assert_allclose(entries(mine.policy.params), entries(theirs.policy.params), atol=1e-5)  # a step is 1e-3


@pytest.mark.slow
@pytest.mark.float32
@EACH_LEARNER
def test_an_own_recurrent_network_learns_and_is_saved(learner, tmp_path):
    env, network = Cue(), Remember()
    result = learner.train(KEY, env, SMALL[learner], network=network)
    assert np.all(np.isfinite(result.history["reward"])) and "Remember" in repr(result.policy)
    checkpoint.save(tmp_path / "policy", result.policy)
    with pytest.raises(ValueError, match=r"network of your own, Remember; give load\(path, network"):
        checkpoint.load(tmp_path / "policy")
    loaded = checkpoint.load(tmp_path / "policy", network=network)
    state, obs = loaded.initial_hidden_state((1,)), jnp.ones((1, 1))
    for x, y in zip(loaded.act(state, obs)[1], result.policy.act(state, obs)[1], strict=True):
        np.testing.assert_array_equal(x, y)


def test_a_sequence_of_an_own_recurrent_network_is_replayed_as_it_was_flown():
    policy = Policy.init(KEY, Cue(), network=Remember())
    obs, starts = np.random.default_rng(0).normal(size=(5, 3, 1, 1)), np.zeros((5, 3), bool)
    starts[2, 0] = True
    state, flown = policy.initial_hidden_state((3, 1)), []
    for i in range(5):
        state = {"sum": jnp.where(starts[i][:, None, None], 0, state["sum"])}
        state, action = policy.act(state, obs[i])
        flown.append(action)
    np.testing.assert_allclose(policy.replay(policy.initial_hidden_state((3, 1)), obs, starts), flown, rtol=1e-12)


class Started(Remember):
    def initial_hidden_state(self):
        return jnp.ones(1)


class Forgetful(Remember):
    def __call__(self, state, obs):
        return super().__call__(state, obs)[1]


class Dropped(nnx.Linear):
    def __init__(self, size, outputs, rngs):
        super().__init__(size, outputs, rngs=rngs)
        self.dropout = nnx.Dropout(0.5, rngs=rngs)

    def __call__(self, obs):
        return super().__call__(self.dropout(obs))


def test_a_network_with_disabled_dropout_is_that_without_it():
    network = Dropped(2, 1, nnx.Rngs(0))
    network.eval()
    obs = jnp.array([[0.5, -0.2]])
    action = Policy.init(KEY, DoubleIntegrator(), network=network)(obs)
    np.testing.assert_allclose(action, jnp.tanh(nnx.Linear(2, 1, rngs=nnx.Rngs(0))(obs)), rtol=1e-6)


@pytest.mark.parametrize(
    "network, error",
    [
        (3, "3 is not a function"),
        (MLP((4,), 2), r"outputs \(2,\) .* give \(1,\)"),
        (Started(), "is not zero"),
        (Started, "network is the class Started; give an object"),
        (lambda obs: obs[:1], "network <function .* has no parameters; give a flax or equinox module"),
        (nnx.Linear(3, 1, rngs=nnx.Rngs(0)), r"network Linear raises TypeError: .*observation of .*shape \(2,\)"),
        (Dropped(2, 1, rngs=nnx.Rngs(0)), "network Dropped changes its arrays in a call, as dropout"),
        (Forgetful(), r"network Forgetful has a hidden state and returns .*; return \(hidden_state, output\)"),
    ],
)
def test_a_network_that_does_not_fit_is_refused(network, error):
    with pytest.raises(ValueError, match=error):
        bptt.train(KEY, DoubleIntegrator(), SMALL[bptt], network=network)


@pytest.mark.slow
@pytest.mark.float32
@EACH_LEARNER
def test_a_training_continued_from_a_state_is_one_long_training_and_the_callback_sees_every_update(learner):
    env, config = DoubleIntegrator(), dataclasses.replace(SMALL[learner], updates=5)
    seen, observed = [], []

    def callback(update, metrics, state):
        seen.append(metrics)
        observed.append(state.policy.obs_stats.count)
        return update == 2

    half = learner.train(KEY, env, config, callback=callback)
    rest = learner.train(KEY, env, config, state=half.train_state)
    whole = learner.train(KEY, env, config)
    assert len(seen) == 2 and int(half.train_state.step) == 2 and int(rest.train_state.step) == 5
    for name, x in whole.history.items():
        np.testing.assert_array_equal(jnp.concatenate([half.history[name], rest.history[name]]), x)
        np.testing.assert_array_equal([row[name] for row in seen], half.history[name])
    for x, y in zip(jax.tree.leaves(rest.policy), jax.tree.leaves(whole.policy), strict=True):
        np.testing.assert_array_equal(x, y)
    if learner is ppo:  # which observes all steps of its worlds
        assert observed[0] == config.worlds * config.horizon
    with pytest.raises(ValueError, match=r"state has made 5 updates; .* config.updates is 5"):
        learner.train(KEY, env, config, state=whole.train_state)
    with pytest.raises(ValueError, match="callback is not supported inside"):
        jax.eval_shape(lambda key: learner.train(key, env, config, callback=print), KEY)


@EACH_LEARNER
def test_a_training_continues_from_all_that_is_in_its_state(learner):
    """Policy, statistics, optimizer, worlds and random key; an update that only counts leaves them as they are."""
    env, config = DoubleIntegrator(), SMALL[learner]
    first = jit_unoptimized(lambda: learner.init(KEY, env, config))()
    arrays, structure = jax.tree.flatten(first.replace(step=None, key=None))
    state = jax.tree.unflatten(structure, [x ^ True if x.dtype == bool else x + 1 for x in arrays])
    state = state.replace(step=first.step + 1, key=jax.random.key(7))

    def update(env, config, state):
        return state.replace(step=state.step + 1), {"nonfinite_gradients": jnp.zeros((), int)}

    train = result.make_train(type(config), learner.init, update)
    for trained in train(KEY, env, config, state=state), train(KEY, env, config, state=state, callback=lambda *_: None):
        assert len(trained.history["nonfinite_gradients"]) == config.updates - 1
        assert trained.train_state.key == state.key and trained.train_state.step == config.updates
        assert_close(trained.train_state.replace(step=None, key=None), state.replace(step=None, key=None), 0)


def test_a_state_without_updates_left_is_refused_alone_and_in_a_program_of_the_user():
    env, config = DoubleIntegrator(), SMALL[bptt]
    state = jit_unoptimized(lambda: bptt.init(KEY, env, config))().replace(step=jnp.asarray(config.updates))

    def rate_trained(learning_rate):
        return bptt.train(KEY, env, dataclasses.replace(config, learning_rate=learning_rate), state=state)

    for train in rate_trained, jax.jit(rate_trained):
        with pytest.raises(ValueError, match=r"state has made 3 updates; give more updates, config.updates is 3"):
            train(1e-3)
    with pytest.raises(ValueError, match=r"config.updates is traced; give a number"):
        jax.jit(lambda updates: bptt.train(KEY, env, dataclasses.replace(config, updates=updates)))(5)


def counted(env, config, state):
    """Update that only counts, with gradients that are not finite."""
    return state.replace(step=state.step + 1), {"nonfinite_gradients": jnp.ones((), int)}


def test_a_training_continued_in_a_program_of_the_user_makes_the_updates_that_are_left():
    env, config, train = DoubleIntegrator(), SMALL[bptt], result.make_train(bptt.Config, bptt.init, counted)
    state = jit_unoptimized(lambda: bptt.init(KEY, env, config))().replace(step=jnp.asarray(1))
    trained = jax.jit(lambda: train(KEY, env, config, state=state))()
    assert trained.train_state.step == config.updates and len(trained.history["nonfinite_gradients"]) == 2


def test_a_training_of_few_updates_that_all_fail_has_diverged():
    train = result.make_train(bptt.Config, bptt.init, counted)
    with pytest.raises(Diverged, match="gradients were not finite in 3 updates in a row; no update had finite"):
        train(KEY, DoubleIntegrator(), SMALL[bptt])


def test_csv_gets_every_update_and_a_missing_library_is_named(tmp_path, monkeypatch):
    logger = loggers.CSV(tmp_path / "a" / "log.csv")
    for update, metrics in (1, {"reward": -1.5, "return": float("nan")}), (2, {"reward": -0.5, "return": 3.0}):
        logger(update, metrics, None)
    written = list(csv.DictReader((tmp_path / "a" / "log.csv").read_text().splitlines()))
    assert [(int(row["update"]), float(row["reward"])) for row in written] == [(1, -1.5), (2, -0.5)]
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ValueError, match="wandb is not installed; run: pip install wandb"):
        loggers.WandB()


class OneActiveRun:
    """Like MLflow, which refuses a second active run, and W&B, which returns the active one in its place.

    The libraries themselves are in tests/learning/test_loggers.py.
    """

    def __init__(self):
        self.finished, self.active = {}, None

    def start_run(self, run_name):
        assert self.active is None, "a run is already active"
        self.active, self.finished[run_name] = types.SimpleNamespace(info=types.SimpleNamespace(run_id=run_name)), []
        return self.active

    def log_metrics(self, metrics, step, run_id):
        self.finished[run_id].append(step)

    def end_run(self):
        self.active = None

    def init(self, project, name):
        if self.active is None:
            self.finished[name] = []
            self.active = types.SimpleNamespace(
                log=lambda metrics, step: self.finished[name].append(step), finish=self.end_run
            )
        return self.active


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_the_logs_of_two_seeds_are_two_runs_also_after_a_seed_that_failed(name, monkeypatch):
    library = OneActiveRun()
    monkeypatch.setitem(sys.modules, name, library)
    for folder in "seed-0", "seed-1":
        with contextlib.suppress(KeyboardInterrupt), loggers.named_loggers(name, folder) as (logger,):
            logger(1, {"reward": 1.0})
            raise KeyboardInterrupt
    assert library.finished == {"seed-0": [1], "seed-1": [1]} and library.active is None


@pytest.mark.needs("tensorboardX")
def test_tensorboard_gets_an_event_file(tmp_path):
    loggers.TensorBoard(tmp_path)(1, {"reward": 1.0})
    assert list(tmp_path.glob("events.out.tfevents*"))


def test_the_best_policy_is_kept(monkeypatch):
    reports = {1: (0.5, 0.0), 2: (0.9, -3.0), 3: (0.9, -2.0), 4: (0.2, 9.0)}

    def compiled(env, policy, episodes):
        return lambda policy, key: types.SimpleNamespace(success=reports[policy][0], mean_return=reports[policy][1])

    monkeypatch.setattr(loggers, "compile_evaluation", compiled)
    best = loggers.KeepBest(None, KEY, every=1)
    for update in reports:
        best(update, {}, types.SimpleNamespace(policy=update))
    assert best.policy == 3 and best.report.success == 0.9
    best = loggers.KeepBest(None, KEY, every=2)
    for update in reports:
        best(update, {}, types.SimpleNamespace(policy=update))
    assert best.policy == 2  # the third one was not evaluated


def test_a_policy_whose_return_is_no_number_is_replaced_by_any_other(monkeypatch):
    returns = {1: float("nan"), 2: -5.0, 3: float("nan"), 4: float("inf")}

    def compiled(env, policy, episodes):
        return lambda policy, key: types.SimpleNamespace(success=None, mean_return=returns[policy])

    monkeypatch.setattr(loggers, "compile_evaluation", compiled)
    best = loggers.KeepBest(None, KEY, every=1)
    for update in returns:
        best(update, {}, types.SimpleNamespace(policy=update))
    assert best.policy == 2


def test_a_state_that_does_not_fit_is_refused():
    """Other worlds, other networks, another learner, and what is no state."""
    env, config = DoubleIntegrator(), dataclasses.replace(SMALL[bptt], updates=5)
    state = bptt.init(KEY, env, config)
    worlds, world = state.worlds, state.worlds.episodes.world
    other = worlds.replace(episodes=worlds.episodes.replace(world=world.replace(poses=())))  # without arrays, like dt
    for wrong, change, said in (
        (state.replace(worlds=other), {}, "state is of another task or control period; continue with"),
        (state, {"worlds": 2 * config.worlds}, r"state\S+ has shape \(\d+,.*, expected"),
        (state, {"hidden_sizes": (5,)}, r"state.policy\S+ has shape .*, expected .*; continue with the environment"),
        (ppo.init(KEY, env, SMALL[ppo]), {}, "state is of jaxdrones.learning.ppo; give one of"),
        (state.policy, {}, "state is <Policy .*; give the train_state of a result"),
    ):
        with pytest.raises(ValueError, match=said):
            bptt.train(KEY, env, dataclasses.replace(config, **change), state=wrong)


def test_the_name_of_a_task_is_no_environment():
    says = r"env is 'hover'; give an environment, for example jaxdrones.make\('hover'\)"
    with pytest.raises(ValueError, match=says):
        bptt.train(KEY, "hover", SMALL[bptt])
    with pytest.raises(ValueError, match=says):
        evaluate("hover", lambda obs: obs, KEY)
    with pytest.raises(ValueError, match=says):
        loggers.KeepBest("hover", KEY)


def test_the_result_of_a_training_is_no_policy(tmp_path):
    trained = result.Result(None, None, {})
    with pytest.raises(ValueError, match=r"policy is <Result.*; give a policy, such as result\.policy, or a function"):
        evaluate(DoubleIntegrator(), trained, KEY)
    with pytest.raises(ValueError, match=r"policy is <Result.*; give a Policy, such as result\.policy"):
        checkpoint.save(tmp_path / "policy", trained)


def test_a_callback_that_is_no_function_is_refused():
    with pytest.raises(ValueError, match=r"callback: <lambda> takes .*; give a function of \(update, metrics, state\)"):
        bptt.train(KEY, DoubleIntegrator(), SMALL[bptt], callback=lambda update, metrics: None)
    with pytest.raises(ValueError, match=r"callback is \[3\]; give functions"):
        bptt.train(KEY, DoubleIntegrator(), SMALL[bptt], callback=[3])


def test_a_true_boolean_of_any_library_stops_a_training_and_no_other_answer_does():
    def update(env, config, state):
        return state.replace(step=state.step + 1), {"nonfinite_gradients": jnp.zeros((), int)}

    env, train = DoubleIntegrator(), result.make_train(bptt.Config, bptt.init, update)
    answers = (True, 1), (np.True_, 1), (jnp.array(True), 1), (False, 3), (np.False_, 3), (None, 3), (1, 3), ("yes", 3)
    for answer, updates in (*answers, (np.ones(2), 3)):
        trained = train(KEY, env, SMALL[bptt], callback=lambda *_, answer=answer: answer)
        assert int(trained.train_state.step) == updates, answer
    seen = []  # by a callback beside one that stops the training
    train(KEY, env, SMALL[bptt], callback=[lambda *_: True, lambda update, *_: seen.append(update)])
    assert seen == [1]


def test_the_log_of_a_continued_training_keeps_the_rows_of_earlier_updates(tmp_path):
    """Without those that it makes again; a log with other columns stays as it is."""
    file = tmp_path / "log.csv"
    for updates in ((1, 2, 3), (3, 4)):
        log = loggers.CSV(file)
        for update in updates:
            log(update, {"reward": 10.0 * len(updates) + update})
        with file.open("a") as cut:
            cut.write("1" * (updates[-1] == 3))  # of a row that was being written
    assert file.read_text().split() == ["update,reward", "1,31.0", "2,32.0", "3,23.0", "4,24.0"]
    with pytest.raises(ValueError, match="has the columns update, reward; give another file"):
        loggers.CSV(file)(5, {"error": 1.0})
    assert len(file.read_text().split()) == 5
    loggers.CSV(file)(1, {"error": 1.0})
    assert file.read_text().split() == ["update,error", "1,1.0"]


@pytest.mark.parametrize("name", ["every", "episodes"])
def test_evaluations_that_make_no_sense_are_refused(name):
    with pytest.raises(ValueError, match=f"{name} is 0; give a whole number of at least 1"):
        loggers.KeepBest(None, KEY, **{name: 0})
    with pytest.raises(ValueError, match="key is 0; give a random key"):
        loggers.KeepBest(None, 0)


def test_a_policy_is_not_loaded_into_a_network_of_other_arrays(tmp_path):
    """Fewer layers took the first arrays of the policy."""

    def network(*sizes):
        layers = [nnx.Linear(a, b, rngs=nnx.Rngs(0)) for a, b in itertools.pairwise(sizes)]
        return NnxNetwork([(layer.kernel[...], layer.bias[...]) for layer in layers])

    policy = Policy.init(KEY, DoubleIntegrator(), network=network(*SIZES), per_agent=True)
    checkpoint.save(tmp_path / "policy", policy)
    assert checkpoint.load(tmp_path / "policy", network(*SIZES)).per_agent
    with pytest.raises(ValueError, match="holds a network of class NnxNetwork, not Linear; give one"):
        checkpoint.load(tmp_path / "policy", nnx.Linear(*SIZES[:2], rngs=nnx.Rngs(0)))
    for sizes in (2, 8), (2, 4, 1), (2, 8, 8, 1):
        with pytest.raises(ValueError, match=r"network has array \[\d\] of shape .*, the policy .*; give its network"):
            checkpoint.load(tmp_path / "policy", network(*sizes))


class Wide(nn.Module):
    width: int
    layers: int = 1

    @nn.compact
    def __call__(self, obs):
        x = obs["depth"].reshape(-1) if isinstance(obs, dict) else obs
        for _ in range(self.layers):
            x = nn.tanh(nn.Dense(self.width)(x))
        return nn.Dense(1, name="head")(x)


@pytest.mark.parametrize("per_agent", [False, True])
def test_a_policy_is_not_loaded_into_a_linen_network_of_another_width_or_depth(per_agent, tmp_path):
    """More layers were not missed, and another width ended in a traceback of flax at the first call."""
    policy = Policy.init(KEY, DoubleIntegrator(), network=Wide(8, 2), per_agent=per_agent)
    checkpoint.save(tmp_path / "policy", policy)
    loaded = checkpoint.load(tmp_path / "policy", Wide(8, 2))
    np.testing.assert_array_equal(loaded(jnp.ones((1, 2))), policy(jnp.ones((1, 2))))
    for network in Wide(9, 2), Wide(8, 1), Wide(8, 3):
        with pytest.raises(
            ValueError,
            match=r"network has array \['params'\]\['Dense_\d'\].* of shape .*, the policy .*; give its network",
        ):
            checkpoint.load(tmp_path / "policy", network)


def test_a_network_of_images_names_its_fault_at_the_first_call():
    network = OwnNetwork(Wide(8), 1)
    params = network.init(KEY, {"depth": jnp.ones((2, 3))})
    network.apply(params, {"state": jnp.ones(2), "depth": jnp.ones((2, 3))})
    with pytest.raises(ValueError, match=r"the policy's parameters are not those of network: .*; give its network"):
        OwnNetwork(Wide(9), 1).apply(params, {"state": jnp.ones(2), "depth": jnp.ones((2, 3))})

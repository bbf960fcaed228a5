"""What is exported computes the actions of `Policy.act`, in C, ONNX Runtime, Node.js and by `jax.export`."""

import dataclasses
import functools
import importlib.util
import shutil

import jax
import numpy as np
import pytest
from helpers import mostly_slow, mostly_slow_rows

import jaxdrones as jd
from benchmarks import exported
from benchmarks.export import flown as flown_by
from benchmarks.export import one_call
from jaxdrones.envs.observations import encounters
from jaxdrones.export import layers, save
from jaxdrones.export.text import number
from jaxdrones.learning import bptt, evaluate
from jaxdrones.training.presets import preset

pytestmark = pytest.mark.float32

TOLERANCE = 1e-6  # of the largest action: rounding of float32 in sums of up to 400 products
DIFFERENT = 1e-4  # of the largest action: a mistake
PROGRAMS = {"c": "cc", "js": "node"}
LIBRARIES = {"onnx": "onnxruntime", "stablehlo": "flatbuffers"}
TARGETS = [
    pytest.param(to, marks=pytest.mark.skipif(not found, reason=f"{needed} is not installed"))
    for to, needed in (PROGRAMS | LIBRARIES).items()
    for found in [shutil.which(needed) if to in PROGRAMS else importlib.util.find_spec(needed)]
]
needs_cc = pytest.mark.skipif(shutil.which("cc") is None, reason="cc is not installed")
ODD = jd.Camera(resolution=(26, 21))  # two convolutions, with images padded differently along each axis
POLICIES = {
    "mlp": ("hover", {}, {}),
    "relu": ("hover", {}, {"activation": "relu"}),
    "elu": ("hover", {}, {"activation": "elu"}),
    "silu": ("hover", {}, {"activation": "silu", "hidden_sizes": (5,)}),
    "gru": ("hover", {}, {"recurrent_size": 6}),
    "cnn": ("forest", {}, {"hidden_sizes": (32, 16)}),
    "both": ("hover", {"vision": ("rgb", "depth"), "camera": ODD}, {"recurrent_size": 5}),
    "set": ("crowd", {"drones": 4}, {}),
    "one_row": ("crowd", {"observation": ("velocity", encounters(1, 1.2), "goal")}, {"recurrent_size": 3}),
    "team": ("leader-follower", {}, {}),
}

QUICK = ("mlp", "gru", "set")


@functools.cache
def made(kind: str) -> tuple:
    """Environment, policy, inputs and expected actions of one kind."""
    task, options, settings = POLICIES[kind]
    env = jd.make(task, **options)
    policy, inputs = exported.random_policy(env, **settings), exported.random_inputs(env)
    return env, policy, inputs, exported.expected_actions(policy, inputs)


def difference(actions: np.ndarray, expected: np.ndarray) -> float:
    assert actions.shape == expected.shape and np.isfinite(actions).all()
    return np.abs(actions - expected).max() / np.abs(expected).max()


@pytest.mark.parametrize("to", TARGETS)
@pytest.mark.parametrize("kind", mostly_slow(POLICIES, QUICK))
def test_what_is_exported_acts_as_the_policy(kind, to, tmp_path):
    env, policy, inputs, expected = made(kind)
    assert 0.1 < np.abs(expected).mean() < 0.95  # where a difference is seen
    (one,) = save(policy, env, to, tmp_path)
    assert one.files[0] == tmp_path / f"policy.{exported.SUFFIX[to]}"
    assert difference(exported.RUN[to](one.files[0], inputs), expected) < TOLERANCE


@pytest.mark.slow
@pytest.mark.parametrize("to", TARGETS)
def test_drones_with_their_own_networks_have_a_file_each(to, tmp_path):
    env = made("team")[0]
    policy, inputs = exported.random_policy(env, per_agent=True), made("team")[2]
    results = save(policy, env, to, tmp_path)
    assert [one.files[0].stem for one in results] == ["policy_0", "policy_1"]
    seen = np.stack([inputs["obs"]] * 2, axis=-2)  # the same by both
    both = jax.jit(policy.act)(None, seen)[1]
    for i, one in enumerate(results):
        actions = exported.RUN[to](one.files[0], inputs)
        assert difference(actions, np.asarray(both[..., i, :])) < TOLERANCE
        assert difference(actions, np.asarray(both[..., 1 - i, :])) > DIFFERENT


def test_a_drone_with_its_own_network_has_its_own_weights(tmp_path):
    policy = exported.random_policy(made("team")[0], per_agent=True)
    headers = [one.files[0].read_text() for one in save(policy, made("team")[0], "c", tmp_path)]
    of_drones = jax.tree.leaves(policy.params)[0][:, 0]
    assert [[number(x) in header for x in of_drones] for header in headers] == [[True, False], [False, True]]


def test_networks_of_other_drones_than_those_of_the_environment_are_refused(tmp_path):
    policy = exported.random_policy(made("team")[0], per_agent=True)
    with pytest.raises(ValueError, match="a network for each of 2 drones, and leader-follower has 3"):
        save(policy, jd.make("leader-follower", drones=3), "c", tmp_path)
    assert not list(tmp_path.iterdir())


@functools.cache
def flown() -> dict[str, np.ndarray]:
    """Observations (steps, drones, d) of flights by the policy."""
    env, policy, *_ = made("mlp")
    obs, world = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), exported.DRONES))
    step = jax.jit(jax.vmap(lambda world, obs: env.step(jax.random.key(0), world, policy(obs))[:2]))
    found = []
    for _ in range(exported.STEPS):
        found.append(np.asarray(obs[:, 0]))
        for _ in range(5):
            obs, world = step(world, obs)
    return {"obs": np.stack(found)}


@pytest.mark.slow
@pytest.mark.parametrize("to", TARGETS)
def test_what_is_exported_acts_as_the_policy_in_flight(to, tmp_path):
    (env, policy, *_), inputs = made("mlp"), flown()
    (one,) = save(policy, env, to, tmp_path)
    actions = exported.RUN[to](one.files[0], inputs)
    assert difference(actions, exported.expected_actions(policy, inputs)) < TOLERANCE


def test_the_smaller_half_of_a_margin_is_above_and_left():
    image, output = layers.Tensor("image", (26, 21, 3)), layers.Tensor("features", (7, 6, 8))
    assert layers.Convolution((image,), output, stride=4).margin == ((1, 1), (1, 2))


def test_a_sum_of_rows_multiplies_every_feature_of_every_row():
    features, rows = layers.Tensor("features", (5, 8)), layers.Tensor("rows", (5, 6))
    assert layers.SumOfRows((features, rows), layers.Tensor("sum", (8,))).multiply_adds == 5 * 8


MISTAKES = [  # kind of policy, and what is written in place of what
    ("mlp", "z < -clip ? -clip : z > clip ? clip : z", "z"),
    ("mlp", "z < -clip ? -clip : z > clip ? clip : z", "z < -clip ? -clip : z"),
    ("mlp", "(x[i] - mean[i]) * scale[i]", "x[i] - mean[i]"),
    ("mlp", "(x[i] - mean[i]) * scale[i]", "x[i] * scale[i]"),
    ("mlp", "kernel[i * m + j]", "kernel[j * n + i]"),
    ("mlp", "bias ? bias[j] : 0.0f", "bias ? 0.0f : 0.0f"),
    ("mlp", "policy_apply_tanh(4, act);", ""),
    ("gru", "inputs[i] + states[i]", "inputs[n + i] + states[i]"),
    ("gru", "policy_sigmoid(inputs[n + i] + states[n + i])", "1.0f - policy_sigmoid(inputs[n + i] + states[n + i])"),
    ("gru", "reset * states[2 * n + i]", "states[2 * n + i]"),
    ("gru", "hidden[i] = keep", "(void)new_value; hidden[i] = 0.0f * keep"),
    ("gru", "keep * hidden[i] +", "0.0f * keep * hidden[i] +"),
    ("gru", "hidden[i] = 0.0f;", "hidden[i] = 1.0f;"),
    ("cnn", "x[i] < 0.0f ? 0.0f : x[i]", "x[i]"),
    ("cnn", "row * stride + k / (stride * c)", "row * stride + k % stride"),
    ("cnn", "y[i] < 0.0f ? 0.0f : y[i]", "y[i]"),
    ("set", "inverse_reach)", "1.0f)"),
    ("set", "y[i] += x[i % m]", "y[i] += x[i / m]"),
    ("set", "nearness > 1.0f ? 1.0f : nearness", "nearness"),
    ("both", "column * stride + k / c % stride - left", "column * stride + k / c % stride"),
    ("both", "v * w + u", "v * h + u"),
    ("both", "x[4 * i + j]", "x[4 * i + 2 - j]"),
    ("both", "y[i * stride + j] = x[i * n + j]", "y[i + j * rows] = x[i * n + j]; (void)stride"),
]


@needs_cc
@pytest.mark.parametrize(
    ("kind", "text", "mistake"),
    mostly_slow_rows(MISTAKES, [case for case in MISTAKES if case[0] in ("mlp", "gru", "set")]),
)
def test_the_comparison_sees_a_mistake(kind, text, mistake, tmp_path):
    env, policy, inputs, expected = made(kind)
    (one,) = save(policy, env, "c", tmp_path)
    right = one.files[0].read_text()
    assert text in right
    one.files[0].write_text(right.replace(text, mistake))
    actions = exported.actions_of_c(one.files[0], inputs, warn=False)
    assert not difference(np.nan_to_num(actions), expected) < DIFFERENT


@pytest.mark.slow
@needs_cc
@pytest.mark.parametrize(("task", "settings"), [("hover", {}), ("recovery", {"recurrent_size": 16, "updates": 100})])
def test_a_policy_in_c_flies_as_well_as_the_policy(task, settings, tmp_path):
    env, config = preset(task, "bptt")
    policy = bptt.train(jax.random.key(0), env, dataclasses.replace(config, **settings)).policy
    (one,) = save(policy, env, "c", tmp_path)
    in_c = exported.CompiledPolicy(one.files[0])
    assert not in_c.reset(1).any() or not settings
    if settings:  # rounding adds up in the hidden state of a flight, so that only single calls can be compared
        assert one_call(policy, in_c, flown_by(env, policy)) < 2 * TOLERANCE
    reports = [evaluate(env, each, jax.random.key(1), episodes=1000) for each in (policy, in_c)]
    assert reports[0].success > 0.9
    assert abs(reports[0].success - reports[1].success) <= 0.005
    assert abs(reports[0].rms_error - reports[1].rms_error) < 1e-3  # m

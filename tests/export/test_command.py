"""`jaxdrones export`: what it writes and describes, and its messages."""

import contextlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import mostly_slow

import jaxdrones as jd
from benchmarks import exported
from jaxdrones.cli import main
from jaxdrones.export import TARGETS, save
from jaxdrones.learning import OwnNetwork
from jaxdrones.learning.networks import Policy
from jaxdrones.learning.normalize import RunningStatistics
from jaxdrones.training.recipe import Recipe
from jaxdrones.training.run import Run

pytestmark = pytest.mark.float32

needs_onnx, needs_flatbuffers = pytest.mark.needs("onnx"), pytest.mark.needs("flatbuffers")


@pytest.fixture(scope="module")
def env():
    with jax.enable_x64(False):
        return jd.make("hover")


@pytest.fixture(scope="module")
def run(env, tmp_path_factory):
    """Folder with a policy as of a training."""
    folder = tmp_path_factory.mktemp("runs") / "hover"
    with jax.enable_x64(False):
        policy = exported.random_policy(env)
        about = {"recipe": Recipe.of("hover").as_dict(), "update": 3, "run_id": "a"}
        Run(folder).save_policy("best", policy, **about)
        Run(folder).save_policy("last", policy.replace(params=jax.tree.map(jnp.zeros_like, policy.params)), **about)
    return folder


def own_policy(env, module) -> Policy:
    network = OwnNetwork(module, env.action_size)
    params = network.init(jax.random.key(0), jnp.zeros(env.observation_size))
    return Policy(params, RunningStatistics.empty(env.observation_size), network)


class Leaky(nn.Module):
    """Linear, with a dictionary as hidden state."""

    def initial_hidden_state(self):
        return {"sum": jnp.zeros(4)}

    @nn.compact
    def __call__(self, hidden_state, obs):
        y = 0.5 * hidden_state["sum"] + nn.Dense(4)(obs)
        return {"sum": y}, y


def test_the_command_writes_the_best_policy_into_the_folder_of_the_run(run, capsys):
    assert main(["export", str(run), "--to", "c"]) == 0
    said = capsys.readouterr().out
    assert "hover by bptt: policy of update 3" in said and f"wrote {run}/export/policy.h" in said
    assert "311 multiply-adds, 1,412 bytes of weights (flash), 124 bytes of RAM" in said
    best = (run / "export" / "policy.h").read_text()
    assert main(["export", str(run), "--to", "c", "--last", "-o", str(run / "last"), "--json", "--name", "hover"]) == 0
    (one,) = json.loads(capsys.readouterr().out)["exported"]
    assert one["files"] == [f"{run}/last/hover.h"] and one["flash"] == 1412
    last = (run / "last" / "hover.h").read_text().replace("hover_", "policy_").replace("HOVER_", "POLICY_")
    assert last != best and last.split("static const")[0] == best.split("static const")[0]  # but for their weights


def test_costs_are_those_of_the_layers(env, tmp_path):
    (one,) = save(exported.random_policy(env, (9, 7), recurrent_size=6), env, "c", tmp_path)
    weights = 22 * 18 + 18 + 6 * 18 + 28 * 9 + 9 + 9 * 7 + 7 + 7 * 4 + 4
    assert one.flash == 4 * (2 * 22 + weights)
    assert one.multiply_adds == 22 + 22 * 18 + 6 * 18 + 28 * 9 + 9 * 7 + 7 * 4
    assert one.ram == 4 * (22 + 18 + 18 + 6)  # observation, both parts of the gates, hidden state
    (one,) = save(exported.random_policy(env, (9, 22)), env, "c", tmp_path)
    assert one.ram == 4 * (22 + 9)  # the second layer takes the place of the observation


@pytest.mark.parametrize("to", [pytest.param("c"), pytest.param("js")])
def test_order_unit_and_frame_of_every_number_are_in_the_comment(to, run, env, tmp_path):
    (one,) = save(exported.random_policy(env, recurrent_size=6), env, to, tmp_path, title="a */ b /* c ??/ \\")
    comment = one.files[0].read_text().split("*/")[0]
    assert "a * / b / * c ? ?/ /" in comment and "Call it 100 times per second" in comment
    entries = (*jd.explain(env).observation, *jd.explain(env).action)
    lines = [line.removeprefix(" * ") for line in comment.splitlines()]
    rows = [line.split() for line in lines if line.strip()[:1].isdigit()]
    assert len(rows) == len(entries) == 26
    for row, entry in zip(rows, entries, strict=True):
        text = " ".join(row)
        assert all(
            part in text for part in (entry.term, entry.quantity.name, entry.quantity.unit, entry.quantity.frame)
        )
    assert [int(row[0]) for row in rows] == [*range(22), *range(4)]
    assert "Hidden state: 6 numbers, kept between calls; 0 at the start of a flight" in comment
    assert {"c": "policy_reset(hidden);", "js": "const hidden = initialHiddenState();"}[to] in comment


@pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")
def test_the_module_refuses_an_observation_of_another_length(env, tmp_path):
    (one,) = save(exported.random_policy(env), env, "js", tmp_path)
    tried = "for (const n of [2, 23]) try { step(new Float32Array(n)); } catch (error) { console.log(`${error}`); }"
    code = f'import {{ step }} from "{one.files[0].as_uri()}"; {tried}'
    done = subprocess.run(["node", "--input-type=module", "-e", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [f"RangeError: obs has {n} numbers, not 22" for n in (2, 23)]


@needs_onnx
def test_onnx_has_the_meaning_of_its_numbers_and_a_dynamic_batch(env, tmp_path):
    import onnx

    (one,) = save(exported.random_policy(env, recurrent_size=6), env, "onnx", tmp_path)
    model = onnx.load(one.files[0])
    about = {entry.key: json.loads(entry.value) for entry in model.metadata_props}
    expected = json.loads(json.dumps(jd.explain(env).as_dict()))
    assert about["observation"] == expected["observation"] and about["action"] == expected["action"]
    assert about["period_s"] == env.dt and about["hidden_size"] == 6
    assert model.ir_version <= 8 and model.opset_import[0].version <= 17  # runtimes of 2022 read them
    assert "0  x of the target, from the drone" in " ".join(model.doc_string.split()).replace("0 position_error", "0 ")
    shapes = {
        x.name: [d.dim_param or d.dim_value for d in x.type.tensor_type.shape.dim]
        for x in (*model.graph.input, *model.graph.output)
    }
    assert shapes == {
        "obs": ["batch", 22],
        "hidden_state": ["batch", 6],
        "act": ["batch", 4],
        "next_hidden_state": ["batch", 6],
    }


@needs_flatbuffers
@pytest.mark.parametrize("library", mostly_slow(["linen", "nnx", "equinox"], ["nnx"]))
def test_a_network_of_a_user_leaves_as_stablehlo(library, env, tmp_path):
    if library == "linen":
        module = nn.Dense(4)
    elif library == "nnx":
        from flax import nnx

        module = nnx.Linear(22, 4, rngs=nnx.Rngs(0))
    else:
        module = pytest.importorskip("equinox").nn.Linear(22, 4, key=jax.random.key(0))
    policy, inputs = own_policy(env, module), exported.random_inputs(env)
    (one,) = save(policy, env, "stablehlo", tmp_path)
    assert one.multiply_adds is None
    actions = exported.actions_of_stablehlo(one.files[0], inputs)
    np.testing.assert_allclose(actions, exported.expected_actions(policy, inputs), atol=1e-6)
    for to in set(TARGETS) - {"stablehlo"}:
        with pytest.raises(ValueError, match=r"a network of your own, \w+, whose layers are unknown; give --to stabl"):
            save(policy, env, to, tmp_path)


@needs_flatbuffers
def test_the_hidden_state_of_a_users_network_is_an_argument(env, tmp_path):
    policy, inputs = own_policy(env, Leaky()), exported.random_inputs(env)
    (one,) = save(policy, env, "stablehlo", tmp_path)
    program = jax.export.deserialize(bytearray(one.files[0].read_bytes()))
    assert set(program.platforms) == {"cpu", "cuda", "rocm", "tpu"}
    state, expected = {"sum": jnp.zeros((exported.DRONES, 4))}, exported.expected_actions(policy, inputs)
    for t in range(exported.STEPS):
        action, state = program.call(inputs["obs"][t], state)
        np.testing.assert_allclose(action, expected[t], atol=1e-6)


def test_what_cannot_be_exported_is_said(env, tmp_path):
    policy = exported.random_policy(env)
    with pytest.raises(ValueError, match=r"the policy is <function .*; give one of jaxdrones.learning"):
        save(lambda obs: obs[:, :4], env, "c", tmp_path)
    params = policy.params["params"] | {"Gate_0": {"kernel": jnp.ones((2, 2))}}
    with pytest.raises(ValueError, match="has layers without an exporter; give --to stablehlo"):
        save(policy.replace(params={"params": params}), env, "c", tmp_path)
    with pytest.raises(ValueError, match="unknown target 'rust'"):
        save(policy, env, "rust", tmp_path)
    with pytest.raises(ValueError, match="name is '2fast'; give a letter"):
        save(policy, env, "c", tmp_path, name="2fast")
    with pytest.raises(ValueError, match="name is 'Policy'; give lower case letters, as names that differ in case"):
        save(policy, env, "c", tmp_path, name="Policy")
    with pytest.raises(ValueError, match=r"name is 'math', and the header includes <math\.h>"):
        save(policy, env, "c", tmp_path, name="math")
    with pytest.raises(ValueError, match=r"policy have \(22, 4\) numbers, those of leader-follower \(12, 1\)"):
        save(policy, jd.make("leader-follower"), "c", tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(shutil.which("cc") is None, reason="cc is not installed")
def test_headers_of_two_names_are_used_together_and_other_targets_have_capital_letters(env, tmp_path):
    policy = exported.random_policy(env)
    for name in ("hover", "hover_", "h"):
        save(policy, env, "c", tmp_path, name=name)
    save(policy, env, "js", tmp_path, name="Hover")
    code = "".join(f'#include "{name}.h"\n' for name in ("hover", "hover_", "h"))
    calls = "".join(f"{name}_step(obs, act);" for name in ("hover", "hover_", "h"))
    code += f"int main(void) {{ float obs[HOVER_OBS_SIZE] = {{0}}, act[H_ACT_SIZE]; {calls} return 0; }}"
    (tmp_path / "main.c").write_text(code)
    subprocess.run(["cc", "-std=c99", "-Werror", "main.c", "-lm", "-o", "main"], cwd=tmp_path, check=True)


def damaged(run: Path, folder: Path, file: str, content: bytes | None) -> Path:
    """Copy of a run with a file replaced or removed."""
    shutil.copytree(run, folder)
    if content is None:
        (folder / file).unlink()
    else:
        (folder / file).write_bytes(content)
    return folder


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("best.json", None, "best.json does not exist"),
        ("best.json", b"{}", "best.json has format None"),
        ("best.json", b"not JSON", "best.json is damaged"),
        ("best.msgpack", b"nonsense", "best.msgpack is damaged"),
        ("best.msgpack", None, "best.msgpack does not exist"),
    ],
)
def test_a_damaged_run_is_one_line(file, content, message, run, tmp_path, capsys):
    folder = damaged(run, tmp_path / "run", file, content)
    assert main(["export", str(folder), "--to", "c", "--output", str(tmp_path / "c")]) == 2
    said = capsys.readouterr()
    assert said.err.count("\n") == 1 and message in said.err and not (tmp_path / "c").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "the following arguments are required"),
        (["RUN"], "the following arguments are required: --to"),
        (["RUN", "--to", "c", "--to", "js"], "argument --to: c and js are given; give one"),
        (["RUN", "--to", "onxx"], "unknown target 'onxx'; did you mean 'onnx'"),
        (["RUN", "--to", "c", "--task", "hover"], "--task is given beside the run"),
        (["RUN", "--to", "c", "--drones", "2"], "--drones is given beside the run"),
        (["missing", "--to", "c"], "best.json does not exist"),
        (["RUN", "--to", "c", "--output", "RUN/best.json"], "best.json: "),
        (["mine.py:policy", "--to", "c"], "--task is missing"),
        (["mine.py:policy", "--to", "c", "--task", "hover"], "the layers of a function are unknown"),
        (
            ["mine.py:trained", "--to", "c", "--task", "leader-follower"],
            "has 22 observations and 4 actions, the environment leader-follower 12",
        ),
    ],
)
def test_a_mistake_is_one_line(arguments, message, run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(
        "from jaxdrones.learning.checkpoint import load\n\n\ndef policy(obs):\n    return obs[:, :4]\n\n\n"
        f"trained = load({str(run / 'best')!r})\n"
    )
    with pytest.raises(SystemExit) if "argument" in message else contextlib.nullcontext():
        code = main(["export", *(text.replace("RUN", str(run)) for text in arguments)])
        assert code == 2
    said = capsys.readouterr()
    assert said.err.count("\n") == 1 and message in said.err


@pytest.mark.parametrize(("to", "library"), [("onnx", "onnx"), ("stablehlo", "flatbuffers")])
def test_a_missing_library_is_said_with_the_extra(to, library, run, tmp_path, monkeypatch, capsys):
    for name in (*(x for x in sys.modules if x.split(".")[0] == library), library):
        monkeypatch.setitem(sys.modules, name, None)
    assert main(["export", str(run), "--to", to, "--output", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert f"{library} is not installed" in said and "[export]" in said and said.count("\n") == 1


def test_the_targets_of_the_command_are_those_of_the_library():
    from jaxdrones.cli.export import TARGETS as NAMES

    assert TARGETS == NAMES


def test_a_policy_with_numbers_that_are_not_finite_is_not_exported(tmp_path):
    """Neither C nor JavaScript reads nanf."""
    policy = jd.make_policy("hover")
    lost = policy.replace(obs_stats=policy.obs_stats.replace(mean=policy.obs_stats.mean.at[3].set(jnp.nan)))
    with pytest.raises(ValueError, match=r"policy.obs_stats.mean is not finite: .*; give finite numbers"):
        save(lost, None, "c", tmp_path)

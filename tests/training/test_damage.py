"""Files that were damaged, edited, swapped or cut short are refused in one line; no other numbers fly unnoticed."""

import copy
import json
import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import flax.serialization
import jax
import numpy as np
import pytest

from jaxdrones import envs, writing
from jaxdrones.cli import main
from jaxdrones.errors import UserError
from jaxdrones.learning import checkpoint
from jaxdrones.learning.networks import Policy
from jaxdrones.training.recipe import Recipe
from jaxdrones.training.run import Run

pytestmark = pytest.mark.float32

TREE = {"weights": np.arange(6.0, dtype=np.float32).reshape(2, 3), "step": np.int32(3)}


@pytest.fixture(scope="module")
def policy():
    with jax.enable_x64(False):
        return Policy.init(jax.random.key(0), envs.make("hover"), (4,))


@pytest.fixture(scope="module")
def runs(policy, tmp_path_factory):
    """Two folders with a best policy and a training state, of two seeds."""
    folders = [tmp_path_factory.mktemp("runs") / name for name in ("one", "other")]
    with jax.enable_x64(False):
        for seed, folder in enumerate(folders):
            other = jax.tree.map(lambda x, seed=seed: x + seed, policy)
            about = dict(
                run_id=f"run {seed}",
                recipe=Recipe.of("hover", hidden_sizes=(4,)).as_dict(),
                seed=seed,
                episodes=8,
                update=4,
            )
            Run(folder).save_policy("best", other, **about, score=(0.0, 1.0))
            Run(folder).save_policy("last", other, **about)
            Run(folder).save_state(
                TREE | {"weights": TREE["weights"] + seed}, **about, seconds=1.0, highest_success=0.0
            )
    return folders


# Corruptions: (random numbers, file, the same file of another run). Each changes the file in place.


def flip_bit(rng, file: Path, _):
    content = bytearray(file.read_bytes())
    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    file.write_bytes(content)


def truncate(rng, file: Path, _):
    file.write_bytes(file.read_bytes()[: rng.randrange(file.stat().st_size)])


def lengthen(rng, file: Path, _):
    content, at = file.read_bytes(), rng.randrange(file.stat().st_size)
    file.write_bytes(content[:at] + rng.randbytes(rng.randrange(1, 40)) + content[at:])


def replace_by_noise(rng, file: Path, _):
    file.write_bytes(rng.randbytes(rng.randrange(300)))


def take_from_another_run(rng, file: Path, other: Path):
    shutil.copy(other, file)


def make_a_folder(rng, file: Path, _):
    file.unlink()
    file.mkdir()


def remove(rng, file: Path, _):
    file.unlink()


ANY_FILE = (flip_bit, truncate, lengthen, replace_by_noise, take_from_another_run, make_a_folder, remove)


def change_numbers(rng, file: Path, _):
    """Written anew as flax writes it, with one array cast, not finite, or of another shape."""
    leaves, structure = jax.tree.flatten(flax.serialization.msgpack_restore(file.read_bytes()))
    at = rng.randrange(len(leaves))
    change = rng.choice(
        [
            lambda x: x.astype(rng.choice([np.float16, np.float64, np.int64, np.complex64, bool])),
            lambda x: np.full_like(x, rng.choice([np.nan, np.inf])) if x.dtype.kind == "f" else x + 1,
            lambda x: x[None],
            lambda x: x.ravel()[:-1],
        ]
    )
    leaves[at] = change(np.asarray(leaves[at]))
    file.write_bytes(flax.serialization.msgpack_serialize(jax.tree.unflatten(structure, leaves)))


def change_entry(rng, file: Path, _):
    """An entry of the JSON, at any depth, that is gone or of another kind."""
    about = json.loads(file.read_text())
    places = list(entries(about))
    inside, name = rng.choice(places)
    if rng.random() < 0.3:
        del inside[name]
    else:
        inside[name] = rng.choice([None, "x", -1, 0.5, 2**70, [], {}, True, float("nan"), "\ud800", [[[]]]])
    file.write_text(json.dumps(about))


def entries(x):
    """Every container in a tree of JSON with every name or index in it."""
    names = list(x) if isinstance(x, dict) else range(len(x)) if isinstance(x, list) else ()
    for name in names:
        yield x, name
        yield from entries(x[name])


def nest(rng, file: Path, _):
    depth = rng.choice([200, 1000, 100_000])
    file.write_text('{"format": 4, "policy": ' + depth * "[" + depth * "]" + "}")


def corrupted(rng, folder: Path, other: Path, name: str) -> str:
    """Damage one of the two files of a checkpoint; returns how."""
    ending = rng.choice(["msgpack", "json"])
    own = (change_numbers,) if ending == "msgpack" else (change_entry, change_entry, nest)
    corruption: Callable = rng.choice([*ANY_FILE, *own])
    file = folder / f"{name}.{ending}"
    corruption(rng, file, other / file.name)
    return f"{corruption.__name__} of {file.name}"


def same_bits(a, b) -> bool:
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(x.dtype == y.dtype and np.asarray(x).tobytes() == np.asarray(y).tobytes() for x, y in pairs)


@pytest.mark.parametrize("name", ["best", "last", "state"])
def test_a_corrupted_checkpoint_is_refused_in_one_line_or_loads_bit_for_bit(name, runs, tmp_path):
    def load(folder):
        run = Run(folder)
        run.recipe(name)
        return run.load_state(TREE) if name == "state" else run.policy(name)

    good, refused = load(runs[0]), 0
    for seed in range(150):
        rng, folder = random.Random(f"{name} {seed}"), tmp_path / str(seed)
        shutil.copytree(runs[0], folder)
        how = corrupted(rng, folder, runs[1], name)
        try:
            assert same_bits(load(folder), good), how
        except (ValueError, FileNotFoundError) as error:
            refused += 1
            assert type(error) in (UserError, FileNotFoundError), (how, error)
            assert "\n" not in str(error) and str(folder / name) in str(error) and len(str(error)) < 400, (how, error)
    assert refused > 130


@pytest.mark.parametrize(
    "command",
    [["eval", "RUN", "--episodes", "2"], ["fly", "--policy", "RUN", "--no-figure"]],
    ids=lambda command: command[0],
)
def test_a_corrupted_policy_is_one_line_on_stderr_and_exit_code_2(command, runs, tmp_path, capsys):
    for seed in range(20):
        rng, folder = random.Random(f"{command[0]} {seed}"), tmp_path / str(seed)
        shutil.copytree(runs[0], folder)
        how = corrupted(rng, folder, runs[1], "best")
        assert main([str(folder) if word == "RUN" else word for word in command]) == 2, how
        captured = capsys.readouterr()
        assert captured.out == "" and captured.err.count("\n") == 1 and str(folder / "best") in captured.err, how


@pytest.mark.parametrize("name", ["best", "state"])
def test_a_training_does_not_go_on_from_corrupted_files(name, runs, tmp_path, capsys):
    for seed in range(8):
        rng, folder = random.Random(f"resume {name} {seed}"), tmp_path / str(seed)
        shutil.copytree(runs[0], folder)
        how = corrupted(rng, folder, runs[1], name)
        assert main(["train", "hover", "--resume", "--output", str(folder)]) == 2, how
        said = capsys.readouterr().err
        assert str(folder) in said and name in said and said.count("\n") == 1, how


def test_a_number_that_is_edited_in_the_sidecar_is_noticed(runs, tmp_path):
    shutil.copytree(runs[0], tmp_path / "run")
    file = tmp_path / "run" / "best.json"
    about = json.loads(file.read_text())
    file.write_text(json.dumps(about))  # another layout of the same
    assert Run(tmp_path / "run").recipe().config.worlds == 256
    edited = copy.deepcopy(about)
    edited["recipe"]["config"]["worlds"] = 255
    file.write_text(json.dumps(edited))
    with pytest.raises(ValueError, match=r"best\.json is damaged, or was edited after it was saved.*train again"):
        Run(tmp_path / "run").recipe()


def test_a_checkpoint_of_an_earlier_format_says_train_anew(runs, tmp_path):
    shutil.copytree(runs[0], tmp_path / "run")
    file = tmp_path / "run" / "best.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"format": 1}))
    with pytest.raises(ValueError, match="has format 1, this version reads 4; train again"):
        checkpoint.load(tmp_path / "run" / "best")


def test_numbers_that_are_not_finite_are_neither_saved_nor_loaded(policy, tmp_path):
    broken = policy.replace(obs_stats=policy.obs_stats.replace(var=policy.obs_stats.var.at[3].set(np.nan)))
    with pytest.raises(ValueError, match=r"obs_stats\.var holds numbers that are not finite"):
        checkpoint.save(tmp_path / "policy", broken)
    assert list(tmp_path.iterdir()) == []
    network = {"hidden_sizes": (4,), "output_size": 4, "output_scale": 0.01, "activation": "tanh"}
    checkpoint.save_tree(tmp_path / "policy", broken, policy={"network": network, "per_agent": False})
    with pytest.raises(ValueError, match=r"obs_stats\.var holds numbers that are not finite; use another"):
        checkpoint.load(tmp_path / "policy")


def test_double_precision_is_not_rounded_silently(policy, tmp_path):
    with jax.enable_x64(True):
        double = jax.tree.map(lambda x: np.asarray(x, np.float64), policy)
        checkpoint.save(tmp_path / "policy", double)
        assert same_bits(checkpoint.load(tmp_path / "policy"), double)
    with pytest.raises(ValueError, match=r"is float64.*expected float32.*JAX_ENABLE_X64"):
        checkpoint.load(tmp_path / "policy")


@pytest.mark.parametrize("step", [1, 2])
def test_a_process_that_is_killed_while_it_saves_leaves_the_old_numbers_or_the_new(step, tmp_path, monkeypatch):
    run = Run(tmp_path)
    run.save_state({"x": np.zeros(3, np.float32)}, update=1)
    renames = []

    def killed(source, target):
        renames.append(target)
        if len(renames) == step:
            raise KeyboardInterrupt
        rename(source, target)

    rename = os.replace
    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        run.save_state({"x": np.ones(3, np.float32)}, update=2)
    monkeypatch.undo()
    kept = run.load_state({"x": np.zeros(3, np.float32)})["x"]
    assert (run.sidecar("state")["update"], kept.tolist()) == {1: (1, [0, 0, 0]), 2: (2, [1, 1, 1])}[step]
    run.save_state({"x": np.full(3, 2, np.float32)}, update=3)
    assert run.load_state({"x": np.zeros(3, np.float32)})["x"].tolist() == [2, 2, 2]
    run.clear()
    assert list(tmp_path.iterdir()) == []


def test_a_process_that_is_killed_between_two_renames_and_then_while_it_writes_leaves_numbers(tmp_path, monkeypatch):
    """The content that is beside its file is the only one that the sidecar describes, until it is renamed."""
    run = Run(tmp_path)
    run.save_state({"x": np.zeros(3, np.float32)}, update=1)
    write_bytes, rename = Path.write_bytes, writing.rename

    def killed_at_rename(file):
        if file.suffix == ".msgpack":
            raise KeyboardInterrupt
        rename(file)

    def killed_at_write(self, content):
        write_bytes(self, content[:10])
        raise KeyboardInterrupt

    for update, place, name, function in [
        (2, writing, "rename", killed_at_rename),
        (3, Path, "write_bytes", killed_at_write),
    ]:
        with monkeypatch.context() as patch:
            patch.setattr(place, name, function)
            with pytest.raises(KeyboardInterrupt):
                run.save_state({"x": np.full(3, update, np.float32)}, update=update)
        assert run.sidecar("state")["update"] == 2
        assert run.load_state({"x": np.zeros(3, np.float32)})["x"].tolist() == [2, 2, 2]


def test_numbers_are_on_the_disk_before_the_sidecar_that_describes_them(tmp_path, monkeypatch):
    """A power failure loses what is not flushed."""
    flushed, fsync, rename = [], os.fsync, os.replace

    def noted(descriptor):
        flushed.append(Path(os.readlink(f"/proc/self/fd/{descriptor}")).name)
        fsync(descriptor)

    def checked(source, target):
        assert "state.new.msgpack" in flushed
        rename(source, target)

    monkeypatch.setattr(os, "fsync", noted)
    monkeypatch.setattr(os, "replace", checked)
    Run(tmp_path).save_state({"x": np.zeros(3, np.float32)}, update=1)


@pytest.mark.parametrize(
    "content", [b"", b"update,reward\n1,x\n", b"reward\n3\n", b"update\n\xff\x00\n", b"update,a\n1,2,3\n"]
)
def test_damaged_progress_is_named(content, tmp_path):
    file = tmp_path / "progress.csv"
    file.write_bytes(content)
    if content == b"":
        assert Run(tmp_path).history() == []
        return
    with pytest.raises(ValueError, match=r"progress\.csv is damaged: .*remove it"):
        Run(tmp_path).history()


@pytest.mark.parametrize("content", [b"", b"{", b"[" * 100_000, b"\xff"])
def test_a_damaged_report_is_named(content, tmp_path):
    (tmp_path / "report.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"report\.json cannot be read: .*writes it anew"):
        Run(tmp_path).report()

"""A run on disk."""

import errno
import json
import struct
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxdrones.envs import make
from jaxdrones.learning.networks import Policy
from jaxdrones.training import events
from jaxdrones.training.progress import Progress
from jaxdrones.training.recipe import Recipe
from jaxdrones.training.run import Run


def records(file: Path):
    """Contents of an event file, its checksums compared with another implementation's."""
    crc32c = pytest.importorskip("tensorboardX.crc32c").crc32c
    content, at = file.read_bytes(), 0

    def masked(part):
        crc = crc32c(part)
        return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF

    while at < len(content):
        (length,) = struct.unpack_from("<Q", content, at)
        event = content[at + 12 : at + 12 + length]
        assert struct.unpack_from("<I", content, at + 8)[0] == masked(content[at : at + 8])
        assert struct.unpack_from("<I", content, at + 12 + length)[0] == masked(event)
        yield event
        at += 16 + length


def test_event_files_are_what_tensorboard_defines(tmp_path):
    event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2")
    log = events.EventFile(tmp_path)
    log.add(300, {"reward": -1.5, "success": 0.25})
    log.close()
    (file,) = tmp_path.glob("*tfevents*")
    first, second = (event_pb2.Event.FromString(record) for record in records(file))
    assert first.file_version == "brain.Event:2"
    assert second.step == 300 and second.wall_time > 1.7e9
    assert [(value.tag, value.simple_value) for value in second.summary.value] == [("reward", -1.5), ("success", 0.25)]


def test_lines_after_the_update_that_training_goes_on_from_are_dropped(tmp_path):
    run, columns = Run(tmp_path), ["update", "reward", "success"]
    with Progress(run, columns, 0) as progress:
        progress.add([{"update": 1, "reward": 0.1}, {"update": 2, "reward": 0.2, "success": 0.5}])
        progress.add([{"update": 3, "reward": 0.3}])
    with Progress(run, columns, 2) as progress:
        progress.add([{"update": 3, "reward": 0.4}])
    assert run.history() == [
        {"update": 1, "reward": 0.1},
        {"update": 2, "reward": 0.2, "success": 0.5},
        {"update": 3, "reward": 0.4},
    ]


@pytest.mark.parametrize("realistic", [True, "any"])
def test_a_recipe_survives_json(realistic):
    recipe = Recipe.of("tracking", "ppo", realistic=realistic, period=5.0, worlds=64, restart_fraction=1)
    assert recipe.config.restart_fraction == 1.0 and recipe.options == {"period": 5.0}
    assert Recipe.from_dict(json.loads(json.dumps(recipe.as_dict()))) == recipe
    assert recipe.env().observation_size > 0


def test_a_full_disk_is_reported_with_its_folder_before_training(tmp_path, monkeypatch):
    def full(self, content):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match=r"No space left on device: .*hover"):
        Run(tmp_path / "hover").prepare(1000)
    assert list((tmp_path / "hover").iterdir()) == []


def test_a_disk_that_fills_up_leaves_the_checkpoint_that_was_there(tmp_path, monkeypatch):
    run = Run(tmp_path)
    run.save_state({"x": 1.0 * np.arange(3)}, update=1)

    def full(self, content):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match=r"state\.msgpack"):
        run.save_state({"x": np.zeros(3)}, update=2)
    monkeypatch.undo()
    assert run.sidecar("state")["update"] == 1
    assert run.load_state({"x": np.zeros(3)})["x"].tolist() == [0, 1, 2]


def test_a_policy_that_does_not_fit_the_environment_is_refused(tmp_path):
    env = make("hover")
    run = Run(tmp_path)
    run.save_policy("best", Policy.init(jax.random.key(0), env, (4,)))
    run.policy("best", env)
    with pytest.raises(ValueError, match=r"trained on another version of leader-follower.*\(22, 4\).*train anew"):
        run.policy("best", make("leader-follower"))

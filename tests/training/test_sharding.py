"""Worlds spread over devices and hosts; in processes of their own, since JAX counts its devices once."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxdrones.learning import sharding
from jaxdrones.training import distributed
from jaxdrones.training.run import Run

SCRIPT = Path(__file__).with_name("several_devices.py")
CLI = "import sys; from jaxdrones.cli import main; sys.exit(main())"
TRAIN = [
    "train",
    "hover",
    "--set",
    "worlds=16",
    "--set",
    "horizon=4",
    "--set",
    "hidden_sizes=8,",
    "--set",
    "duration=0.2",
]
TRAIN += ["--episodes", "8", "--json", "--no-figure"]


def start(*command, **environment) -> subprocess.Popen:
    paths = {"PYTHONPATH": os.pathsep.join(filter(None, (str(SCRIPT.parent.parent), os.environ.get("PYTHONPATH"))))}
    return subprocess.Popen(
        [sys.executable, *map(str, command)],
        env=os.environ | paths | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finished(*processes: subprocess.Popen) -> list[str]:
    """What they printed; none is left running."""
    try:
        came = [process.communicate(timeout=300) for process in processes]
    finally:
        for process in processes:
            process.kill()
    for process, (_, said) in zip(processes, came, strict=True):
        assert process.returncode == 0, said
    return [printed for printed, _ in came]


def free_address() -> str:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"127.0.0.1:{server.getsockname()[1]}"


def numbers(file: Path) -> dict[str, np.ndarray]:
    with np.load(file) as kept:
        return dict(kept)


def assert_same(files):
    """What differs is the order in which worlds are summed; networks are of float32, and Adam makes full steps."""
    first, *others = map(numbers, files)
    for other in others:
        for name in first:
            if not name.endswith("talks"):
                np.testing.assert_allclose(other[name], first[name], rtol=1e-5, atol=1e-6, err_msg=name)


@pytest.mark.slow
def test_two_devices_come_to_what_one_comes_to_and_do_not_talk_while_they_fly(tmp_path):
    files = [tmp_path / "one.npz", tmp_path / "two.npz"]
    finished(*(start(SCRIPT, file, devices) for devices, file in enumerate(files, 1)))
    assert_same(files)
    for memory in (0, 3):
        names = {name: f"{name}, memory of {memory} talks" for name in ("bptt", "shac", "ppo")}
        talks = {name: list(numbers(files[1])[entry]) for name, entry in names.items()}
        for found in talks.values():
            assert {kind.removeprefix("loop ") for kind in found} == {"all-reduce"}  # gradients and means, no worlds
        in_loops = {name: found.count("loop all-reduce") for name, found in talks.items()}
        assert in_loops == {"bptt": 0, "shac": 1, "ppo": 1}  # in a gradient step
        assert not numbers(files[0])[names["ppo"]].size


@pytest.mark.slow
def test_two_processes_come_to_what_one_comes_to(tmp_path):
    files, coordinator = [tmp_path / f"{name}.npz" for name in ("one", "host-0", "host-1")], free_address()
    finished(start(SCRIPT, files[0], 1))
    finished(*(start(SCRIPT, file, 1, 2, host, coordinator) for host, file in enumerate(files[1:])))
    assert_same(files)


@pytest.mark.slow
@pytest.mark.parametrize("algo", ["bptt", "ppo"])
def test_a_training_on_two_devices_or_two_hosts_is_a_run_like_another_and_one_device_goes_on_with_it(algo, tmp_path):
    two, pair, coordinator = tmp_path / "two", tmp_path / "pair", free_address()
    train = [*TRAIN, "--algo", algo, "--budget", "4"]
    finished(
        start("-c", CLI, *train, "--output", two, JAX_NUM_CPU_DEVICES="2"),
        *(
            start("-c", CLI, *train, "--output", pair, "--hosts", 2, "--host", i, "--coordinator", coordinator)
            for i in (0, 1)
        ),
    )
    assert {file.name for file in two.iterdir()} == {
        *(f"{name}.{ending}" for name in ("best", "last", "state") for ending in ("msgpack", "json")),
        *("progress.csv", "report.json"),
    }
    assert (two / "state.msgpack").read_bytes() == (pair / "state.msgpack").read_bytes()
    (two / "report.json").unlink()
    finished(
        start(
            "-c", CLI, "train", "hover", "--resume", "--json", "--no-figure", "--output", two, JAX_NUM_CPU_DEVICES="1"
        )
    )
    assert Run(two).report()["updates"] == 4
    assert [row.get("reward") for row in Run(two).history()] == [row.get("reward") for row in Run(pair).history()]


def test_worlds_that_devices_cannot_share_equally_are_refused():
    with pytest.raises(ValueError, match="worlds is 256, to be shared by 3 devices; give a multiple of 3"):
        sharding.make_mesh(256, 3 * jax.devices())


@pytest.mark.parametrize("host", [0, 1])
def test_a_host_that_is_left_alone_says_so(host):
    address = free_address()
    with pytest.raises(ValueError, match=rf"host {host} of 2 did not reach all others at {address} within 0.2 s"):
        with distributed.join_hosts(2, host, address, timeout=0.2):
            pass


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((2, 2, "127.0.0.1:1"), "host is 2; give 0 to 1"),
        ((0, 0, "127.0.0.1:1"), "hosts is 0"),
        ((2, 0, "127.0.0.1:1", float("nan")), "timeout is nan; give a positive number"),
        ((2, 0, "127.0.0.1"), "coordinator is '127.0.0.1'; give ADDRESS:PORT"),
    ],
)
def test_a_mistake_about_hosts_is_told_at_once(arguments, message):
    with pytest.raises(ValueError, match=message):
        with distributed.join_hosts(*arguments):
            pass


def test_a_mistake_that_one_host_finds_is_raised_there():
    with pytest.raises(ValueError, match="mine"), distributed.fail_together():
        raise ValueError("mine")

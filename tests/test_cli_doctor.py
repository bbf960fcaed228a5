"""`jaxdrones doctor` and `jaxdrones bench`."""

import functools
import importlib.metadata
import json
import os
import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from documents import ROOT

import jaxdrones as jd
from jaxdrones.cli import doctor, machine, main
from jaxdrones.errors import install
from jaxdrones.flights import self_test

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
VERSION = importlib.metadata.version


@pytest.fixture
def no_flight(monkeypatch):
    monkeypatch.setattr(self_test, "self_test", lambda backend: None)


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.parametrize(
    "backend",
    ["explicit", pytest.param("bullet", marks=[pytest.mark.needs("pybullet"), pytest.mark.slow])],
)
def test_the_self_test_passes_on_either_backend(backend):
    assert self_test.self_test(backend) is None


@pytest.mark.slow
def test_the_self_test_finds_physics_that_is_not_what_it_should_be(monkeypatch, capsys):
    dragged = functools.partial(jd.make_step, effects=(jd.drag,))
    monkeypatch.setattr(self_test.explicit, "make_step", dragged)
    monkeypatch.setattr(doctor, "_requirements", lambda wrong: ({}, {}))
    assert main(["doctor"]) == 1
    wrong = re.search(r"wrong +self-test on the explicit backend: (.*)", capsys.readouterr().out)[1]
    assert re.fullmatch(r"climb is 1\.\d+, not 1\.\d+; gradient of the climb in the mass is .*", wrong)


def test_doctor_names_versions_devices_and_every_extra(no_flight, capsys):
    assert main(["doctor", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["versions"]["jax"] == VERSION("jax") and told["devices"] and told["wrong"] == []
    assert set(told["extras"]) >= set(PROJECT["optional-dependencies"]) - {"all", "dev", "docs"}
    for name, extra in told["extras"].items():
        assert extra["present"] or extra["unavailable"] or extra["missing"]
        assert extra["install"] == install(name)
    assert main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert "self-test  explicit" in out and out.endswith("all is well\n")


WHERE = """
import jax
from jaxdrones.cli import machine
machine.keep_programs()
machine.use_all_cores()
print(jax.device_count(), jax.config.jax_compilation_cache_dir)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("told", "devices", "folder"),
    [
        ({}, min(machine.cores(), 4), "home/.cache/jaxdrones/*"),
        ({"XDG_CACHE_HOME": "other", "JAX_NUM_CPU_DEVICES": "3"}, 3, "other/jaxdrones/*"),
        ({"JAX_COMPILATION_CACHE_DIR": "mine", "XLA_FLAGS": "--xla_force_host_platform_device_count=5"}, 5, "mine"),
        ({"HOME": "a-file"}, min(machine.cores(), 4), "None"),
    ],
)
def test_cores_are_devices_and_programs_are_kept_unless_jax_was_told_otherwise(told, devices, folder, tmp_path):
    (tmp_path / "a-file").write_text("no folder")
    names = ("JAX_", "XLA_", "XDG_", "HOME")
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(names)}
    environment = inherited | {"HOME": "home", "JAX_PLATFORMS": "cpu"} | told
    done = subprocess.run(
        [sys.executable, "-c", WHERE], env=environment, cwd=tmp_path, capture_output=True, text=True, check=True
    )
    count, where = done.stdout.split()
    assert int(count) == devices and Path(where).match(folder)


def test_doctor_says_where_compiled_programs_are_kept(no_flight, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(machine, "program_folder", lambda: tmp_path)
    (tmp_path / "jit_fly-cache").write_bytes(bytes(1_500_000))
    assert main(["doctor"]) == 0
    assert f"programs   1 compiled, 1.5 MB, in {tmp_path}" in capsys.readouterr().out


def test_a_missing_extra_is_named_and_not_wrong(no_flight, monkeypatch, capsys):
    def version(name):
        if name == "brax":
            raise importlib.metadata.PackageNotFoundError(name)
        return VERSION(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    assert main(["doctor"]) == 0
    assert re.search(r'brax +missing brax: pip install ".*\[brax\]"', capsys.readouterr().out)


@pytest.mark.parametrize(
    ("name", "found", "said"),
    [("jax", "0.9.1", "jax is 0.9.1, wanted is"), ("numpy", "1.26.4", "numpy is 1.26.4, wanted is >=2")],
)
def test_a_library_of_a_wrong_version_is_wrong(name, found, said, no_flight, monkeypatch, capsys):
    monkeypatch.setattr(importlib.metadata, "version", lambda asked: found if asked == name else VERSION(asked))
    assert main(["doctor", "--json"]) == 1
    (wrong,) = [text for text in json.loads(capsys.readouterr().out)["wrong"] if text.startswith(name)]
    assert said in wrong and f'pip install "{name}' in wrong


@pytest.mark.parametrize(
    ("error", "why"),
    [
        (RuntimeError("Unable to initialize backend 'cuda'"), "Unable to initialize backend 'cuda'"),
        (AssertionError(), "JAX_PLATFORMS is 'cuda'"),  # of JAX_PLATFORMS=cuda without a driver
    ],
)
def test_a_device_that_does_not_work_is_one_line(error, why, monkeypatch, capsys):
    def devices():
        raise error

    def broken(*_, **__):
        raise error

    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    monkeypatch.setattr(machine.jax, "devices", devices)
    assert main(["doctor"]) == 1
    assert f"wrong      jax finds no device: {why}" in capsys.readouterr().out
    monkeypatch.setattr("jaxdrones.cli.explain.explain", broken)
    assert main(["explain", "hover"]) == 2
    assert capsys.readouterr().err.startswith(f"jaxdrones: error: jax finds no device: {why}; JAX_PLATFORMS=cpu")


def test_doctor_understands_every_requirement_of_the_project():
    texts = [*PROJECT["dependencies"], *(x for extra in PROJECT["optional-dependencies"].values() for x in extra)]
    for text in texts:
        found = doctor._REQUIREMENT.fullmatch(text)
        signs = [re.match(r"[<>=]+", limit.strip())[0] for limit in found["versions"].split(",") if limit.strip()]
        assert set(signs) <= set(doctor._COMPARISONS), text
    assert doctor._numbers("0.10.2rc1") == (0, 10, 2)


@pytest.mark.slow
@pytest.mark.float32
def test_bench_stops_when_its_time_is_up(capsys):
    assert main(["bench", "--worlds", "4,8", "--seconds", "1e-6", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    (row,) = told["rates"]
    assert row["what"] == "plant" and row["worlds"] == 4 and row["per_s"] > 0
    assert told["left_out"] == 5  # of 3 kinds in 2 numbers of worlds
    assert told["line"].startswith("jaxdrones bench: plant ") and "\n" not in told["line"]
    assert VERSION("jax") in told["line"] and told["processor"] in told["line"] and "float32" in told["line"]


@pytest.mark.slow
@pytest.mark.float32
def test_bench_measures_the_plant_a_controller_and_an_environment(capsys):
    assert main(["bench", "--worlds", "16", "--seconds", "300"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert [re.search(r"([\d,]+)  (env|drone)-steps/s", line)[2] for line in out[:3]] == ["drone", "drone", "env"]
    assert re.match(r"jaxdrones bench: plant .* controller .* environment .* steps/s \(16 worlds\); float32", out[-1])
    assert len(out) == 4


def test_bench_refuses_what_is_no_number_of_worlds(capsys):
    assert main(["bench", "--worlds", "0"]) == 2
    assert "worlds is 0" in capsys.readouterr().err


def test_the_package_is_the_command_for_python(capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["jaxdrones", "--version"])
    with pytest.raises(SystemExit) as stop:
        runpy.run_module("jaxdrones", run_name="__main__")
    assert stop.value.code == 0 and capsys.readouterr().out == f"jaxdrones {machine.version('jaxdrones')}\n"


def test_the_version_is_that_of_the_package(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0 and capsys.readouterr().out == f"jaxdrones {machine.version('jaxdrones')}\n"

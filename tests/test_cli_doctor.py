"""`jaxdrones doctor` and `jaxdrones bench`."""

import functools
import importlib.metadata
import json
import re
import tomllib

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


@pytest.mark.float32
@pytest.mark.parametrize("backend", ["explicit", pytest.param("bullet", marks=pytest.mark.needs("pybullet"))])
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


def test_the_version_is_that_of_the_package(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0 and capsys.readouterr().out == f"jaxdrones {machine.version('jaxdrones')}\n"

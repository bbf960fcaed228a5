"""What is published, and what it is built from."""

import re
import tomllib

from documents import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
EXTRAS = PROJECT["project"]["optional-dependencies"]
PINS, RLLIB_PINS = ((ROOT / name).read_text().splitlines() for name in ("constraints.txt", "constraints-rllib.txt"))


def plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", re.match(r"[\w.-]+", name)[0]).lower()


def extras_in(requirement: str) -> set[str]:
    return set(re.fullmatch(r"jaxdrones\[(.*)\]", requirement)[1].split(","))


def test_the_extra_all_has_every_optional_library():
    assert extras_in(*EXTRAS["all"]) == EXTRAS.keys() - {"all", "dev", "docs"}
    assert extras_in(EXTRAS["dev"][0]) == extras_in(*EXTRAS["all"]) - {"sb3"} | {"docs"}  # sb3 brings torch


def test_what_has_no_wheels_for_newer_pythons_is_left_out_there():
    assert all("python_version < '3.12'" in requirement for requirement in EXTRAS["bullet"])


def test_a_constraint_is_a_name_and_a_version():
    assert [line for line in PINS + RLLIB_PINS if not re.fullmatch(r"[A-Za-z][\w.-]*==\d[\w.]*", line)] == []


def test_everything_that_is_asked_for_is_pinned():
    asked = [*PROJECT["project"]["dependencies"], *(x for extra in EXTRAS.values() for x in extra)]
    pinned = {plain(line) for line in PINS}
    assert {plain(x) for x in asked if not x.startswith("jaxdrones[")} <= pinned


def test_what_an_sdist_takes_along_is_there():
    for name in PROJECT["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]:
        assert name == "jaxdrones" or (ROOT / name).exists(), name  # the package may be installed from a wheel
    assert (ROOT / "LICENSE").read_text().startswith("MIT License\n\nCopyright (c) 2026 The jaxdrones developers")


def test_the_citation_has_the_version_and_licenses_of_the_package():
    text = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {PROJECT['project']['version']}\n" in text
    assert re.search(r"\nlicense: \[(.*)\]\n", text)[1].split(", ") == PROJECT["project"]["license"].split(" AND ")

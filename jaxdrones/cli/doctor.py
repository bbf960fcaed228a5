"""`jaxdrones doctor`."""

import argparse
import importlib.metadata
import operator
import platform
import re
import shutil
import time
from typing import Any

from jaxdrones.cli import machine
from jaxdrones.cli.report import print_results
from jaxdrones.errors import UserError, install

_LEFT_OUT = ("all", "dev", "docs")  # extras of extras, or for developers
_COMPARISONS = {"<=": operator.le, ">=": operator.ge, "<": operator.lt, "==": operator.eq}
_REQUIREMENT = re.compile(r"(?P<name>[\w.-]+)(\[[^]]*\])?\s*\(?(?P<versions>[^;)]*)\)?\s*(;(?P<marker>.*))?")


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "doctor",
        help="check versions, devices, extras, and run a self-test",
        description="Print versions, devices and installed extras, and compare a simulation with a closed-form "
        "solution. Missing extras are not an error.",
    )
    parser.set_defaults(run=_doctor)


def _doctor(options: argparse.Namespace) -> int:
    wrong: list[str] = []
    versions = machine.versions()
    required, extras = _requirements(wrong)
    for name, wanted in required.items():
        wrong += _unfit(name, wanted)
    try:
        devices = machine.devices()
    except UserError as error:
        devices = []
        wrong.append(str(error))
    present = {extra: _extra(extra, libraries, wrong) for extra, libraries in extras.items()}
    tests = _self_tests(present, wrong) if devices else {}
    result: dict[str, Any] = {"versions": versions, "processor": machine.processor(), "cores": machine.cores()}
    folder = machine.program_folder()
    sizes = [path.stat().st_size for path in folder.glob("*-cache")]
    result["programs"] = {"folder": str(folder), "files": len(sizes), "bytes": sum(sizes)}
    slow = bool(devices and shutil.which("nvidia-smi")) and all(device.startswith("cpu") for device in devices)
    notes = ['an NVIDIA driver is installed, but jax uses the CPU; pip install "jax[cuda12]" for the GPU'] * slow
    result |= {"devices": devices, "notes": notes, "extras": present, "self_test": tests, "wrong": wrong}
    print_results(options, result, _text(result))
    return 1 if wrong else 0


def _text(result: dict[str, Any]) -> str:
    lines = ["versions   " + ", ".join(f"{name} {version}" for name, version in result["versions"].items())]
    lines.append(f"processor  {result['processor']}, {result['cores']} cores")
    lines.append(f"devices    {', '.join(result['devices']) or 'none'}")
    lines += [f"           {note}" for note in result["notes"]]
    kept = result["programs"]
    lines.append(f"programs   {kept['files']} compiled, {kept['bytes'] / 1e6:.1f} MB, in {kept['folder']}")
    for title, (extra, entry) in zip(["extras", *[""] * len(result["extras"])], result["extras"].items(), strict=False):
        missing = f"missing {', '.join(entry['missing'])}: {entry['install']}"
        state = entry["unavailable"] or (missing if entry["missing"] else "present")
        lines.append(f"{title:9}  {extra:10} {state}")
    lines += [f"self-test  {backend:10} {said}" for backend, said in result["self_test"].items()]
    lines += [f"wrong      {problem}" for problem in result["wrong"]] or ["all is well"]
    return "\n".join(lines)


def _requirements(wrong: list[str]) -> tuple[dict[str, str], dict[str, list[re.Match]]]:
    """Requirements of the package and of its extras from the metadata: name -> versions."""
    try:
        texts = importlib.metadata.requires("jaxdrones") or []
    except importlib.metadata.PackageNotFoundError:
        wrong.append(
            "jaxdrones is imported from a folder and not installed; pip install it, for example with pip install -e ."
        )
        return {}, {}
    core: dict[str, str] = {}
    extras: dict[str, list[re.Match]] = {}
    for text in texts:
        found = _REQUIREMENT.fullmatch(text)
        assert found is not None, text
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", found["marker"] or "")
        if extra is None:
            core[found["name"]] = found["versions"]
        elif extra[1] not in _LEFT_OUT:
            extras.setdefault(extra[1], []).append(found)
    return core, extras


def _extra(extra: str, libraries: list[re.Match], wrong: list[str]) -> dict[str, Any]:
    """Missing libraries of an extra, and how to install them."""
    missing, unavailable = [], []
    for found in libraries:
        limit = re.search(r"python_version (<=?|>=?) ['\"]([\d.]+)['\"]", found["marker"] or "")
        if limit and not _COMPARISONS[limit[1]](_numbers(platform.python_version())[:2], _numbers(limit[2])):
            unavailable.append(f"{found['name']} is for Python {limit[1]} {limit[2]}")
        elif machine.version(found["name"]) == machine.NOT_INSTALLED:
            missing.append(found["name"])
        else:
            wrong += _unfit(found["name"], found["versions"])
    return {
        "present": not (missing or unavailable),
        "missing": missing,
        "unavailable": ", ".join(unavailable),
        "install": install(extra),
    }


def _unfit(name: str, wanted: str) -> list[str]:
    """Problem with the version of a library; empty for a supported one."""
    found = machine.version(name)
    if found == machine.NOT_INSTALLED:
        return [f'{name} is not installed; pip install "{name}{wanted}"']
    for limit in filter(None, (part.strip() for part in wanted.split(","))):
        sign = re.match(r"[<>=]+", limit)
        assert sign is not None, limit
        if not _COMPARISONS[sign[0]](_numbers(found), _numbers(limit[sign.end() :])):
            return [f'{name} is {found}, wanted is {wanted}; pip install "{name}{wanted}"']
    return []


def _numbers(version: str) -> tuple[int, ...]:
    """Release numbers of a version, without suffixes such as `rc1`."""
    found = re.match(r"\d+(\.\d+)*", version)
    return tuple(map(int, found[0].split("."))) if found else ()


def _self_tests(extras: dict[str, dict[str, Any]], wrong: list[str]) -> dict[str, str]:
    from jaxdrones.flights.self_test import self_test

    results = {}
    for backend in ("explicit", *(["bullet"] if extras.get("bullet", {}).get("present") else [])):
        begin = time.perf_counter()
        try:
            problem = self_test(backend)
        except Exception as error:  # whatever a broken installation raises
            problem = f"{type(error).__name__}: {error}"
        results[backend] = problem or f"agrees with the closed-form solution ({time.perf_counter() - begin:.1f} s)"
        wrong += [f"self-test on the {backend} backend: {problem}"] if problem else []
    return results

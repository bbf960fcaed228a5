"""Are the results on an accelerator correct, and how fast is it, in one command of at most ten minutes?

Tests, the plant, cameras, environments, teams of eight drones and learners, each in a separate process with a share of
the time; results that were measured until its end count. The ratios are relative to published figures (published.py) on
the hardware named there. They do not show how much of a difference is due to the code.
"""

import argparse
import dataclasses
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from benchmarks import published
from benchmarks.common import about
from jaxdrones.cli.machine import cores, devices

ROOT = Path(__file__).parent.parent
SHARES = {"tests": 0.25, "plant": 0.25, "cameras": 0.1, "envs": 0.1, "swarm": 0.1, "learning": 0.2}
"""Of the time; what a section leaves, the next ones have."""

TESTS = (
    "tests/engine/test_golden.py",
    "tests/engine/test_explicit.py",
    "tests/engine/test_gradients.py",
    "tests/dynamics/test_integrators.py",
    "tests/dynamics/test_aero.py",
    "tests/sensing/test_images.py",
)
DEVICE_TESTS = ("tests/accelerate/test_devices.py",)  # all of them slow
FEW_TESTS = ("tests/test_wrench.py",)
WORLDS = (262_144, 16_384, 65_536, 1_024, 1_048_576)  # the first ones are what the figures of others are for
MOST_WITH_GRADIENT = 262_144  # a few GiB
TEN_SUBSTEPS = "rk4, 10 substeps a call"
PLANTS = {
    "semi-implicit Euler": dict(integrator="semi_implicit_euler"),
    "rk4": dict(integrator="rk4"),
    TEN_SUBSTEPS: dict(integrator="rk4", substeps=10),
}
HOVERS = 0.99  # success from which a training counts as one
Row = dict[str, object]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--sections", nargs="+", default=list(SHARES), choices=list(SHARES))
    parser.add_argument("--budget", type=float, default=570.0, metavar="S", help="seconds for all (570)")
    parser.add_argument("--output", type=Path, default=Path("runs/accelerator.json"), help="JSON to write")
    parser.add_argument("--rows", type=Path, help=argparse.SUPPRESS)  # of a section's own process: where rows go


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    if options.rows:
        measure(options)
        return {}, []
    result = measured(options)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(result, indent=2))
    return result, [*table(result), f"written: {options.output}"]


def measured(options: argparse.Namespace) -> dict[str, object]:
    """What all sections found, each in the time that it has."""
    end = time.monotonic() + options.budget
    result: dict[str, object] = {"about": {}, "rows": [], "stopped": {}}
    groups = [options.sections] if options.quick else [[section] for section in options.sections]
    for i, group in enumerate(groups):
        left = [section for sections in groups[i:] for section in sections]
        share = sum(SHARES[section] for section in group) / sum(SHARES[section] for section in left)
        part = run(group, share * (end - time.monotonic()), options.quick)
        for name, found in part.items():
            result[name] = result[name] + found if name == "rows" else result[name] | found
    return result


def run(sections: list[str], seconds: float, quick: bool) -> dict[str, object]:
    """The rows of some sections, by a process that is ended when its time is up."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rows"
        file.touch()
        command = [
            sys.executable,
            "-m",
            "benchmarks",
            "accelerator",
            "--sections",
            *sections,
            "--rows",
            str(file),
            *["--quick"] * quick,
        ]
        stopped = ended(command, seconds)
        rows = [json.loads(line) for line in file.read_text().splitlines()]
    about = [row.pop("about") for row in rows if "about" in row]
    return {
        "about": about[0] if about else {},
        "rows": [row for row in rows if row],
        "stopped": {", ".join(sections): stopped} if stopped else {},
    }


def ended(command: list[str], seconds: float) -> str | None:
    """Run a command, and end it with all that it started when the time is up; why it did not come to its end."""
    process = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        _, said = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return f"the time was up after {seconds:.0f} s"
    return said.strip().splitlines()[-1] if process.returncode else None


def measure(options: argparse.Namespace) -> None:
    """Write a line for each measurement as soon as it is made."""
    for section in options.sections:
        if section != "tests":  # they need the accelerator for themselves
            write(options.rows, {"about": about() | {"device": devices()[0]}})
        for found in MEASURES[section](options.quick):
            write(options.rows, {"section": section} | found)


def write(file: Path, found: Row) -> None:
    with file.open("a") as rows:
        rows.write(json.dumps(found) + "\n")


def tests(quick: bool) -> Iterator[Row]:
    """How many tests of each file pass, and which fail; several processes share the memory of the accelerator."""
    for files, which in [(FEW_TESTS, "not slow")] if quick else [(TESTS, "not slow"), (DEVICE_TESTS, "slow")]:
        yield from tested(files, which)


def tested(files: Sequence[str], which: str) -> Iterator[Row]:
    """How many tests of each file with these marks pass, and which fail."""
    command = [sys.executable, "-m", "pytest", "-q", *files, "-m", which, f"--numprocesses={cores()}"]
    command += ["-p", "no:benchmark"]  # a plugin that warns of several processes, and warnings are errors
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        sharing = os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
        said = subprocess.run([*command, f"--junitxml={report}"], cwd=ROOT, env=sharing, capture_output=True, text=True)
        if not report.exists():
            raise RuntimeError(f"pytest did not run: {(said.stdout + said.stderr).strip().splitlines()[-1:]}")
        cases = list(ElementTree.parse(report).iter("testcase"))
    note = f"all files in {time.monotonic() - start:.0f} s"
    for file in files:
        name = file.removesuffix(".py").replace("/", ".")
        own = [x for x in cases if name in (x.get("classname"), x.get("name"))]  # a file that fails to load is a name
        failed = [x.get("name") for x in own if x.find("failure") is not None or x.find("error") is not None]
        tried = len(own) - sum(x.find("skipped") is not None for x in own)
        told = f"of {tried}, {note}{'; failed: ' * bool(failed)}{', '.join(failed)}"
        yield {"what": file, "value": tried - len(failed), "unit": "passed", "note": told, "failed": failed}


def plant(quick: bool) -> Iterator[Row]:
    """Steps per second of one drone a world with drag and lagging rotors, and with the gradient."""
    for worlds in (64,) if quick else WORLDS:
        for name, changes in list(PLANTS.items())[:1] if quick else PLANTS.items():
            yield from flown(name, worlds, 1, plants(name, worlds), quick, **changes)


def plants(name: str, worlds: int) -> list[published.Figure]:
    """What others publish of a plant with so many worlds; for l2f that number is not known."""
    tables = [published.CRAZYFLOW] + [published.SKYFLOW_PLANT] * ("rk4" in name)
    found = [table[worlds] for table in tables if worlds in table]
    return found + [published.L2F] * (name == TEN_SUBSTEPS and worlds == max(WORLDS))


def swarm(quick: bool) -> Iterator[Row]:
    """Drone-steps per second of eight drones in each other's jets: the plant, and an environment of it."""
    for worlds in () if quick else (16_384, 1_024):
        yield from flown("eight drones, downwash", worlds, 8, [], quick, effects="drag,downwash")
    what = "swap-goals, eight drones, downwash"
    yield from stepped(what, "swap-goals", {}, quick, drones=8, pairs=("downwash",))


def cameras(quick: bool) -> Iterator[Row]:
    """Images per second, with 20 solids without ground, 64 x 64 and 80 degrees, and in a forest of 103, 64 x 48.

    Each camera is in a world of its own. The first workload is that of HyperLux, whose figure was not found.
    """
    from benchmarks import cameras as benchmark

    scenes = {"A": (8, 6)} if quick else {"A": (64, 64), "B": (64, 48)}
    for scene, resolution in scenes.items():
        for count in (2,) if quick else (4096, 1024):
            found = benchmark.rates(scene, resolution, count, repeats=1 if quick else 3)
            for way, rate in found["rates"].items():
                note = f"first call {found['compile'][way]:.1f} s"
                figures = [published.MUJOCO_WARP] * (resolution == (64, 64) and way in ("depth", "all with color"))
                yield row(f"scene {scene}, {way}", rate, figures, worlds=count, unit="images/s", note=note)


def envs(quick: bool) -> Iterator[Row]:
    """Environment steps per second, with observation, reward and fresh episodes, ten substeps of rk4 in each."""
    options = dict(rotors="lagging", integrator="rk4", substeps=10)
    yield from stepped("hover, rk4 with lag, 10 substeps", "hover", published.SKYFLOW_ENVS, quick, **options)


def flown(
    what: str, worlds: int, drones: int, figures: Sequence[published.Figure], quick: bool, **changes
) -> Iterator[Row]:
    from benchmarks import throughput

    options = dict(effects="drag", rotors="lagging", integrator="semi_implicit_euler", substeps=1)
    options |= dict(
        drones=drones,
        vmap=False,
        float64=False,
        gradient_worlds=MOST_WITH_GRADIENT,
        quick=quick,
        repeats=1 if quick else 3,
    )
    options = argparse.Namespace(**options | changes)
    found = throughput.measure(throughput.make_step(options), worlds, options)
    of = {"worlds": worlds, "unit": "drone-steps/s"}
    compiling = f"first call {found['forward first call']:.1f} s"
    yield row(what, 1e6 * found["forward"], figures, note=compiling, **of)
    compiling = f"first call {found['backward first call']:.1f} s"
    of["worlds"] = min(worlds, MOST_WITH_GRADIENT)
    yield row(f"{what}, with gradient", 1e6 * found["with backward"], [], note=compiling, **of)


def stepped(what: str, task: str, by_worlds: Mapping[int, published.Figure], quick: bool, **options) -> Iterator[Row]:
    from benchmarks import envs as benchmark
    from jaxdrones.envs import make

    env = make(task, **options)
    for worlds in (4,) if quick else (65_536, 16_384, 1_024):
        options = argparse.Namespace(worlds=worlds, devices=1, repeats=1 if quick else 3)
        rate = env.drones * benchmark.in_jit(env, options)
        figures = [published.QUADSWARM[env.drones], *([by_worlds[worlds]] if worlds in by_worlds else [])]
        yield row(what, rate, figures, worlds=worlds, unit="drone-steps/s", note="environment")


def learning(quick: bool) -> Iterator[Row]:
    """Seconds of training to hover, full four motors from any motion, and what success that has."""
    from benchmarks import learning as benchmark
    from jaxdrones.training.recipe import Recipe

    small = dict(updates=2, worlds=8, horizon=4) if quick else {}
    for algorithm in ("bptt",) if quick else ("bptt", "ppo"):
        options = argparse.Namespace(cache=None, first_seed=0, seeds=1, episodes=10 if quick else 10_000)
        (found,), spent = benchmark.measure(Recipe.of("hover", algorithm, **small), options)
        hovers = found["success"] >= HOVERS
        figures = [published.LEARNING_TO_FLY_IN_SECONDS] * hovers
        note = f"success {found['success']:.4f}, compiled in {spent['compile s']:.1f} s"
        yield row(f"hover by {algorithm}", found["run"], figures, unit="s", note=note, success=found["success"])
        figures = [published.PUFFERLIB] * (algorithm == "ppo")
        rate = found["steps"] / found["run"]
        yield row(f"hover by {algorithm}, with learning", rate, figures, unit="env-steps/s", note=note)


def row(what: str, value: float, figures: Sequence[published.Figure], **more) -> Row:
    """A measurement beside published figures; a ratio is above one where ours is the better one."""
    beside = [
        dataclasses.asdict(figure) | {"ratio": figure.value / value if figure.unit == "s" else value / figure.value}
        for figure in figures
    ]
    return {"what": what, "value": value, "published": beside} | more


MEASURES = {"tests": tests, "plant": plant, "cameras": cameras, "envs": envs, "swarm": swarm, "learning": learning}


def table(result: dict) -> list[str]:
    """Lines for people."""
    lines: list[str] = []
    sources: dict[str, int] = {}
    for found in result["rows"]:
        worlds = f"{found['worlds']:>9,} worlds" if "worlds" in found else " " * 16
        value = "-" if found["value"] is None else f"{found['value']:,.4g}"
        line = f"{found['section']:8} | {found['what']:42} | {worlds} | {value:>10} {found['unit']:13}"
        lines.append(f"{line} | {found['note']}")
        for theirs in found.get("published", ()):
            number = sources.setdefault(f"{theirs['what']}, {theirs['hardware']}: {theirs['source']}", len(sources) + 1)
            lines.append(f"{'':11}{theirs['ratio']:8.3g} times {theirs['value']:,.4g} {theirs['unit']} [{number}]")
    lines += [f"[{number}] {source}" for source, number in sources.items()]
    return lines + [f"stopped: {section}: {why}" for section, why in result["stopped"].items()]

"""`jaxdrones compare`."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxdrones.cli.common import check_writable
from jaxdrones.cli.flight_options import add_conditions, check_conditions, fly_options, warn
from jaxdrones.cli.options import add_no_figure, add_output, option, split_names
from jaxdrones.cli.report import print_results, table
from jaxdrones.errors import UserError
from jaxdrones.flights import results
from jaxdrones.flights.conditions import BACKENDS, CONTROLLERS
from jaxdrones.flights.examples import FLIGHTS
from jaxdrones.flights.files import save_npz
from jaxdrones.flights.log import FlightLog
from jaxdrones.user_code import is_reference
from jaxdrones.visualization import comparison

_BACKENDS = "explicit,bullet"


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "compare",
        help="fly an example on both backends, or by several controllers, and print how they differ",
        description="Fly an example on two backends from the same start and print their divergence over time, or fly "
        "it by several controllers with the same set-points and print the errors of each. With --output draw paths "
        "and errors of all, too.",
    )
    option(parser, "flight FLIGHT", "{}", known=FLIGHTS)
    add_conditions(parser)
    compared = parser.add_argument_group("comparison")
    files = parser.add_argument_group("files and output")
    option(compared, "--backends A,B", f"two of {', '.join(BACKENDS)} ({_BACKENDS})")
    text = f"in place of --backends: two or more of {', '.join(CONTROLLERS)}, or .py files"
    option(compared, "--controllers A,B", text)
    add_output(files, "folder of figure and logs (none)")
    add_no_figure(files)
    parser.set_defaults(run=_compare)


def _compare(options: argparse.Namespace) -> int:
    kind, cases = _cases(options)
    for flown, backend in cases.values():
        check_conditions(flown, backend=backend)
    logs = _logs(options, list(cases))
    records = {name: fly_options(flown, backend=backend) for name, (flown, backend) in cases.items()}
    settling_time = FLIGHTS[options.flight].settling_time
    for name, log in logs.items():
        save_npz(records[name], log)
    files = list(logs.values())
    if logs and not options.no_figure:
        files.append(options.output / "compare.png")
        title = (" against " if len(cases) == 2 else ", ").join(cases)
        comparison.save_comparison(records, files[-1], f"{options.flight}: {title}", settling_time)
    diverged = {name: results.diverged(record) for name, record in records.items()}
    about: dict[str, Any] = {"flight": options.flight, kind: list(cases), "diverged": diverged}
    about["files"] = list(map(str, files))
    if kind == "backends":
        first, second = records.values()
        found = {"divergence": results.divergence(first, second)}
        headline, text = " against ".join(cases) + ", largest difference over the drones", table(found["divergence"])
    else:
        found = {"results": _results(records, settling_time)}
        headline = ", ".join(cases) + ", largest over the drones"
        text = f"{table(found['results'])}\n{results.definitions(next(iter(records.values())), settling_time)}"
    wrote = "wrote " + ", ".join(about["files"]) if files else None
    print_results(options, about | found, f"{options.flight}: {headline}", text, wrote)
    return max(warn(drones, name) for name, drones in diverged.items())


def _cases(options: argparse.Namespace) -> tuple[str, dict[str, tuple[argparse.Namespace, str]]]:
    """Kind of comparison, `backends` or `controllers`, and options and backend of each flight by name."""
    if options.controllers is None:
        names = _names("backends", options.backends or _BACKENDS)
        if len(names) != 2:
            raise UserError(f"--backends is {options.backends!r}; give two different ones, for example {_BACKENDS}")
        return "backends", {name: (options, name) for name in names}
    for name in ("backends", "controller"):
        if getattr(options, name) is not None:
            raise UserError(f"--{name} {getattr(options, name)} is given beside --controllers; leave one of them out")
    names = _names("controllers", options.controllers)
    if len(names) < 2:
        raise UserError(f"--controllers is {options.controllers!r}; give two or more, for example pid,lqr")
    feedforward = options.feedforward is not False and options.flight != "velocity"
    same = vars(options) | {"feedforward": feedforward}
    labels = [Path(name).stem if is_reference(name) else name for name in names]
    twice = next((label for label in labels if labels.count(label) > 1), None)
    if twice is not None:
        raise UserError(f"--controllers has two controllers named {twice!r}; rename one of the files")
    flown = (argparse.Namespace(**same | {"controller": name}) for name in names)
    return "controllers", {label: (case, "explicit") for label, case in zip(labels, flown, strict=True)}


def _names(option: str, text: str) -> list[str]:
    names = split_names(text)
    if len(set(names)) < len(names):
        raise UserError(f"--{option} is {text!r}; give two different ones, or more")
    return names


def _logs(options: argparse.Namespace, names: list[str]) -> dict[str, Path]:
    """Paths of the logs by name; raise before the flights if a file cannot be written."""
    if options.output is None:
        return {}
    logs = {name: options.output / name / "log.npz" for name in names}
    check_writable(*logs.values(), None if options.no_figure else options.output / "compare.png")
    return logs


def _results(records: Mapping[str, FlightLog], after: float) -> list[dict[str, Any]]:
    """One row per controller: the largest value over the drones; `None` if any drone lacks it."""
    rows = []
    for name, record in records.items():
        drones = results.results(record, after)
        row: dict[str, Any] = {"controller": name}
        for column in drones[0]:
            if "error" in column or column in ("settled_after_s", "rpm_std"):
                values: list[Any] = [drone[column] for drone in drones]
                row[column] = None if None in values else max(values)
        rows.append(row)
    return rows

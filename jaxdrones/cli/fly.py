"""`jaxdrones fly`."""

import argparse
import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from jaxdrones.cli.common import check_writable, folder, print_error
from jaxdrones.cli.flight_options import CONDITIONS, add_conditions, check_conditions, fly_options, progress, warn
from jaxdrones.cli.live import add_live, live_server
from jaxdrones.cli.options import add_backend, add_no_figure, add_output, add_set, add_task, option, switch
from jaxdrones.cli.policies import is_user_policy, open_policy, output_folder, team_of_run
from jaxdrones.cli.report import described, print_results, summary, table
from jaxdrones.cli.settings import add_realistic, parse_settings
from jaxdrones.errors import UserError
from jaxdrones.flights import results
from jaxdrones.flights.examples import FLIGHTS
from jaxdrones.flights.files import check_pwm, save_csv, save_npz
from jaxdrones.flights.log import FlightLog, LoggedConditions
from jaxdrones.training.episode import fly_episode, to_record
from jaxdrones.visualization import films, paths, plots

_SETTLING_SHARE = 0.6  # share of an episode after which its results are taken


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "fly",
        help="fly one of the control examples, or a trained policy",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Fly one of the control examples of gym-pybullet-drones (2021), or an episode of a trained policy\n"
        "(--policy RUN). Write a log and a figure, print a table of results.\n\n"
        + "\n".join(f"  {name:14} {flight.summary}" for name, flight in FLIGHTS.items()),
        epilog="Every example has its own defaults. `jaxdrones list` shows the names to choose from.\n\n"
        "A flight has diverged if at its end a drone is upside down, or its error is 1 m (or 1 m/s) larger than at\n"
        "the start. Files of an earlier flight in --output are replaced.",
    )
    option(parser, "flight FLIGHT", "{}", known=FLIGHTS, nargs="?")
    add_conditions(parser)
    policy = parser.add_argument_group("policy")
    bullet = parser.add_argument_group("backend")
    shown = parser.add_argument_group("films and pictures")
    files = parser.add_argument_group("files and output")
    option(
        policy,
        "--policy RUN",
        "in place of FLIGHT: a folder of `jaxdrones train`; a task with a bundled policy (`jaxdrones list`), for "
        "example forest; any-vehicle or raptor; or file.py:name, whose code is executed",
        folder,
    )
    add_task(policy, "with file.py:name, any-vehicle or raptor: task, as for `jaxdrones train`")
    add_realistic(policy, "with file.py:name: ")
    add_set(policy, "with file.py:name: option of the environment (action, observation, ...)")
    add_backend(bullet)
    switch(bullet, "--obstacles", "add the obstacles of gym-pybullet-drones (2021) (bullet)")
    switch(bullet, "--gui", "show Bullet's window, with motor sliders (bullet)")
    option(shown, "--video FILE", "film of the flight, .mp4 or .gif", folder)
    chosen = "of the film: {} (page if Chromium is installed, else jax)"
    option(shown, "--renderer NAME", chosen, known=films.RENDERERS)
    add_live(shown, "show the flight in the browser in real time")
    switch(shown, "--cameras", "write the images of each drone's camera as PNG and into the log")
    add_output(files, "folder of log and figure (runs/FLIGHT, RUN/flight)")
    switch(files, "--csv", "write the log as CSV too")
    switch(files, "--pwm", "log the Crazyflie's PWM signals too (cf2x, cf2p)")
    add_no_figure(files)
    parser.set_defaults(run=functools.partial(_fly, parser))


def _fly(parser: argparse.ArgumentParser, options: argparse.Namespace) -> int:
    if options.flight is None and options.policy is None:
        parser.error("the following arguments are required: FLIGHT, or --policy RUN")
    _refuse(parser, options)
    if options.video:
        options.renderer = films.choose_renderer(options.renderer, options.video)
    if options.cameras:
        from jaxdrones.visualization import replay  # noqa: F401  says which extra to install
    return _fly_policy(options) if options.policy is not None else _fly_example(options)


def _refuse(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Raise for options that contradict the policy or the example."""
    if options.renderer is not None and options.video is None:
        raise UserError(f"--renderer {options.renderer} is given without --video FILE; give both or none")
    if options.policy is None:
        given = {f"--set {x}": x for x in options.set[:1]} | {f"--task {options.task}": options.task}
        for name, x in (given | {"--realistic": options.realistic}).items():
            if x:
                raise UserError(f"{name} is given without --policy file.py:name; leave it out, or give both")
        return
    own = is_user_policy(options.policy)
    for name in ("flight", *([] if own else ["vehicle"]), *CONDITIONS, "obstacles", "gui"):
        if getattr(options, name) != parser.get_default(name):
            what = "the task" if own else "the run"
            raise UserError(f"{name} {getattr(options, name)} is given beside --policy; {what} determines it")


def _fly_example(options: argparse.Namespace) -> int:
    output = options.output or Path("runs") / options.flight
    check_conditions(options, backend=options.backend, obstacles=options.obstacles)
    _check_files(options, output, options.vehicle)
    example = FLIGHTS[options.flight]
    title = f"{options.flight}: {example.summary}"
    with live_server(options.live, options.json) as live:
        conditions = dict(backend=options.backend, obstacles=options.obstacles, gui=options.gui)
        record = fly_options(options, **conditions, watch=live.add if live else None)
    files = _write(record, options, output, title, example.panels)
    diverged = results.diverged(record)
    _report(options, record, example.settling_time, files, diverged)
    return warn(diverged)


def _fly_policy(options: argparse.Namespace) -> int:
    run = open_policy(options.policy, options.task, options.realistic, _options_of_task(options))
    seed = options.seed or 0
    recipe = run.recipe()
    vehicle = "any vehicle" if recipe.realistic == "any" else str(recipe.options.get("vehicle", "cf2x"))
    output = options.output or output_folder(options.policy, "flight")
    team = team_of_run(options, {})
    with recipe.env(backend=options.backend, **team) as env, progress() as report:
        policy = run.policy(env=env)
        _check_files(options, output, vehicle)
        title = f"{recipe.task}: {env.task.summary} ({recipe.algorithm}, {options.backend})"
        with live_server(options.live, options.json, title) as live:
            on_progress = report or (lambda fraction: None)
            episode = fly_episode(env, policy, jax.random.key(seed), on_progress, live.add if live else None)
    entries = {"run": str(options.policy), "task": recipe.task, "algorithm": recipe.algorithm}
    entries |= {"realistic": recipe.realistic, "backend": options.backend, "seed": seed, "vehicle": vehicle}
    backend = "Bullet" if options.backend == "bullet" else f"the {options.backend} backend"
    about = f"{described(recipe, **team)}, policy of {options.policy}, on {backend}, seed {seed}"
    record = to_record(episode, LoggedConditions(entries | {"options": recipe.options | team}, about))
    files = _write(record, options, output, title, plots.POLICY_PANELS)
    end = {
        "success": episode.success,
        "return": float(episode.reward.sum(axis=0).mean()),
        "ended_by": list(episode.ended_by),
        "duration": float(record.t[-1]),
        "metrics": {name: x[-1].astype(float).tolist() for name, x in episode.metrics.items()},
    }
    broken = record.not_finite()
    _report(options, record, _SETTLING_SHARE * float(record.t[-1]), files, broken, end)
    return print_error(next(iter(broken.values())), 1) if broken else 0


def _options_of_task(options: argparse.Namespace) -> dict[str, Any]:
    """Options of `jaxdrones.make` for a policy of a user's file; for a run those of --set, an error."""
    chosen = parse_settings(options.set)
    for name in ("drones", "vehicle"):
        if name in chosen:
            raise UserError(f"--set {name}={chosen[name]} is given; give --{name} {chosen[name]} in its place")
    if is_user_policy(options.policy):
        chosen |= {"vehicle": options.vehicle} | ({} if options.drones is None else {"drones": options.drones})
    return chosen


def _report(
    options: argparse.Namespace,
    record: FlightLog,
    after: float,
    files: list[Path],
    diverged: dict[str, str],
    end: dict | None = None,
) -> None:
    """Print the results after a time, s; `end` describes the end of an episode."""
    rows = results.results(record, after)
    about = record.conditions.as_dict() | (end or {})
    about |= {"results": rows, "diverged": diverged, "files": list(map(str, files))}
    lines = [record.conditions, table(rows if len(rows) <= paths.MOST_NAMED else summary(rows))]
    lines.append(results.definitions(record, after))
    if end is not None:
        how = {True: "success", False: "no success", None: "done"}[end["success"]]
        why = f"ended by {', '.join(end['ended_by'])}" if end["ended_by"] else "to the end"
        lines.append(f"{how}: return {end['return']:.1f}, {end['duration']:.2f} s, {why}")
    print_results(options, about, *lines, "wrote " + ", ".join(map(str, files)))


def _check_files(options: argparse.Namespace, output: Path, vehicle: str) -> None:
    """Raise before the flight if an output file cannot be written, or a vehicle has no PWM signals."""
    if options.pwm:
        check_pwm(vehicle)
    names = ["log.npz", *["log.csv"] * options.csv, *["flight.png"] * (not options.no_figure)]
    check_writable(*(output / name for name in names))
    if options.cameras:
        (output / "cameras").mkdir(exist_ok=True)
    if options.video:
        try:
            check_writable(options.video)
        except OSError as error:
            raise UserError(f"--video {options.video} cannot be written: {error.strerror}; choose another") from None


def _write(
    record: FlightLog, options: argparse.Namespace, output: Path, title: str, panels: Sequence[str]
) -> list[Path]:
    files = [output / "log.npz"]
    save_npz(record, files[0], options.pwm)
    for name, is_requested in (("log.csv", options.csv), ("flight.png", not options.no_figure)):
        if not is_requested:
            (output / name).unlink(missing_ok=True)  # of an earlier flight, whose log was replaced
    if options.csv:
        files.append(output / "log.csv")
        save_csv(record, files[-1], options.pwm)
    if not options.no_figure:
        files.append(output / "flight.png")
        plots.save_flight(record, files[-1], title, panels)
    if options.video:
        with progress("filming") as report:
            films.film(record, options.video, title, options.renderer, on_frame=report or (lambda share: None))
        files.append(options.video)
    if options.cameras:
        from jaxdrones.visualization import replay  # needs pybullet

        files.append(output / "cameras")
        images = {"rgb": replay.save_cameras(record, files[-1])}
        save_npz(dataclasses.replace(record, images={**record.images, **images}), files[0], options.pwm)
    return files

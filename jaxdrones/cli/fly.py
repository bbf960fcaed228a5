"""`jaxdrones fly`."""

import argparse
import functools
from collections.abc import Sequence
from pathlib import Path

from jaxdrones.checks import check_choice
from jaxdrones.cli.common import as_json, check_writable, folder, print_error, table
from jaxdrones.cli.flight_options import add_conditions, check_conditions, fly_options, progress, warn
from jaxdrones.flights.conditions import BACKENDS
from jaxdrones.flights.examples import FLIGHTS
from jaxdrones.flights.fly import scene_of
from jaxdrones.flights.record import Record, check_pwm
from jaxdrones.limits import check_seed
from jaxdrones.sensing import Scene
from jaxdrones.visualization import plots, video

_SETTLING_SHARE = 0.6  # share of an episode after which its results are taken


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "fly",
        help="fly one of the control examples, or a trained policy",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Fly one of the control examples of gym-pybullet-drones (2021), or an episode of a trained policy\n"
        "(--policy RUN); writes a log and a figure, prints a table of results.\n\n"
        + "\n".join(f"  {name:14} {flight.summary}" for name, flight in FLIGHTS.items()),
        epilog="Every example has its own defaults. `jaxdrones list` shows the names to choose from.\n\n"
        "Exit code 1 says that a flight diverged: at the end a drone is upside down, or its error is 1 m (or 1 m/s)\n"
        "larger than at the start. Files of an earlier flight in --output are replaced, other files stay.",
        allow_abbrev=False,
    )
    parser.add_argument("flight", metavar="FLIGHT", nargs="?", help=", ".join(FLIGHTS))
    add_conditions(parser)
    parser.add_argument(
        "--policy", type=folder, metavar="RUN", help="in place of FLIGHT: a folder of `jaxdrones train`"
    )
    parser.add_argument("--backend", default="explicit", help=f"{', '.join(BACKENDS)} (explicit)")
    parser.add_argument(
        "--obstacles", action="store_true", help="add the obstacles of gym-pybullet-drones (2021) (bullet)"
    )
    parser.add_argument("--gui", action="store_true", help="show Bullet's window, with motor sliders (bullet)")
    parser.add_argument("--video", type=folder, metavar="FILE", help="film the flight as .mp4 or .gif; either backend")
    parser.add_argument(
        "--cameras", action="store_true", help="write the pictures of each drone's camera as PNG; either backend"
    )
    parser.add_argument(
        "--output", type=folder, metavar="DIR", help="folder of log and figure (runs/FLIGHT, RUN/flight)"
    )
    parser.add_argument("--csv", action="store_true", help="write the log as CSV too")
    parser.add_argument("--pwm", action="store_true", help="log the Crazyflie's PWM signals too (cf2x, cf2p)")
    parser.add_argument("--no-figure", action="store_true", help="write no figure; needs no matplotlib")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else on stdout")
    parser.set_defaults(run=functools.partial(_fly, parser))


def _fly(parser: argparse.ArgumentParser, options: argparse.Namespace) -> int:
    if options.flight is None and options.policy is None:
        parser.error("the following arguments are required: FLIGHT, or --policy RUN")
    if options.policy is not None:
        own = ("flight", "drones", "vehicle", "effects", "controller", "control_hz", "duration", "rotors", "integrator")
        for name in (*own, "obstacles", "gui"):
            if getattr(options, name) != parser.get_default(name):
                raise ValueError(
                    f"{name} {getattr(options, name)} is given beside --policy; the run says what is flown"
                )
    if not options.no_figure:
        plots.check_matplotlib()
    if options.video:
        video.check_video(options.video)
    if options.video or options.cameras:
        from jaxdrones.visualization import replay  # noqa: F401  says which extra to install
    return _fly_policy(options) if options.policy is not None else _fly_example(options)


def _fly_example(options: argparse.Namespace) -> int:
    check_choice("flight", options.flight, FLIGHTS)
    if options.pwm:
        check_pwm(options.vehicle)
    output = options.output or Path("runs") / options.flight
    check_conditions(options, backend=options.backend, obstacles=options.obstacles)
    _check_files(options, output)
    record = fly_options(options, backend=options.backend, obstacles=options.obstacles, gui=options.gui)
    example = FLIGHTS[options.flight]
    title = f"{options.flight}: {example.summary}"
    files = _write(record, options, output, title, example.panels, scene_of(record.conditions))
    _report(options, record, record.results(example.settling_time), files, record.diverged())
    return warn(record.diverged())


def _fly_policy(options: argparse.Namespace) -> int:
    import jax

    from jaxdrones.training.episode import EpisodeConditions, fly_episode, to_record
    from jaxdrones.training.open_run import open_run

    check_choice("backend", options.backend, BACKENDS)
    run, seed = open_run(options.policy), options.seed or 0
    recipe = run.recipe()
    check_seed("seed", seed)
    vehicle = str(recipe.options.get("vehicle", "cf2x"))
    if options.pwm:
        check_pwm(vehicle)
    output = options.output or options.policy / "flight"
    with recipe.env(backend=options.backend) as env, progress() as report:
        policy = run.policy(env=env)
        _check_files(options, output)
        episode = fly_episode(env, policy, jax.random.key(seed), report or (lambda fraction: None))
    conditions = EpisodeConditions(
        str(options.policy),
        recipe.task,
        recipe.trained_by,
        recipe.realistic,
        options.backend,
        seed,
        vehicle,
        recipe.options,
    )
    record = to_record(episode, conditions)
    title = f"{recipe.task}: {env.task.summary} ({recipe.trained_by}, {options.backend})"
    files = _write(record, options, output, title, plots.POLICY_PANELS, episode.scene)
    results = record.results(_SETTLING_SHARE * float(record.t[-1]))
    end = {
        "success": episode.success,
        "return": float(episode.reward.sum(axis=0).mean()),
        "ended_by": list(episode.ended_by),
        "duration": float(record.t[-1]),
        "metrics": {name: x[-1].astype(float).tolist() for name, x in episode.metrics.items()},
    }
    broken = record.not_finite()
    _report(options, record, results, files, broken, end)
    return print_error(next(iter(broken.values())), 1) if broken else 0


def _report(
    options: argparse.Namespace,
    record: Record,
    results: list,
    files: list[Path],
    diverged: dict[str, str],
    end: dict | None = None,
) -> None:
    """Print the results; `end` describes how an episode of a policy ended."""
    if options.json:
        about = record.conditions.as_dict() | (end or {})
        print(as_json(about | {"results": results, "diverged": diverged, "files": list(map(str, files))}))
    else:
        print(record.conditions)
        print(table(results))
        if end is not None:
            how = {True: "success", False: "no success", None: "done"}[end["success"]]
            why = f"ended by {', '.join(end['ended_by'])}" if end["ended_by"] else "to the end"
            print(f"(from {_SETTLING_SHARE * end['duration']:.2f} s on)")
            print(f"{how}: return {end['return']:.1f}, {end['duration']:.2f} s, {why}")
        print("wrote " + ", ".join(map(str, files)))


def _check_files(options: argparse.Namespace, output: Path) -> None:
    """Raise if a file that is asked for cannot be written, before the flight."""
    names = ["log.npz", *["log.csv"] * options.csv, *["flight.png"] * (not options.no_figure)]
    for name in names:
        check_writable(output / name)
    if options.cameras:
        (output / "cameras").mkdir(exist_ok=True)
    if options.video:
        try:
            check_writable(options.video)
        except OSError as error:
            raise ValueError(f"--video {options.video} cannot be written: {error.strerror}; choose another") from None


def _write(
    record: Record, options: argparse.Namespace, output: Path, title: str, panels: Sequence[str], scene: Scene
) -> list[Path]:
    """Write log, figure, film and pictures, as asked for; returns their paths."""
    files = [output / "log.npz"]
    record.save_npz(files[0], options.pwm)
    if options.csv:
        files.append(output / "log.csv")
        record.save_csv(files[-1], options.pwm)
    if not options.no_figure:
        files.append(output / "flight.png")
        plots.save_flight(record, files[-1], title, panels)
    if options.video or options.cameras:
        from jaxdrones.visualization import replay  # needs pybullet

        if options.video:
            replay.film(record, options.video, scene)
            files.append(options.video)
        if options.cameras:
            files.append(output / "cameras")
            replay.save_cameras(record, files[-1], scene)
    return files

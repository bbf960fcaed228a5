"""`jaxdrones fly`."""

import argparse
import functools
import json
from collections.abc import Sequence
from pathlib import Path

from jaxdrones.checks import check_choice
from jaxdrones.cli.common import complain, table
from jaxdrones.cli.conditions import add_conditions, flown, progress
from jaxdrones.conditions import BACKENDS
from jaxdrones.flights import scene_of
from jaxdrones.record import Record
from jaxdrones.render import plots, video
from jaxdrones.sensing.scene import Scene
from jaxdrones.tasks.examples import FLIGHTS

_LATE = 0.6  # share of an episode from which on its results are taken


def add(commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "fly",
        help="fly one of the paper's control examples, or a trained policy",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Fly one of the paper's control examples, or an episode of a trained policy (--policy RUN);\n"
        "writes a log and a figure, prints a table of results.\n\n"
        + "\n".join(f"  {name:14} {flight.summary}" for name, flight in FLIGHTS.items()),
        epilog="What is left out is the flight's own. `jaxdrones list` shows the names to choose from.",
        allow_abbrev=False,
    )
    parser.add_argument("flight", metavar="FLIGHT", nargs="?", help=", ".join(FLIGHTS))
    add_conditions(parser)
    parser.add_argument("--policy", type=Path, metavar="RUN", help="in place of FLIGHT: a folder of `jaxdrones train`")
    parser.add_argument("--backend", default="explicit", help=f"{', '.join(BACKENDS)} (explicit)")
    parser.add_argument("--obstacles", action="store_true", help="put the paper's obstacles up (bullet)")
    parser.add_argument("--gui", action="store_true", help="watch in Bullet's window, with motor sliders (bullet)")
    parser.add_argument("--video", type=Path, metavar="FILE", help="film the flight as .mp4 or .gif; either backend")
    parser.add_argument("--cameras", action="store_true", help="write what each drone sees as PNG; either backend")
    parser.add_argument("--output", type=Path, metavar="DIR", help="folder of log and figure (runs/FLIGHT, RUN/flight)")
    parser.add_argument("--csv", action="store_true", help="write the log as CSV too")
    parser.add_argument("--pwm", action="store_true", help="log the Crazyflie's PWM beside the RPM")
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
    return _fly_policy(options) if options.policy is not None else _fly_example(options)


def _fly_example(options: argparse.Namespace) -> int:
    output = options.output or Path("runs") / options.flight
    output.mkdir(parents=True, exist_ok=True)
    record = flown(options, backend=options.backend, obstacles=options.obstacles, gui=options.gui)
    example = FLIGHTS[options.flight]
    title = f"{options.flight}: {example.summary}"
    files = _write(record, options, output, title, example.panels, scene_of(record.conditions))
    return _report(options, record, record.results(example.settled), files)


def _fly_policy(options: argparse.Namespace) -> int:
    import jax

    from jaxdrones.learning.episode import PolicyFlight, fly_episode, record_of
    from jaxdrones.learning.runs import run_in

    check_choice("backend", options.backend, BACKENDS)
    run, seed = run_in(options.policy), options.seed or 0
    recipe = run.recipe()
    output = options.output or options.policy / "flight"
    output.mkdir(parents=True, exist_ok=True)
    with recipe.env(backend=options.backend) as env, progress() as tell:
        episode = fly_episode(env, run.policy(env=env), jax.random.key(seed), tell or (lambda share: None))
    conditions = PolicyFlight(
        str(options.policy),
        recipe.task,
        recipe.learner,
        recipe.realistic,
        options.backend,
        seed,
        str(recipe.options.get("vehicle", "cf2x")),
        recipe.options,
    )
    record = record_of(episode, conditions)
    title = f"{recipe.task}: {env.task.summary} ({recipe.learner}, {options.backend})"
    files = _write(record, options, output, title, plots.POLICY_PANELS, env.task.scene)
    results = record.results(_LATE * float(record.t[-1]))
    end = {
        "success": episode.success,
        "return": float(episode.reward.sum(axis=0).mean()),
        "ends": list(episode.ends),
        "duration": float(record.t[-1]),
        "metrics": {name: x[-1].astype(float).tolist() for name, x in episode.metrics.items()},
    }
    return _report(options, record, results, files, end)


def _report(
    options: argparse.Namespace, record: Record, results: list, files: list[Path], end: dict | None = None
) -> int:
    """Print what came of it; `end` is of an episode."""
    if options.json:
        about = record.conditions.as_dict() | (end or {})
        print(json.dumps(about | {"results": results, "files": list(map(str, files))}))
    else:
        print(record.conditions)
        print(table(results))
        if end is not None:
            how = {True: "success", False: "no success", None: "done"}[end["success"]]
            why = f"ended by {', '.join(end['ends'])}" if end["ends"] else "to the end"
            print(f"(from {_LATE * end['duration']:.2f} s on)")
            print(f"{how}: return {end['return']:.1f}, {end['duration']:.2f} s, {why}")
        print("wrote " + ", ".join(map(str, files)))
    broken = record.first_not_finite()
    if broken:
        return complain(f"the state of {broken[1]} is not finite from t = {broken[0]:.3f} s on", 1)
    return 0


def _write(
    record: Record, options: argparse.Namespace, output: Path, title: str, panels: Sequence[str], scene: Scene
) -> list[Path]:
    """Log, figure, film and pictures, as asked for."""
    files = [output / "log.npz"]
    record.save_npz(files[0], options.pwm)
    if options.csv:
        files.append(output / "log.csv")
        record.save_csv(files[-1], options.pwm)
    if not options.no_figure:
        files.append(output / "flight.png")
        plots.save_flight(record, files[-1], title, panels)
    if options.video or options.cameras:
        from jaxdrones.render import replay  # needs pybullet

        if options.video:
            replay.film(record, options.video, scene)
            files.append(options.video)
        if options.cameras:
            files.append(output / "cameras")
            replay.save_cameras(record, files[-1], scene)
    return files

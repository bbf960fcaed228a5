"""How do controllers, planners and learned policies compare in the same scenarios, in success and computing time?

`python -m benchmarks leaderboard --pilot geometric --scenario hover` computes one row: it tunes or trains the pilot in
the undisturbed scenario, on separate starts, and then flies the scored starts, which are the same for all pilots.
Without options it computes the whole table. `success` has a 95 % interval (Wilson) over the distinct flights; `error`
is the distance from the target at the end, median and 99th percentile; `effort` is the root mean square deviation of
the rotor speeds from hover; `us` is the CPU time of a command for one drone in a compiled loop without physics (for
`mpc` the median of its calls), `obtain` that of tuning or training including compilation, and `flown` the simulated
time of flight in it.
"""

import argparse
import dataclasses
import functools
import importlib.util
import json
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import tables
from benchmarks.common import about, outcome
from benchmarks.leaderboard_pilots import PILOTS, Mpc, Obtained, Pilot
from benchmarks.leaderboard_scenarios import SCENARIOS, SCORED, TUNING
from jaxdrones.envs import Env
from jaxdrones.learning import evaluate
from jaxdrones.learning.evaluation import wilson_interval
from jaxdrones.learning.networks import act, initial_hidden_state

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TIMED = 200  # commands of a timing
SHORTEST = 0.1  # s, of calls of it
FIGURE = tables.ROOT / "benchmarks/figures/leaderboard.png"
_LINE = 5.0  # % between two names in the figure
DRAWN = ("hover", "rotor-70", "airframes")
COSTS = (
    ("seconds a command", 1e-6, "processor time of a command, us"),
    ("seconds to obtain", 1.0, "processor time of tuning or training, s"),
)
Row = dict[str, Any]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--pilot", nargs="+", choices=PILOTS, default=list(PILOTS), metavar="NAME", dest="pilots")
    parser.add_argument(
        "--scenario", nargs="+", choices=SCENARIOS, default=list(SCENARIOS), metavar="NAME", dest="scenarios"
    )
    parser.add_argument("--starts", type=int, help="instead of those of each pilot: 1,000, fewer of slow ones")
    parser.add_argument("--update", action="store_true", help="put the rows into results, page and figure")


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    pilots = {name: PILOTS[name] for name in options.pilots}
    if options.quick:
        pilots = {name: dataclasses.replace(pilots[name], candidates=2, tuning_starts=2) for name in pilots}
        pilots = pilots if len(pilots) < len(PILOTS) else {"nothing": pilots["nothing"], "pid": pilots["pid"]}
        options.scenarios, options.starts = options.scenarios[:1], options.starts or 4
    rows = []
    for name, pilot in pilots.items():
        if pilot.needs and importlib.util.find_spec(pilot.needs) is None:
            print(f"{name}: {pilot.needs} is not installed", file=sys.stderr)
            continue
        for row in fly(name, pilot, options.scenarios, options.starts or pilot.starts):
            rows.append(row)
            print(line(row), file=sys.stderr, flush=True)
            if options.update:
                update([row])
    return {"rows": rows}, lines(rows)


def fly(name: str, pilot: Pilot, scenarios: Sequence[str], starts: int) -> Iterator[Row]:
    """Rows of a pilot, which is obtained once for scenarios of one nominal scenario."""

    @functools.cache
    def of(nominal: str) -> tuple[Obtained, float]:
        obtained = pilot.obtain(SCENARIOS[nominal], pilot)
        return obtained, seconds_of_command(pilot.env(SCENARIOS[nominal]), obtained.policy)

    for scenario in scenarios:
        obtained, seconds = of(SCENARIOS[scenario].nominal or scenario)
        row = {"pilot": name, "scenario": scenario, "hz": pilot.hz, "starts": starts}
        row |= score(pilot.env(SCENARIOS[scenario]), obtained.policy, starts)
        row |= {"seconds a command": seconds, "seconds to obtain": obtained.seconds, "flown": obtained.flown}
        yield row | {"settings": obtained.settings, "about": about()}


def score(env: Env, policy: Any, starts: int) -> Row:
    """Success, error and effort from the first of the scored starts."""
    if isinstance(policy, Mpc):
        return score_on_host(env, policy, starts)
    came = evaluate(env, policy, jax.random.key(SCORED), starts)
    steps = came.mean_length / env.dt
    return {
        "distinct": came.distinct_episodes,
        **outcome(came),
        "effort": math.sqrt(came.mean_return / steps),
        "ends": came.end_rates,
    }


def score_on_host(env: Env, policy: Any, starts: int) -> Row:
    """The same by a policy that is called outside of JAX, one flight after the other."""
    flights = [fly_on_host(env, policy, key) for key in jax.random.split(jax.random.key(SCORED), starts)]
    success, error, effort, steps = (np.array(x) for x in zip(*flights, strict=True))
    return {
        "distinct": starts,
        "success": float(success.mean()),
        "interval": wilson_interval(int(success.sum()), starts),
        "error p50": float(np.percentile(error, 50)),
        "error p99": float(np.percentile(error, 99)),
        "effort": math.sqrt(effort.sum() / steps.sum()),
    }


def fly_on_host(env: Env, policy: Any, key: jax.Array) -> tuple[bool, float, float, int]:
    """Success, error in the end, sum of the squared effort, and control steps; the draws are those of `evaluate`."""
    start_key, key = jax.random.split(key)
    obs, world = env.reset(start_key)
    hidden_state, metrics, effort, info = initial_hidden_state(policy, env.drones), [], 0.0, {}
    for step_key in jax.random.split(key, env.steps):
        hidden_state, action = act(policy, hidden_state, obs)
        obs, world, reward, terminated, truncated, info = env.step(step_key, world, action)
        metrics.append(jax.device_get(info["metrics"]))
        effort += float(reward[0])
        if terminated | truncated:
            break
    rows = [*metrics, *[metrics[-1]] * (env.steps - len(metrics))]
    flown = {name: jnp.asarray(np.stack([row[name] for row in rows])) for name in rows[0]}
    success = bool(env.task.succeeded(flown, info["terminations"] | info["truncations"], env.dt)[0])
    return success, float(flown["error"][-1, 0]), effort, len(metrics)


def seconds_of_command(env: Env, policy: Any) -> float:
    """Processor time of a command for one drone, for the first observations of several flights, one after the other."""
    obs = jax.vmap(lambda key: env.reset(key)[0])(jax.random.split(jax.random.key(TUNING), TIMED))
    hidden_state = initial_hidden_state(policy, env.drones)
    if isinstance(policy, Mpc):
        return float(np.median([_seconds(act, policy, hidden_state, one) for one in obs[:20]]))
    program = jax.jit(lambda hidden_state: jax.lax.scan(lambda *x: act(policy, *x), hidden_state, obs)[1])
    calls = 1 + int(SHORTEST / _seconds(program, hidden_state, warm=True))
    return float(np.median([_seconds(program, hidden_state, calls=calls) for _ in range(5)])) / TIMED


def _seconds(function: Callable, *arguments: Any, calls: int = 1, warm: bool = False) -> float:
    """Processor time of a call, which other programs on the core do not change much."""
    if warm:
        jax.block_until_ready(function(*arguments))
    began = time.process_time()
    for _ in range(calls):
        jax.block_until_ready(function(*arguments))
    return max((time.process_time() - began) / calls, 1e-9)


def lines(rows: Sequence[Row]) -> list[str]:
    """Success of every pilot in every scenario, then all of every row."""
    rows = sorted(rows, key=lambda row: (list(SCENARIOS).index(row["scenario"]), list(PILOTS).index(row["pilot"])))
    pilots = sorted({row["pilot"] for row in rows}, key=list(PILOTS).index)
    scenarios = list(dict.fromkeys(row["scenario"] for row in rows))
    success = {(row["pilot"], row["scenario"]): percent(row["success"]) for row in rows}
    table = ["success, %    | " + " | ".join(f"{name:>9}" for name in scenarios)]
    table += [
        f"{pilot:13} | " + " | ".join(f"{success.get((pilot, name), '-'):>9}" for name in scenarios) for pilot in pilots
    ]
    table += [
        "",
        "scenario  | pilot        | starts | success, % [95 % interval] | error cm p50, p99 | effort % | us at Hz"
        "         | obtain s, flown h",
    ]
    return table + [line(row) for row in rows]


def line(row: Row) -> str:
    """One row of the table."""
    interval = (
        "1 flight" if row["interval"] is None else f"{percent(row['interval'][0])}, {percent(row['interval'][1])}"
    )
    command = f"{1e6 * row['seconds a command']:.4g} at {row['hz']}"
    return (
        f"{row['scenario']:9} | {row['pilot']:12} | {row['starts']:6} | {percent(row['success']):>6} "
        f"{'[' + interval + ']':19} | {100 * row['error p50']:8.3g}, {100 * row['error p99']:7.3g} |"
        f" {100 * row['effort']:8.3g} | {command:16} | {row['seconds to obtain']:8.3g}, {row['flown'] / 3600:.3g}"
    )


def percent(share: float) -> str:
    """A share in percent, rounded down."""
    return f"{math.floor(1000 * share + 1e-9) / 10:.1f}"


def update(rows: Sequence[Row]) -> None:
    """Put rows in the place of older ones of the same pilots and scenarios, and write results, page and figure."""
    file = tables.result_file("leaderboard")
    kept = json.loads(file.read_text())["rows"] if file.is_file() else []
    merged = {(row["pilot"], row["scenario"]): row for row in (*kept, *rows)}
    write(list(merged.values()), file, tables.ROOT / "docs/leaderboard.md", FIGURE)


def write(rows: Sequence[Row], file: Path, page: Path, figure: Path) -> None:
    """Write results, the table of the page, and the figure."""
    each = {key: ", ".join(dict.fromkeys(row["about"][key] for row in rows)) for key in ("commit", "cpu")}
    result = {"rows": list(rows), "about": rows[-1]["about"] | each, "lines": lines(rows)}
    file.write_text(json.dumps(result, indent=1) + "\n")
    if page.is_file():
        page.write_text(tables.rewritten(page.read_text(), {"leaderboard": result}))
    draw(rows, figure)


def draw(rows: Sequence[Row], path: Path) -> None:
    """Figure of success against the time of a command, and against that to obtain the pilot, where it took any.

    A dot is the mean of `DRAWN`, the bar below it the worst of them; pilots that did not fly all of them are left out.
    """
    from matplotlib.figure import Figure  # only if a figure is asked for

    from jaxdrones.visualization.palette import colors

    flown = {(row["pilot"], row["scenario"]): row for row in rows}
    pilots = [name for name in PILOTS if all((name, scenario) in flown for scenario in DRAWN) and name != "nothing"]
    figure = Figure(figsize=(10, 4.5), layout="constrained")
    for axes, (key, unit, label) in zip(figure.subplots(1, 2, sharey=True), COSTS, strict=True):
        axes.set(xscale="log", xlabel=label, ylim=(-3, 106))
        dots = []
        for name, color in zip(pilots, colors(len(pilots)), strict=True):
            own = [flown[name, scenario] for scenario in DRAWN]
            success, x = [100 * row["success"] for row in own], own[0][key] / unit
            if x > 0:
                axes.plot([x, x], [min(success), np.mean(success)], color=color, linewidth=1, alpha=0.5)
                axes.plot(x, np.mean(success), "o", color=color)
                axes.plot(x, min(success), "_", color=color)
                dots.append((float(np.mean(success)), x, name))
        if dots:
            _label(axes, dots)
        axes.xaxis.set_minor_formatter("")
        axes.grid(which="major", alpha=0.2)
    figure.axes[0].set_ylabel(f"success (%), mean and worst of\n{', '.join(DRAWN)}")
    figure.savefig(path, dpi=120)


def _label(axes: "Axes", dots: Sequence[tuple[float, float, str]]) -> None:
    """Write the names of dots (success, x, name) in a column at the right, none upon another."""
    right, below = 4 * max(x for _, x, _ in dots), math.inf
    for success, x, name in sorted(dots, reverse=True):
        below = min(success, below - _LINE)
        line = {"arrowstyle": "-", "color": "0.8", "linewidth": 0.7}
        axes.annotate(name, (x, success), (right, below), va="center", arrowprops=line, fontsize=9)
    axes.set_xlim(right=20 * right)

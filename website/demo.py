"""Makes the flights of `jaxdrones demo`, assets/demo: an episode of every bundled policy, and a simulation to fly in.

    python website/demo.py [NAME ...]

It needs the extra casadi.
"""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import jax

import jaxdrones as jd
from jaxdrones import assets
from jaxdrones.export import simulation
from jaxdrones.flights.log import OPTIONAL, STATE, FlightLog
from jaxdrones.training.episode import fly_episode
from jaxdrones.training.run import Run
from jaxdrones.visualization.viewer.gallery import Exhibit
from jaxdrones.visualization.viewer.payload import encode
from jaxdrones.visualization.viewer.show import looks, records_of

FOLDER = Path(__file__).parent.parent / "assets" / "demo"
FLIGHTS: dict[str, dict[str, Any]] = {
    "forest": {},
    "gates": {},
    "recovery": {},
    "swap-goals": {},
    "crowd": {"drones": 32},
    "race": {"drones": 2},
    "follow": {},
    "landing": {},
    "transport": {},
    "sling": {},
    "room": {},
    "wake": {},
    "tracking": {},
    "hover": {},
}
"""Task -> options."""
_OWN = "fly it yourself"
_RATE = 25.0  # rows per second, at most


def main() -> None:
    """Make the named flights, by default all."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[1:] or (_OWN, *FLIGHTS):
        _write(_simulation() if name == _OWN else _exhibit(name, FLIGHTS[name]))


def _write(exhibit: Exhibit) -> None:
    file = FOLDER / f"{exhibit.name.replace(' ', '-')}.json"
    file.write_text(json.dumps(dataclasses.asdict(exhibit), indent=1))
    print(f"wrote {file.name}, {file.stat().st_size / 1e3:.0f} kB: {exhibit.about}")


def _simulation() -> Exhibit:
    """The policy of hover, simulated in the page."""
    with jd.make("hover") as env:
        page = simulation.page(jd.make_policy("hover", env), env, _OWN)
    about = (
        "A drone that is simulated in this page. Push it, make it heavier, weaken a rotor, delay its commands, and "
        "compare the policy with three controllers."
    )
    return Exhibit(_OWN, about, "jaxdrones demo --policy runs/hover", page.payload)


def _exhibit(task: str, options: dict[str, Any]) -> Exhibit:
    """The first successful episode of a few."""
    with jd.make(task, **options) as env:
        policy = jd.make_policy(task, env)
        episodes = (fly_episode(env, policy, jax.random.key(seed)) for seed in range(5))
        episode = next(episode for episode in episodes if episode.success is not False)
        about = f"{env.task.summary[0].upper()}{env.task.summary[1:]}. {_success(task)}"
    (record,) = records_of(episode, dict.fromkeys(("params", "dt", "targets", "labels", "images")))
    record = _thinned(record)
    payload = encode([record], [task], task, layout="alone", play=True, **looks([record]))
    team = "".join(f" --{name} {value}" for name, value in options.items())
    return Exhibit(task, about, f"jaxdrones fly --policy {task}{team} --live", payload)


def _success(task: str) -> str:
    evaluation = Run(assets.policies()[task]).report()["evaluation"]
    if evaluation["success"] is None:
        return ""
    if evaluation["distinct_episodes"] == 1:
        return f"The policy {'succeeds' if evaluation['success'] else 'fails'} from the only start of this task."
    share = f"{100 * evaluation['success']:.1f} % of {evaluation['episodes']:,} episodes"
    return f"The policy succeeds in {share}, each with another start."


def _thinned(record: FlightLog) -> FlightLog:
    """Every few rows of a log, without images."""
    every = max(1, round(1 / (_RATE * (record.t[1] - record.t[0]))))
    rows = {name: getattr(record, name)[::every] for name in ("t", *STATE, *OPTIONAL)}
    return dataclasses.replace(record, images={}, **rows)


if __name__ == "__main__":
    main()

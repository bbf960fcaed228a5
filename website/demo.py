"""Makes the flights of `jaxdrones demo`, in assets/demo.

    python website/demo.py [NAME ...]

They are an episode of every bundled policy, a thousand drones, a recorded flight beside its simulation, and drones
that are simulated in the page. It needs the extra casadi.
"""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxdrones as jd
from jaxdrones import assets
from jaxdrones.control import firmware_pid
from jaxdrones.dynamics.propulsion import crazyflie_motors
from jaxdrones.export import simulation
from jaxdrones.flights import load_flights, load_vehicle, simulate_closed_loop
from jaxdrones.flights.log import OPTIONAL, STATE, FlightLog
from jaxdrones.training.episode import fly_episode
from jaxdrones.training.run import Run
from jaxdrones.visualization.viewer.page import Exhibit
from jaxdrones.visualization.viewer.payload import encode
from jaxdrones.visualization.viewer.show import records_of

sys.path.append(str(Path(__file__).parent.parent / "examples"))
import word

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
_FIRST_SEED = {"swap-goals": 2}
"""Task -> seed of the first episode that is tried; by default 0. In that of `swap-goals` all cross the ring."""
_SHOWN: dict[str, dict[str, bool]] = {"wake": {"jets": True}}
"""Task -> what the page shows from the start."""
_OWN, _TWENTY, _REAL, _WORD = "fly it yourself", "fly twenty", "real flight", "thousand drones"
_RECORDED = "B10_lissajous_slow_rep1"
_WORD_RATE = 1.5  # rows per second


def main() -> None:
    """Make the named flights, by default all."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    made = {_OWN: _simulation, _TWENTY: _twenty, _REAL: _reality, _WORD: _word}
    for name in sys.argv[1:] or (*made, *FLIGHTS):
        _write(made[name]() if name in made else _exhibit(name, FLIGHTS[name]))


def _write(exhibit: Exhibit) -> None:
    file = FOLDER / f"{exhibit.name.replace(' ', '-')}.json"
    file.write_text(json.dumps(dataclasses.asdict(exhibit), indent=1))
    print(f"wrote {file.name}, {file.stat().st_size / 1e3:.0f} kB: {exhibit.about}")


def _simulation() -> Exhibit:
    """The policy of hover, simulated in the page."""
    about = (
        "A drone that is simulated in this page. Push it, make it heavier, weaken a rotor, delay its commands, and "
        "compare the policy with three controllers."
    )
    return _simulated(_OWN, about, 1)


def _twenty() -> Exhibit:
    """The same for twenty drones."""
    about = (
        "Twenty drones that are simulated in this page, without influence on each other. Drag one of them; the kick, "
        "the arrow keys and the conditions are for all."
    )
    return _simulated(_TWENTY, about, 20)


def _simulated(name: str, about: str, drones: int) -> Exhibit:
    with jd.make("hover") as env:
        page = simulation.page(jd.make_policy("hover", env), env, name, drones)
    team = f" --drones {drones}" if drones > 1 else ""
    return Exhibit(name, about, f"jaxdrones demo --policy runs/hover{team}", page.payload)


def _reality() -> Exhibit:
    """A recorded flight, and its simulation from the recorded set-points alone."""
    (log,) = load_flights(assets.folder() / "flights" / f"{_RECORDED}.npz")
    vehicle, motors = load_vehicle("cf21"), crazyflie_motors("2.1+")
    twin = simulate_closed_loop(log, vehicle, motors, firmware_pid.gains(propellers="2.1+"))
    real = _cut(log, slice(*np.searchsorted(log.t, twin.t[[0, -1]] + [0, 1e-9])))
    sim = {name: getattr(twin.sim, name)[:, None] for name in STATE}
    simulated = FlightLog(twin.t, **sim, target_pos=twin.ref_pos[:, None], params=jd.repeat(vehicle.params, 1))
    apart = twin.as_dict()
    about = (
        "A Crazyflie 2.1 in a motion capture system (NanoBench, Ullah and Baca 2026, BSD-3), and the vehicle cf21 "
        "under the PID of its firmware, which knows nothing of the flight but its set-points and battery voltage. The "
        f"paths are {100 * apart['xyz_rms_m']:.1f} cm apart (root mean square); the real one is "
        f"{100 * apart['tracking_real_m']:.0f} cm from its set-points, which its PID trails."
    )
    worlds = [dataclasses.replace(log, t=log.t - log.t[0]) for log in map(_thinned, (real, simulated))]
    signals = ["position x", "distance from target"]
    payload = encode(worlds, ["real", "simulated"], _REAL, layout="ghosts", play=True, signals=signals, error=True)
    return Exhibit(_REAL, about, f"jaxdrones score {_RECORDED} --vehicle cf21", payload)


def _word() -> Exhibit:
    """A thousand drones that write a word."""
    flight = word.fly(jd.make_policy("crowd"), "JAX", 1000)
    safe, reached = (100 * float(np.mean(flight.metrics[name][-1])) for name in ("safe", "reached"))
    (record,) = records_of(flight, dict.fromkeys(("params", "dt", "targets", "labels", "images")))
    record = _rounded(_thinned(record, _WORD_RATE))
    about = (
        "The policy of crowd, which eight drones learned, flies a thousand to the points of a word. In this flight "
        f"{safe:.1f} % touched nobody, and {reached:.1f} % were at their points in the end."
    )
    payload = encode([record], [_WORD], _WORD, layout="alone", play=True)
    return Exhibit(_WORD, about, "python examples/word.py --policy assets/policies/crowd", payload)


def _exhibit(task: str, options: dict[str, Any]) -> Exhibit:
    """The first successful episode of a few."""
    with jd.make(task, **options) as env:
        policy = jd.make_policy(task, env)
        first = _FIRST_SEED.get(task, 0)
        episodes = (fly_episode(env, policy, jax.random.key(seed)) for seed in range(first, first + 5))
        episode = next(episode for episode in episodes if episode.success is not False)
        about = f"{env.task.summary[0].upper()}{env.task.summary[1:]}. {_success(task, env.task.ends)}"
    (record,) = records_of(episode, dict.fromkeys(("params", "dt", "targets", "labels", "images")))
    record = _thinned(record)
    payload = encode([record], [task], task, layout="alone", play=True, **_SHOWN.get(task, {}))
    team = "".join(f" --{name} {value}" for name, value in options.items())
    return Exhibit(task, about, f"jaxdrones fly --policy {task}{team} --live", payload)


def _success(task: str, ends: str) -> str:
    evaluation = Run(assets.policies()[task]).report()["evaluation"]
    if evaluation["success"] is None:
        return ""
    if evaluation["distinct_episodes"] == 1:
        return f"The policy {'succeeds' if evaluation['success'] else 'fails'} from the only start of this task."
    whose = "for {} of the drones in" if ends == "drone" else "in {} of"
    share = whose.format(f"{100 * evaluation['success']:.1f} %")
    return f"The policy succeeds {share} {evaluation['episodes']:,} episodes, each with another start."


def _thinned(record: FlightLog, rate: float = 25.0) -> FlightLog:
    """At most `rate` rows of a log per second, without images."""
    every = max(1, round(1 / (rate * (record.t[1] - record.t[0]))))
    return _cut(record, slice(None, None, every))


def _rounded(record: FlightLog) -> FlightLog:
    """Log with as many digits as can be seen, which takes a third of the bytes."""
    digits = {"pos": 2, "quat": 2, "vel": 1, "omega": 1, "rpm": -2}
    return dataclasses.replace(record, **{name: np.round(getattr(record, name), n) for name, n in digits.items()})


def _cut(record: FlightLog, rows: slice) -> FlightLog:
    return dataclasses.replace(
        record, images={}, **{name: getattr(record, name)[rows] for name in ("t", *STATE, *OPTIONAL)}
    )


if __name__ == "__main__":
    main()

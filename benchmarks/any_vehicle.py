"""Can one policy hover every quadrotor, with which delays and wind speeds?

Policies for all vehicles: `any-vehicle`, trained by `jaxdrones train hover --realistic any`, and RAPTOR as published.
Neither receives parameters of the vehicle. Both fly the default starts of `hover` (up to 1 m, 1 m/s, 1 rad/s and 90
degrees away, scaled by a random vehicle) in the same episodes:
  NAME        a bundled vehicle, lagging rotors, without delay and noise;
  drawn       a random vehicle of 20 g to 3 kg in every episode, drag, sensor noise, a delay of 0 to 40 ms;
  A to B kg   the same for a range of masses;
  A to B kg, T s  the same in T seconds: the time to settle grows with the square root of the arm (Froude scaling), from
              3 s for a Crazyflie to that of the lightest vehicle of the range;
  delay       random vehicles with the same delay in all episodes;
  wind        random vehicles with a delay of 0 to 40 ms in Dryden gusts of 7.7 m/s at 20 ft.
Success: within 5 cm and 0.1 m/s of the goal for the last two of five (or T) seconds; in wind within 25 cm.
"""

import argparse
import dataclasses
import itertools

import jax
import jax.numpy as jnp

import jaxdrones as jd
from benchmarks.common import outcome, success_rate
from benchmarks.leaderboard_scenarios import near
from jaxdrones import assets, vehicles
from jaxdrones.envs import Env
from jaxdrones.envs.randomize import AnyVehicle
from jaxdrones.learning import evaluate
from jaxdrones.learning.policies import POLICIES
from jaxdrones.tasks.hover import SETTLED

SEED = 1_000_000  # of the episodes: the same for all policies, and not that of a training
MASSES = (0.02, 0.035, 0.1, 0.3, 1.0, 2.0, 3.0)  # kg, bounds of the classes
DELAYS = (0, 20, 40)  # ms
WIND = 7.7  # m/s at 20 ft
DURATION = 5.0  # s


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--policies", nargs="+", choices=POLICIES, default=list(POLICIES))
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=SEED, help="of the episodes")


def conditions() -> dict[str, Env]:
    """Environments by name."""
    found = {name: jd.make("hover", action="throttle", vehicle=name, rotors="lagging") for name in assets.vehicles()}
    found["drawn"] = drawn()
    for low, high in itertools.pairwise(MASSES):
        randomize, duration = (AnyVehicle(low, high),), scaled_duration(low)
        found[f"{low:g} to {high:g} kg"] = drawn(True, randomize=randomize)
        found[f"{low:g} to {high:g} kg, {duration:g} s"] = drawn(True, randomize=randomize, duration=duration)
    found |= {f"delay {delay} ms": drawn(delay=delay / 1000) for delay in DELAYS}
    wind = drawn(disturbance=jd.dryden(WIND))
    found[f"wind {WIND} m/s"] = dataclasses.replace(wind, task=dataclasses.replace(wind.task, success=near))
    return found


def scaled_duration(mass: float) -> float:
    """Duration of an episode by Froude scaling of the time to settle, s, for a vehicle of a mass in kg."""
    crazyflie = jd.load_params("cf2x")
    arm = vehicles.median(crazyflie, mass, mass).arm
    return round(SETTLED + (DURATION - SETTLED) * float(jnp.sqrt(arm / crazyflie.arm)), 1)


def drawn(realistic: bool | str = "any", **options) -> Env:
    """Environment with another vehicle in every episode."""
    return jd.make("hover", action="throttle", realistic=realistic, **options)


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    envs = conditions()
    if options.quick:
        options.episodes, envs = 2, {name: envs[name] for name in ("cf2x", "drawn")}
    rows = []
    for (name, env), policy in itertools.product(envs.items(), options.policies):
        report = evaluate(env, jd.make_policy(policy, env), jax.random.key(options.seed), options.episodes)
        rows.append({"condition": name, "policy": policy} | outcome(report))
    lines = ["condition                | policy      | success [95 % interval]  | error cm p50    p99"]
    lines += [
        f"{row['condition']:24} | {row['policy']:11} | {success_rate(row['success'], row['interval']):24} |"
        f" {100 * row['error p50']:12.2f} {100 * row['error p99']:6.2f}"
        for row in rows
    ]
    return {"episodes": options.episodes, "rows": rows}, lines

"""How much do a battery, PWM motors, rotor inertia and aerodynamics slow down a step?

A world is one Crazyflie with drag and lagging rotors; commands change in every step. All cases are run alternately.
"""

import argparse
import functools

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from benchmarks.common import in_turn

PLAIN = "lagging rotors"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--worlds", type=int, default=1024)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--repeats", type=int, default=25)


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    if options.quick:
        options.worlds, options.steps, options.repeats = 8, 5, 1
    programs = {
        (name, how): program(case, how, options)
        for name, case in cases().items()
        for how in ("over_worlds", "jax.vmap")
    }
    rows = []
    times = in_turn(programs, options.repeats, shortest=0)
    for (name, how), taken in times.items():
        plain = times[PLAIN, how]
        ratios = {"ratio": taken["median"] / plain["median"], "ratio of best": taken["best"] / plain["best"]}
        rows.append({"case": name, "how": how, "ns": 1e9 * taken["median"] / options.steps / options.worlds} | ratios)
    lines = []
    lines.append(f"{options.worlds} worlds, {options.steps} steps of 1/240 s, semi-implicit Euler, drag, float32")
    lines.append("case | many worlds | ns of a drone-step, median | over that of lagging rotors: medians, bests")
    lines += [
        f"{row['case']:36} | {row['how']:11} | {row['ns']:6.2f} | {row['ratio']:.2f} {row['ratio of best']:.2f}"
        for row in rows
    ]
    return {"rows": rows}, lines


def cases() -> dict:
    """Parameters, arguments of `make_step` and the mean command, by name; the first is what the others are over."""
    plain = jd.load_params("cf2x")
    inert = plain.replace(rotor_inertia=jnp.array(2e-8))
    constants = {"battery": jd.lithium_polymer(), "motors": jd.crazyflie_motors(), "drag_area": jnp.full(3, 2e-3)}
    lagging, pwm = dict(rotors=jd.lagging_rotors), dict(rotors=jd.pwm_rotors)
    power = dict(models=(jd.battery(),))
    windy = jd.in_wind(jd.logarithmic_wind(5.0), jd.drag)
    return {
        PLAIN: (plain, lagging, 14e3),
        "rotor inertia": (inert, lagging, 14e3),
        "battery": (plain.replace(aux=constants), lagging | power, 14e3),
        "battery, rotor inertia": (inert.replace(aux=constants), lagging | power, 14e3),
        "PWM motors, fixed voltage": (plain.replace(aux=constants), pwm, 45e3),
        "PWM motors, battery, rotor inertia": (inert.replace(aux=constants), pwm | power, 45e3),
        "inflow": (plain, lagging | dict(effects=(jd.drag, jd.inflow_thrust)), 14e3),
        "quadratic drag": (plain.replace(aux=constants), lagging | dict(effects=(jd.drag, jd.quadratic_drag)), 14e3),
        "logarithmic wind": (plain, lagging | dict(effects=(windy,)), 14e3),
    }


def program(case, how: str, options):
    """A flight of a case in many worlds."""
    params, arguments, mean = case
    team = jd.repeat(params, 1)
    step = jd.make_step(**{"effects": (jd.drag,)} | arguments)
    start = step.init(team, jd.State.at_rest([[0.0, 0, 1]]).replace(rpm=jnp.full((1, 4), 14e3)))

    def fly(command):
        # a wave on the command, so that nothing of the motors is the same at every step
        def control(params, memory, state, k):
            return memory, command * (1 + 0.02 * jnp.sin(0.1 * k))

        return jd.rollout(step, control, team, start, None, options.steps)[0]

    spread = np.random.default_rng(0).uniform(0.9, 1.1, (options.worlds, 1, 4))
    many = jd.over_worlds(fly) if how == "over_worlds" else jax.jit(jax.vmap(fly))
    return functools.partial(many, jnp.asarray(mean * spread))

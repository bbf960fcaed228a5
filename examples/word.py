"""A thousand drones form a word in the sky, with a policy trained with eight drones.

    jaxdrones train crowd
    python examples/word.py --word JAX --drones 1000

The policy of `crowd` flies every drone to its point of the word without contact. The script writes a page of the
flight, word.html, and prints its success.
"""

import argparse
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.path import Path as Outline
from matplotlib.textpath import TextPath
from scipy.optimize import linear_sum_assignment

import jaxdrones as jd
from jaxdrones.learning.networks import AnyPolicy
from jaxdrones.tasks import crossing, out_of_control
from jaxdrones.tasks.starts import thrown
from jaxdrones.training.episode import EpisodeLog, fly_episode
from jaxdrones.training.run import Run

SPACING = 0.5  # m between neighboring drones
HEIGHT = 2.0  # m, of the starts; the word begins one meter above
SETTLING = 6.0  # s beyond a straight flight
EVERY = 5  # control steps between two rows of the page


def letters(word: str, count: int) -> np.ndarray:
    """Points (count, 3) that fill a word in the plane x, z, `SPACING` apart, m."""
    polygons = TextPath((0, 0), word, size=1.0).to_polygons()
    (left, bottom), (right, top) = np.min(np.vstack(polygons), axis=0), np.max(np.vstack(polygons), axis=0)

    def inside(step: float) -> np.ndarray:
        x, z = np.meshgrid(np.arange(left, right, step), np.arange(bottom, top, step))
        places = np.stack([x.ravel(), z.ravel()], axis=-1)
        within = sum(Outline(polygon).contains_points(places).astype(int) for polygon in polygons)
        return places[within % 2 == 1]  # an A has a hole

    step = math.sqrt((right - left) * (top - bottom) / count)
    while len(inside(step)) < count:
        step *= 0.99
    places = inside(step)
    kept = places[np.linspace(0, len(places) - 1, count).round().astype(int)] * SPACING / step
    x, z = (kept - kept.min(axis=0)).T
    return np.stack([x - x.mean(), np.zeros(count), z + HEIGHT + 1.0], axis=-1)


def field(count: int) -> np.ndarray:
    """Points (count, 3) of a square grid, `SPACING` apart, m."""
    side = math.ceil(math.sqrt(count))
    x, y = np.divmod(np.arange(count), side)
    return np.stack([SPACING * (x - side / 2), SPACING * (y - side / 2), np.full(count, HEIGHT)], axis=-1)


def word(word: str, drones: int) -> jd.tasks.Task:
    """Task in which drones rise from a field, each to the point of the word for which all ways are shortest."""
    starts, points = field(drones), letters(word, drones)
    squared = np.sum((starts[:, None] - points[None]) ** 2, axis=-1)
    goal = points[linear_sum_assignment(squared)[1]]
    farthest = float(np.max(np.linalg.norm(goal - starts, axis=-1)))

    def start(key: jax.Array, params: jd.Params) -> tuple[jd.State, dict[str, jax.Array]]:
        state = thrown(key, params, jnp.asarray(starts), reach=0.02, speed=0.1, omega=0.1, tilt=0.1)
        return state, crossing.variables(state, jnp.asarray(goal))

    return crossing.task(
        name="word",
        summary="write a word in the sky",
        drones=drones,
        duration=SETTLING + farthest / crossing.SPEED,
        start=start,
        terminations=out_of_control(farthest + 4.0),
        ends="drone",
    )


def fly(policy: AnyPolicy, text: str, drones: int, seed: int = 0) -> EpisodeLog:
    """One flight."""
    return fly_episode(jd.make(word(text, drones)), policy, jax.random.key(seed))


def thinned(flight: EpisodeLog) -> EpisodeLog:
    """Flight with fewer rows, for a smaller page."""
    fewer = {name: jax.tree.map(lambda x: x[::EVERY], getattr(flight, name)) for name in ("t", "drones", "target")}
    return flight.replace(**fewer)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default="runs/crowd", help="run of `jaxdrones train crowd`")
    parser.add_argument("--word", default="JAX")
    parser.add_argument("--drones", type=int, default=1000)
    parser.add_argument("--output", type=Path, default=Path("word.html"))
    options = parser.parse_args()

    flight = fly(Run(options.policy).policy(), options.word, options.drones)
    safe, reached = (float(np.mean(flight.metrics[name][-1])) for name in ("safe", "reached"))
    print(f"{100 * safe:.2f} % touched nobody, {100 * reached:.2f} % are at their points after {flight.t[-1]:.1f} s")
    print(f"wrote {jd.show(thinned(flight)).save(options.output)}")


if __name__ == "__main__":
    main()

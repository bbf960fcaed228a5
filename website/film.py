"""Makes docs/images/flight.webp: five Hummingbirds on a figure-eight through two gates, among trees.

    python website/film.py

It needs Chromium or Chrome, the extra `video`, and the viewer's page, which `make viewer` builds.
"""

import functools
import io
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
from PIL import Image

import jaxdrones as jd
from jaxdrones.control import for_team, geometric
from jaxdrones.sensing import Cylinder, Scene, gate
from jaxdrones.tasks.curves import setpoint_on
from jaxdrones.visualization.browser import open_tab

DRONES, PERIOD, RATE, FPS, SIZE = 5, 6.0, 100, 15, (640, 360)
WOOD = (0.4, 0.28, 0.18, 1.0)


def place(drone, t):
    """Target position, m, on a figure-eight of 4 by 2.4 m, lower in the middle."""
    angle = 2 * jnp.pi * (t / PERIOD - drone / DRONES)
    return jnp.stack([2.0 * jnp.sin(angle), 1.2 * jnp.sin(2 * angle), 1.0 - 0.25 * jnp.cos(2 * angle)])


def fly() -> tuple[jd.Params, jd.State]:
    """Vehicles, and the second of two laps."""
    drones = jnp.arange(DRONES)
    params = jd.repeat(jd.load_params("hb"), DRONES)
    step = jd.make_step(effects=(jd.drag,), pairs=(jd.downwash,), dt=1 / (4 * RATE), substeps=4)
    pilot = functools.partial(geometric.control, geometric.gains(), dt=1 / RATE)

    def targets(t):
        return jax.vmap(lambda drone: setpoint_on(functools.partial(place, drone), t))(drones)

    def control(params, memory, state, k):
        return jax.vmap(pilot)(params, memory, state, targets(k / RATE))

    first = targets(0.0)
    start = jd.State.at_rest(first.pos).replace(vel=first.vel)
    length = round(PERIOD * RATE)
    memory = for_team(geometric.init(), DRONES)
    _, trajectory = jax.jit(lambda start: jd.rollout(step, control, params, start, memory, 2 * length))(start)
    return params, jax.tree.map(lambda x: x[length:], trajectory)


def scene() -> Scene:
    """Two gates on the path, and trees beside it."""
    trees = [(-1.4, 1.9), (0.1, 1.5), (2.2, 1.7), (2.7, 0.0), (0.3, -1.5), (-2.5, 0.1)]
    return Scene.of(
        gate(pos=(1.41, 1.2, 1.0), opening=0.7, frame=0.12),
        gate(pos=(-1.41, -1.2, 1.0), opening=0.7, frame=0.12),
        *(Cylinder(pos=(x, y, 0.9), radius=0.07, height=1.8, color=WOOD) for x, y in trees),
    )


def main() -> None:
    """Fly, film, and write the picture."""
    params, trajectory = fly()
    page = jd.show(trajectory, params, dt=1 / RATE, scene=scene(), title="jaxdrones")
    frames = []
    with open_tab() as tab, tempfile.TemporaryDirectory() as folder:
        tab.open(page.save(Path(folder) / "page.html"), *SIZE)
        tab.run("jaxdrones.film('orbit')")
        tab.press("l")  # no names
        for k in range(round(PERIOD * FPS)):
            tab.run(f"jaxdrones.frameAt({k / FPS}, {1 / FPS})")
            frames.append(Image.open(io.BytesIO(tab.screenshot())).convert("RGB"))
    path = Path(__file__).parent.parent / "docs" / "images" / "flight.webp"
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=1000 / FPS, loop=0, quality=60, method=6)
    print(f"wrote {path}, {path.stat().st_size / 1e6:.2f} MB, {len(frames)} frames")


if __name__ == "__main__":
    main()

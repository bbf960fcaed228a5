"""How many images per second do the cameras render, and what limits them?

Scene A: 10 boxes and 10 spheres within 6 m, the same in every world, no ground, a range of 12 m, 80 degrees, random
camera attitudes. Scene B: a forest of 103 solids (ground, 40 boxes, 30 spheres, 32 cylinders), different in every
world. For both: depth; depth and segmentation; one physics step before each image; and the gradient of the depth with
respect to the pose (forward and backward). For comparison, on scene A: Bullet's TinyRenderer, which renders depth,
segmentation and color together, and crazyflow 0.4.0, which computes the depth of each pixel with an MJX ray, in a
separate environment. Float32; medians of repeats in one run; compile times are separate, with an empty cache.
"""

import argparse
import functools

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from benchmarks.cameras_scenes import forest, objects20, poses
from benchmarks.common import compiled, seconds
from benchmarks.rivals import environment

CAMERAS = (1, 64, 1024, 4096)
RESOLUTIONS = ((64, 48), (64, 64), (16, 12))
PARAMS = jd.repeat(jd.load_params("cf2x"), 1)
STEP = jd.make_step(dt=0.01, substeps=2)
SOLIDS = {"A": 20, "B": 103}


def render(camera: jd.Camera, images: tuple[str, ...], scene: jd.Scene, state: jd.State) -> dict[str, jax.Array]:
    """Some images of one world."""
    rendered = jd.render(scene, PARAMS, state, camera)
    return {name: getattr(rendered, name) for name in images}


def fly_and_render(camera: jd.Camera, scene: jd.Scene, state: jd.State) -> jax.Array:
    """The depth after a control step."""
    state = STEP(PARAMS, state, jnp.broadcast_to(PARAMS.hover_rpm[:, None], (1, 4)))
    return jd.render(scene, PARAMS, state, camera).depth


def depth_gradient(camera: jd.Camera, scenes: jd.Scene, states: jd.State, axes) -> tuple:
    """Gradient of the mean nearness in all images with respect to the poses."""

    def nearness(pos, quat):
        depth = jax.vmap(lambda scene, state: jd.render(scene, PARAMS, state, camera).depth, axes)
        return jnp.mean(1 / depth(scenes, states.replace(pos=pos, quat=quat)))

    return jax.grad(nearness, (0, 1))(states.pos, states.quat)


def rates(scene: str, resolution: tuple[int, int], count: int, repeats: int) -> dict:
    """Images per second of so many cameras in each way, and seconds of compilation."""
    camera = jd.Camera(resolution=resolution, field_of_view=80, far=12.0 if scene == "A" else 24.0)
    states = poses(count)
    scenes = objects20() if scene == "A" else jax.vmap(forest)(jax.random.split(jax.random.key(1), count))
    axes = (None if scene == "A" else 0, 0)
    ways = {
        "depth": jax.vmap(functools.partial(render, camera, ("depth",)), axes),
        "depth and segmentation": jax.vmap(functools.partial(render, camera, ("depth", "segmentation")), axes),
        "all with color": jax.vmap(functools.partial(render, camera, ("rgb", "depth", "segmentation")), axes),
        "physics and depth": jax.vmap(functools.partial(fly_and_render, camera), axes),
        "depth and its gradient": lambda scenes, states: depth_gradient(camera, scenes, states, axes),
    }
    row: dict = {"scene": scene, "resolution": resolution, "cameras": count, "rates": {}, "compile": {}}
    for name, way in ways.items():
        program, row["compile"][name] = compiled(way, scenes, states)
        row["rates"][name] = count / seconds(program, scenes, states, repeats=repeats)["median"]
    row["rays x solids per s"] = row["rates"]["depth"] * np.prod(resolution) * SOLIDS[scene]
    row["forward and backward over forward"] = row["rates"]["depth"] / row["rates"]["depth and its gradient"]
    return row


def bullet_rate(scene: jd.Scene, resolution: tuple[int, int], count: int, repeats: int) -> float | None:
    """Images per second of Bullet's TinyRenderer; `None` without pybullet."""
    try:
        from jaxdrones.engine import bullet

        step = bullet.make_step(scene=scene)
    except ImportError:
        return None
    camera = jd.Camera(resolution=resolution, field_of_view=80, far=12.0)
    states = jax.tree.map(np.asarray, poses(count))
    with step:

        def look() -> None:
            for i in range(count):
                step.camera(PARAMS, jax.tree.map(lambda x, i=i: x[i], states), camera)

        return count / seconds(look, repeats=repeats)["median"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scenes", nargs="+", default=("A", "B"), choices=("A", "B"))
    parser.add_argument("--cameras", type=int, nargs="+", default=CAMERAS)
    parser.add_argument("--repeats", type=int, default=5)


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    resolutions = RESOLUTIONS
    if options.quick:
        options.cameras, options.repeats, resolutions = (2,), 1, ((8, 6),)
    rows = [
        rates(scene, resolution, count, options.repeats)
        for scene in options.scenes
        for resolution in resolutions
        for count in options.cameras
    ]
    others = {
        "TinyRenderer, A, 64 x 48": bullet_rate(objects20(), (64, 48), min(64, *options.cameras), options.repeats)
    }
    if not options.quick:
        others |= environment.run("benchmarks.rivals.cameras")
    lines = []
    for row in rows:
        lines.append(f"scene {row['scene']}, {row['resolution'][0]} x {row['resolution'][1]}, {row['cameras']} cameras")
        lines += [
            f"    {name:25} {rate:12,.0f} images/s, compiled in {row['compile'][name]:.1f} s"
            for name, rate in row["rates"].items()
        ]
        lines.append(f"    forward and backward take {row['forward and backward over forward']:.1f} times forward")
    lines += [f"{name}: {rate:,.0f} images/s" for name, rate in others.items() if rate]
    return {"rows": rows, "others": others}, lines

"""Scenes of the camera benchmark, as numbers for any renderer."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from jaxdrones.sensing import Box, Cylinder, Sphere

SEED = 20
_REACH = 6.0  # m


def numbers() -> dict[str, np.ndarray]:
    """Positions, attitudes (x, y, z, w), edges and radii of 10 boxes and 10 spheres; m."""
    rng, i = np.random.default_rng(SEED), np.arange(10)
    quat = rng.normal(size=(10, 4))
    return {
        "box_pos": rng.uniform(-_REACH, _REACH, (10, 3)),
        "box_quat": quat / np.linalg.norm(quat, axis=1, keepdims=True),
        "box_size": np.stack([0.35 + 0.05 * (i % 3), 0.45 + 0.04 * ((i + 1) % 4), 0.55 + 0.05 * ((i + 2) % 5)], 1),
        "sphere_pos": rng.uniform(-_REACH, _REACH, (10, 3)),
        "sphere_radius": (0.45 + 0.04 * (i % 4)) / 2,
    }


def objects20() -> jd.Scene:
    """Scene A."""
    n = numbers()
    return jd.Scene.of(
        Box(pos=n["box_pos"], quat=n["box_quat"], size=n["box_size"]),
        Sphere(pos=n["sphere_pos"], radius=n["sphere_radius"]),
        ground=False,
    )


def forest(key: jax.Array) -> jd.Scene:
    """Scene B: trunks and branches, boulders and bushes."""
    keys = jax.random.split(key, 5)

    def spread(key: jax.Array, count: int, top: float) -> jax.Array:
        return jax.random.uniform(key, (count, 3), minval=jnp.array([-10, -10, 0.2]), maxval=jnp.array([10, 10, top]))

    lying = jnp.array([0, np.sqrt(0.5), 0, np.sqrt(0.5)])
    upright = jnp.array([0, 0, 0, 1.0])
    return jd.Scene.of(
        Box(pos=spread(keys[0], 40, 1.0), size=jax.random.uniform(keys[1], (40, 3), minval=0.2, maxval=0.8)),
        Sphere(pos=spread(keys[2], 30, 2.5), radius=jax.random.uniform(keys[3], (30,), minval=0.1, maxval=0.4)),
        Cylinder(
            pos=spread(keys[4], 32, 2.0),
            quat=jnp.where(jnp.arange(32)[:, None] % 4 == 0, lying[None], upright[None]),
            radius=0.15,
            height=4.0,
        ),
    )


def poses(count: int) -> jd.State:
    """States of `count` worlds with one drone each, anywhere between the obstacles, turned at random."""
    place, turn = jax.random.split(jax.random.key(SEED))
    quat = jax.random.normal(turn, (count, 1, 4))
    low, high = jnp.array([-_REACH, -_REACH, 0.5]), jnp.array([_REACH, _REACH, 3.0])
    state = jax.vmap(jd.State.at_rest)(jax.random.uniform(place, (count, 1, 3), minval=low, maxval=high))
    return state.replace(quat=quat / jnp.linalg.norm(quat, axis=-1, keepdims=True))

"""The way of a disc past solids."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized

from jaxdrones import rotation
from jaxdrones.sensing import Box, Capsule, Cylinder, Scene, Sphere
from jaxdrones.sensing.sweep import Disc, meets, planes

SOLIDS = {
    "box": Box(pos=(0, 0, 0), size=(0.3, 0.05, 0.2)),
    "sphere": Sphere(pos=(0, 0, 0), radius=0.1),
    "cylinder": Cylinder(pos=(0, 0, 0), radius=0.02, height=0.4),
    "capsule": Capsule(pos=(0, 0, 0), radius=0.03, height=0.3),
}
RING, ROUNDING = 0.05, 0.0125


def random_ways(n, seed=0):
    """Starts and ends of a disc, 0.2 m from each other, that begins outside and comes near the origin."""
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(n, 4))
    axis = jax.vmap(rotation.z_axis)(jnp.asarray(quat / np.linalg.norm(quat, axis=1, keepdims=True)))
    start = rng.normal(size=(n, 3))
    start *= rng.uniform(0.28, 0.4, (n, 1)) / np.linalg.norm(start, axis=1, keepdims=True)
    way = rng.uniform(-0.15, 0.15, (n, 3)) - start
    return jnp.array(start), jnp.array(start + 0.3 * way / np.linalg.norm(way, axis=1, keepdims=True)), axis


def gap_on_the_way(scene, start, end, axis):
    """The smallest gap between a solid and a disc, from many points of the disc on many places of its way, m."""
    angle = jnp.linspace(0, 2 * jnp.pi, 20, endpoint=False)
    across = jnp.linalg.svd(axis[None])[2][1:]
    rim = jnp.cos(angle)[:, None] * across[:1] + jnp.sin(angle)[:, None] * across[1:]
    disc = jnp.concatenate([r * RING * rim for r in jnp.linspace(0.25, 1, 4)])
    places = start[None] + jnp.linspace(0, 1, 40)[:, None] * (end - start)[None]
    points = (places[:, None] + disc[None]).reshape(-1, 3)
    return jnp.min(jax.vmap(scene.distance)(points)) - ROUNDING


@pytest.mark.parametrize(
    "solid", ["box", *(pytest.param(name, marks=pytest.mark.slow) for name in SOLIDS if name != "box")]
)
def test_a_disc_meets_what_is_on_its_way_and_nothing_else(solid):
    scene = Scene.of(SOLIDS[solid], ground=False)
    kinds = scene.shapes(jnp.float64)
    start, end, axis = random_ways(100)

    @jit_unoptimized
    @jax.vmap
    def found(start, end, axis):
        discs = (Disc(center, axis, jnp.asarray(RING), jnp.asarray(ROUNDING)) for center in (start, end))
        return meets(kinds, *discs), gap_on_the_way(scene, start, end, axis)

    hit, gap = found(start, end, axis)
    assert 20 < hit.sum() < 80
    assert hit[gap < -1e-3].all()  # the nearest of some points is farther than the disc by up to 2 mm
    assert not hit[gap > 4e-3].any()


@pytest.mark.slow
def test_a_disc_that_turns_into_a_wall_beside_it_meets_it():
    """Its center rests; at first its flat side faces the wall, in the end its rim is in it, also after small turns."""
    kinds = Scene.of(Box(pos=(1.2, 0, 0), size=(2.0, 9.0, 9.0)), ground=False).shapes(float)  # its face is at x = 0.2 m

    def at(distance, angle):
        axis = jnp.array([jnp.cos(angle), 0.0, jnp.sin(angle)])
        return Disc(jnp.array([0.2 - distance, 0.0, 0.0]), axis, jnp.asarray(RING), jnp.asarray(ROUNDING))

    for angle in 0.2, 0.3, 0.7, np.pi / 2:
        touching = RING * np.sin(angle) + ROUNDING
        for distance in touching - 1e-3, touching + 1e-3:
            start, end = at(distance, 0.0), at(distance, angle)
            assert meets(kinds, start, end) == (distance < touching)
        found = planes(kinds, at(touching - 1e-3, 0.0), at(touching - 1e-3, angle))
        np.testing.assert_allclose(found.normals[0], [-1, 0, 0], atol=1e-6)
        np.testing.assert_allclose(found.heights[0], -0.2, atol=1e-6)


def test_three_walls_of_a_corner_are_three_planes_and_what_is_behind_is_none():
    walls = [Box(pos=0.5 * np.eye(3)[i], size=np.full(3, 2.0) - 1.4 * np.eye(3)[i]) for i in range(3)]
    corner = Scene.of(*walls, walls[0].replace(pos=(0.52, 0, 0)))
    kinds = corner.shapes(jnp.float64)  # faces at x, y, z = 0.2 m, and at x = 0.22 m
    level = jnp.array([0.0, 0.0, 1.0])

    def disc(center):
        return Disc(jnp.array(center), level, jnp.asarray(RING), jnp.asarray(ROUNDING))

    planes_of = jit_unoptimized(lambda start, end: planes(kinds, disc(start), disc(end)))
    found = planes_of([0.0, 0.0, 0.0], [0.4, 0.4, 0.4])
    order = np.argmax(np.abs(found.normals), axis=1)
    assert sorted(order) == [0, 1, 2]
    np.testing.assert_allclose(found.normals, -np.eye(3)[order], atol=1e-6)
    np.testing.assert_allclose(found.heights, -0.2, atol=1e-6)
    assert not planes_of([0.0, 0.0, 0.0], [-0.4, -0.4, -0.4]).normals.any()
    for end in 0.14, 0.4:  # up to the first of the walls that face -x, by the rounding; and through both
        np.testing.assert_allclose(planes_of([0.0, 0.0, 0.0], [end, 0.0, 0.0]).normals, -np.eye(3) * np.eye(3)[0])

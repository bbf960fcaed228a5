"""Depth images of crazyflow 0.4.0, which casts an MJX ray for every pixel; see benchmarks/cameras.py."""

import argparse
import json

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from crazyflow.sim.sensors.depth import _camera_rays, _render_rays
from mujoco import mjx

from benchmarks.cameras_scenes import numbers, poses
from benchmarks.common import compiled, seconds
from jaxdrones import rotation

_GROUPS = (1,) * 6
_TO_MUJOCO = jnp.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])  # right, up, back of its camera in axes of ours


def model() -> mujoco.MjModel:
    """Scene A with one camera."""
    spec, n = mujoco.MjSpec(), numbers()
    spec.add_material(name="grey", rgba=[0.5, 0.5, 0.5, 1])  # rays of MJX ask for one
    for pos, (x, y, z, w), size in zip(n["box_pos"], n["box_quat"], n["box_size"], strict=True):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, pos=pos, quat=[w, x, y, z], size=size / 2, material="grey"
        )
    for pos, radius in zip(n["sphere_pos"], n["sphere_radius"], strict=True):
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=pos, size=[radius, 0, 0], material="grey")
    spec.worldbody.add_camera(fovy=80)
    return spec.compile()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cameras", type=int, nargs="+", default=(1, 64))
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    plain = model()
    placed = mujoco.MjData(plain)
    mujoco.mj_forward(plain, placed)
    moved, data = mjx.put_model(plain), mjx.put_data(plain, placed)
    rates = {}
    for width, height in ((64, 48), (16, 12)):
        rays = _camera_rays((width, height), np.deg2rad(80))[None]
        for count in options.cameras:
            state = poses(count)
            turns = jax.vmap(jax.vmap(rotation.to_matrix))(state.quat) @ _TO_MUJOCO

            def look(pos, turns, rays=rays):
                worlds = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(pos), *jnp.shape(x))), data)
                worlds = worlds.replace(cam_xpos=pos, cam_xmat=turns)
                return _render_rays(mjx_data=worlds, mjx_model=moved, camera=0, geomgroup=_GROUPS, rays=rays)

            program, _ = compiled(look, state.pos, turns)
            name = f"crazyflow 0.4.0, A, {width} x {height}, {count} cameras"
            rates[name] = count / seconds(program, state.pos, turns, repeats=options.repeats)["median"]
    print(json.dumps(rates))


if __name__ == "__main__":
    main()

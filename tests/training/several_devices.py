"""Run by test_sharding.py in processes of their own, whose devices together train the double integrator.

several_devices.py FILE DEVICES [HOSTS HOST COORDINATOR]: what each learner comes to, on one device where DEVICES is 1.
"""

import contextlib
import dataclasses
import re
import sys

import jax
import numpy as np
from double_integrator import SMALL, DoubleIntegrator

from jaxdrones.learning import sharding
from jaxdrones.training import distributed

CONFIG = dict(worlds=16, horizon=5)


def trained(learner, recurrent_size: int) -> tuple[dict, list[str]]:
    """The numbers of a training state, and the operations of an update in which devices talk, those in loops marked."""
    env, config = DoubleIntegrator(), dataclasses.replace(SMALL[learner], **CONFIG, recurrent_size=recurrent_size)
    mesh = sharding.make_mesh(config.worlds)

    def init(key):
        return learner.init(key, env, config)

    placed = sharding.state_sharding(mesh, jax.eval_shape(init, jax.random.key(0)))
    with jax.set_mesh(mesh):
        state = jax.jit(init, out_shardings=placed)(jax.random.key(0))
        update = jax.jit(lambda state: learner.update(env, config, state), in_shardings=(placed,))
        update = update.lower(state).compile()
    for _ in range(3):
        state, _ = update(jax.device_put(state, placed))
    assert state.worlds.obs.sharding.device_set == set(mesh.devices.flat)
    assert state.worlds.obs.addressable_shards[0].data.shape[0] * jax.device_count() == config.worlds
    state = sharding.gather(mesh, state).replace(key=None)
    return {jax.tree_util.keystr(path): x for path, x in jax.tree_util.tree_leaves_with_path(state)}, talks(
        update.as_text()
    )


def talks(program: str) -> list[str]:
    found, loop = [], ""
    for line in program.splitlines():
        if line.endswith("{"):
            loop = "" if line.startswith("ENTRY") else "loop "
        name = re.search(r" (all-\w+|collective-\w+|reduce-scatter)\(", line)
        if name:
            found.append(loop + name[1])
    return found


if __name__ == "__main__":
    file, devices, *others = sys.argv[1:]
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_numpy_rank_promotion", "raise")
    jax.config.update("jax_num_cpu_devices", int(devices))
    with distributed.join_hosts(int(others[0]), int(others[1]), others[2]) if others else contextlib.nullcontext():
        result = {}
        for learner in SMALL:
            for recurrent_size in (0, 3):
                name = f"{learner.__name__.rpartition('.')[2]}, memory of {recurrent_size}"
                numbers, found = trained(learner, recurrent_size)
                result |= {f"{name}{path}": x for path, x in numbers.items()} | {f"{name} talks": found}
        np.savez(file, **result)

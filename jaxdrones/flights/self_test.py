"""Self-test of physics, compiler and device: a short flight with a closed-form solution."""

import contextlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdrones.engine import explicit
from jaxdrones.engine.rollout import rollout
from jaxdrones.params import Params, repeat
from jaxdrones.state import State
from jaxdrones.urdf import load_params

_STEPS, _DT = 240, 1 / 240
_HEIGHT = 1.0  # m, at the start
_FAST, _SLOW = 1.2, 1.15  # over the hover speed: of the two rotors with one direction of rotation, and of the other two
_TOLERANCE = 1e-3  # relative; float32 and 240 steps stay below 1e-4


def self_test(backend: str) -> str | None:
    """Fly a level drone for one second at constant rotor speeds, and compare its final state with the closed form.

    The rotors with one direction of rotation are faster than the others. The drone climbs at a constant acceleration a
    and yaws at a constant angular acceleration: after k steps of dt the semi-implicit Euler method has moved it by
    exactly a dt^2 k (k + 1) / 2. On the explicit backend the gradient of the climb in the mass is compared, too.

    Returns:
        `None` on success, else a message.
    """
    single = load_params("cf2x")
    single = single.replace(rotor_inertia=jnp.zeros_like(single.rotor_inertia))
    rpm = single.hover_rpm * jnp.where(single.rotor_spin > 0, _FAST, _SLOW)
    lift = jnp.sum(single.kf * rpm**2)
    turn = jnp.sum(single.rotor_spin * single.km * rpm**2)
    climbed = _DT**2 * _STEPS * (_STEPS + 1) / 2
    expected = {
        "climb": float(lift / single.mass - single.gravity) * climbed,
        "yaw rate": float(turn / single.inertia[2]) * _STEPS * _DT,
    }
    with contextlib.ExitStack() as stack:
        step: Any
        if backend == "bullet":
            from jaxdrones.engine import bullet  # needs an optional library

            step = stack.enter_context(bullet.make_step(dt=_DT))
        else:
            step = explicit.make_step(dt=_DT)

        def fly(params: Params) -> State:
            start = State.at_rest([[0.0, 0.0, _HEIGHT]]).replace(rpm=rpm[None])
            return rollout(
                step, lambda params, memory, state, k: (memory, rpm[None]), repeat(params, 1), start, None, _STEPS
            )[0]

        final = fly(single) if backend == "bullet" else jax.jit(fly)(single)
        found = {"climb": float(final.pos[0, 2]) - _HEIGHT, "yaw rate": float(final.omega[0, 2])}
        if backend == "explicit":
            slope = jax.jit(jax.grad(lambda mass: fly(single.replace(mass=mass)).pos[0, 2]))(single.mass)
            expected["gradient of the climb in the mass"] = float(-lift / single.mass**2) * climbed
            found["gradient of the climb in the mass"] = float(slope)
    wrong = [
        f"{name} is {found[name]:.6g}, not {value:.6g}"
        for name, value in expected.items()
        if not np.isclose(found[name], value, rtol=_TOLERANCE, atol=0)
    ]
    return "; ".join(wrong) or None

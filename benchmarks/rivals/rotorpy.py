"""rotorpy's batch of vehicles, stepped by torch; it has float64 only, rk4 or dopri5, and one lag for rise and fall."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import torch
from rotorpy.vehicles.crazyflie_params import quad_params
from rotorpy.vehicles.multirotor import BatchedMultirotor, BatchedMultirotorParams

import jaxdrones as jd

torch.set_num_threads(1)  # 140,000 steps/s at 1,024 worlds, not 1,000: on a busy machine two wait for each other

RADIANS_PER_SECOND = 2 * np.pi / 60  # per RPM
_NAMES = {"pos": "x", "vel": "v", "quat": "q", "omega": "w", "rpm": "rotor_speeds"}


def plant(
    params: jd.Params, start: jd.State, rpm: jax.Array, dt: float, steps: int
) -> dict[str, Callable[[], jd.State]]:
    """`steps` steps of rk4 with the rotor speeds held; without drag, which rotorpy has at each rotor."""
    worlds, cpu = len(start.pos), torch.device("cpu")
    told = BatchedMultirotorParams([_told(jax.tree.map(lambda x: np.asarray(x[0]), params))] * worlds, worlds, cpu)
    first = {name: torch.from_numpy(np.array(getattr(start, field))[:, 0]) for field, name in _NAMES.items()}
    first |= {"rotor_speeds": first["rotor_speeds"] * RADIANS_PER_SECOND, "wind": torch.zeros(worlds, 3).double()}
    vehicles = BatchedMultirotor(told, worlds, first, cpu, aero=False, integrator="rk4")
    command = {"cmd_motor_speeds": torch.from_numpy(np.array(rpm)[:, 0]) * RADIANS_PER_SECOND}
    everyone = np.arange(worlds)

    def fly() -> jd.State:
        state = first
        with torch.no_grad():
            for _ in range(steps):
                state = vehicles.step(state, command, dt, everyone)
        fields = {field: jnp.asarray(state[name].numpy())[:, None] for field, name in _NAMES.items()}
        return jd.State(**fields | {"rpm": fields["rpm"] / RADIANS_PER_SECOND})

    return {"rotorpy": fly}


def _told(params: jd.Params) -> dict[str, object]:
    """The parameters of our vehicle in its words."""
    inertia = dict(zip(("Ixx", "Iyy", "Izz"), params.inertia.tolist(), strict=True))
    return (
        quad_params
        | inertia
        | {
            "mass": float(params.mass),
            "rotor_pos": {f"r{i + 1}": pos for i, pos in enumerate(params.rotor_pos)},
            "rotor_directions": params.rotor_spin,
            "k_eta": float(params.kf) / RADIANS_PER_SECOND**2,
            "k_m": float(params.km) / RADIANS_PER_SECOND**2,
            "tau_m": float(params.rotor_rise_time),
        }
    )

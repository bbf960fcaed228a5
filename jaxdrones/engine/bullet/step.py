"""The pure step: place the bodies, apply the wrenches, let Bullet step, read back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax.typing import ArrayLike

from jaxdrones import rotation
from jaxdrones.checks import check_finite, check_number, check_params, check_positive, check_quaternion, check_whole
from jaxdrones.dynamics import instant_rotors
from jaxdrones.dynamics.rotors import limited
from jaxdrones.engine.bullet.camera import Camera, look, of_drones
from jaxdrones.engine.bullet.client import BALLS, TINY, Client
from jaxdrones.engine.bullet.contacts import Contact, of_last_step
from jaxdrones.engine.host import HostStep, is_traced
from jaxdrones.engine.team import check_team, flatten, unflatten
from jaxdrones.engine.wrenches import Effect, Pair, check_functions, make_total_wrench
from jaxdrones.params import Params
from jaxdrones.sensing import Scene
from jaxdrones.state import State

# The host sees a team as one array, a row per drone: pose and velocities in the world frame, rotor speeds, commands.
_BODY, _COMMAND = slice(0, 13), slice(17, 21)
_QUAT, _OMEGA, _RPM = slice(3, 7), slice(10, 13), slice(13, 17)
_COLUMNS = dict(pos=slice(0, 3), quat=_QUAT, vel=slice(7, 10), omega=_OMEGA, rpm=_RPM)

_PAPER_CAMERA = Camera()
_FILM_CAMERA = Camera(width=640, height=480)
_FILM_NEAR = 0.1  # m


def make_step(
    effects: Sequence[Effect] = (),
    pairs: Sequence[Pair] = (),
    rotors: Callable = instant_rotors,
    dt: float = 1 / 240,
    substeps: int = 1,
    scene: Scene | None = None,
    damping: float = 0.0,
    collision: str = BALLS,
    renderer: str = TINY,
    gui: bool = False,
) -> BulletStep:
    """Build the step of a world in which Bullet integrates and resolves contacts.

    Args:
        effects: as for the explicit backend.
        pairs: as for the explicit backend.
        rotors: `instant_rotors` or `lagging_rotors`.
        dt: physics step, s.
        substeps: physics steps per call, with the command held.
        scene: ground and obstacles; a bare ground plane when left out.
        damping: Bullet's linear and angular damping, 1/s; the reference's is 0.04.
        collision: `balls`, a ring of balls on a disc, which rests and rebounds stably, or `cylinder`, the reference's.
        renderer: of the cameras: `tiny`, on the CPU, or `egl`, on a GPU.
        gui: open a window, in which the cameras render too.

    Returns:
        `step(params, state, rpm) -> state`, a context manager that closes the connection. The rotors limit the
        commanded speeds to [0, `params.max_rpm`].

    Raises:
        ValueError: an argument out of range.
        ImportError: pybullet is not installed.
        OSError: a window is asked for and there is no display.
    """
    check_positive("dt", dt, "s")
    check_whole("substeps", substeps)
    check_number("damping", damping, "1/s", at_least=0)
    check_functions("rotors", [rotors])
    total_wrench = make_total_wrench(effects, pairs)

    @jax.jit
    def loads(flat_params: jax.Array, team: jax.Array) -> jax.Array:
        """Force and torque (world) and the next rotor speeds of every drone: (n, 10)."""
        params = unflatten(flat_params)
        state = State(**{name: team[:, columns] for name, columns in _COLUMNS.items()})
        speed, speed_rate = jax.vmap(rotors)(params, jax.vmap(limited)(params, state.rpm), team[:, _COMMAND])
        omega = jax.vmap(rotation.rotate_inverse)(state.quat, state.omega)
        wrench = total_wrench(params, state.replace(omega=omega, rpm=speed))
        force = jax.vmap(rotation.rotate)(state.quat, wrench.force).at[:, 2].add(-params.weight)
        torque = jax.vmap(rotation.rotate)(state.quat, wrench.torque)
        return jnp.concatenate([force, torque, speed + dt * speed_rate], axis=-1)

    client = Client(Scene() if scene is None else scene, dt, damping, collision, renderer, gui)
    return BulletStep(client, loads, substeps, dt)


class BulletStep(HostStep):
    """`step(params, state, rpm) -> state`. The same input gives the same output whatever was called between."""

    def __init__(self, client: Client, loads: Callable[[jax.Array, ArrayLike], jax.Array], substeps: int, dt: float):
        self.client, self._loads, self._substeps, self._dt = client, loads, substeps, dt
        # What the last call with values was checked for and what was made of it, kept as long as it stays the same:
        self._params: Params | None = None
        self._shapes: list[tuple[int, ...]] = []
        self._flat_params: jax.Array  # one array is handed over faster than twenty
        self._arms: np.ndarray

    def __repr__(self) -> str:
        return f"<step: Bullet at {1 / (self._dt * self._substeps):.4g} Hz x {self._substeps}>"

    def __enter__(self) -> BulletStep:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def close(self) -> None:
        """End the connection to Bullet."""
        self.client.close()

    def __call__(self, params: Params, state: State, rpm: ArrayLike) -> State:
        """Advance a team by one control step; arrays as for the explicit backend.

        Given values it returns NumPy arrays; under `jit` and `vmap` it goes through a callback.

        Raises:
            ValueError: a wrong shape, a closed client, or a number that is not finite (where it can be looked at).
            TypeError: a gradient is asked for.
        """
        if is_traced((state, rpm)) or (params is not self._params and is_traced(params)):
            self.client.check_open()
            check_team(params, state, rpm)
            return _refuse_gradients(self._traced)(params, state, rpm)
        team = self._pack(params, state, rpm)
        for _ in range(self._substeps):
            loads = self._loads_on(team)
            team[:, _BODY] = self.client.advance(team, loads)
            team[:, _RPM] = loads[:, 6:]
        return self._unpack(team)

    def contacts(self, params: Params, state: State) -> list[Contact]:
        """Who touches whom in the physics step that follows `state` with the rotors held at `state.rpm`.

        Raises:
            ValueError: a wrong shape, a closed client, or a state that is not finite.
        """
        team = self._pack(params, state, state.rpm)
        self.client.advance(team, self._loads_on(team))
        return of_last_step(self.client, self._dt)

    def camera(
        self, params: Params, state: State, camera: Camera = _PAPER_CAMERA, raw_depth: bool = False
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What every drone sees along its body x.

        Returns:
            RGBA (n, height, width, 4) uint8; depth along the viewing axis (n, height, width) float32, m, or Bullet's
            buffer in 0..1 if `raw_depth`; segmentation (n, height, width) int32: -1 nothing, 0 ground, 1 + i drone i,
            1 + n + i obstacle i. A drone does not see itself.

        Raises:
            ValueError: a wrong shape, a closed client, a state that is not finite, or an eye inside a body.
        """
        if is_traced((params, state)):
            self.client.check_open()
            check_team(params, state, state.rpm)
            return self._traced_camera(params, state, camera, raw_depth)
        team = self._place(params, state)
        return of_drones(self.client, team, self._arms, camera, raw_depth)

    def photo(
        self, params: Params, state: State, eye: npt.ArrayLike, target: npt.ArrayLike, camera: Camera = _FILM_CAMERA
    ) -> np.ndarray:
        """A picture of the team from `eye` towards `target` (3,) (m, world): RGB (height, width, 3) uint8."""
        self._place(params, state)
        return look(self.client, eye, target, camera, _FILM_NEAR)[0][..., :3]

    def _place(self, params: Params, state: State) -> np.ndarray:
        team = self._pack(params, state, state.rpm)
        self.client.place(team)
        return team

    def _loads_on(self, team: np.ndarray) -> np.ndarray:
        return np.asarray(self._loads(self._flat_params, team.astype(self._flat_params.dtype)))

    def _pack(self, params: Params, state: State, rpm: ArrayLike) -> np.ndarray:
        """Check a call with values and make one array of it; the bodies are those of the team from here on."""
        self.client.check_open()
        shapes = [np.shape(x) for x in (state.pos, state.quat, state.vel, state.omega, state.rpm, rpm)]
        if params is not self._params or shapes != self._shapes:
            check_team(params, state, rpm)
            check_params(params)
            self._flat_params = flatten(params)
            self.client.set_team(np.asarray(_bodies(params), float))
            self._arms = np.asarray(params.arm, float)
            self._params, self._shapes = params, shapes
        team = np.empty((len(state.pos), _COMMAND.stop))
        for name, columns in _COLUMNS.items():
            team[:, columns] = getattr(state, name)
        team[:, _COMMAND] = rpm
        if not np.isfinite(team).all():
            check_finite("state", state)
            check_finite("rpm", rpm)
        check_quaternion("state.quat", team[:, _QUAT])
        team[:, _OMEGA] = (self.client.matrices(team[:, _QUAT]) @ team[:, _OMEGA, None])[..., 0]
        return team

    def _unpack(self, team: np.ndarray) -> State:
        team[:, _OMEGA] = (team[:, None, _OMEGA] @ self.client.matrices(team[:, _QUAT]))[:, 0]
        team = team.astype(self._flat_params.dtype)
        arrays: dict[str, Any] = {name: team[:, columns] for name, columns in _COLUMNS.items()}  # of NumPy
        return State(**arrays)

    def _traced(self, params: Params, state: State, rpm: jax.Array) -> State:
        """The same in a compiled program, which computes the wrenches itself and calls back for every physics step."""
        bodies, flat_params = _bodies(params), flatten(params)
        team = _one_array(state, rpm)

        def advance(bodies, team, loads):
            self._become(bodies)
            return self.client.advance(np.asarray(team, float), np.asarray(loads, float)).astype(team.dtype)

        def substep(team, _):
            loads = self._loads(flat_params, team)
            after = jax.ShapeDtypeStruct((len(team), _BODY.stop), team.dtype)
            body = jax.pure_callback(advance, after, bodies, team, loads, vmap_method="sequential")
            return jnp.concatenate([body, loads[:, 6:], team[:, _COMMAND]], axis=-1), None

        team, _ = jax.lax.scan(substep, team, length=self._substeps)
        state = State(**{name: team[:, columns] for name, columns in _COLUMNS.items()})
        return state.replace(omega=jax.vmap(rotation.rotate_inverse)(state.quat, state.omega))

    def _traced_camera(self, params: Params, state: State, camera: Camera, raw_depth: bool) -> Any:
        """The same in a compiled program; the callback itself computes nothing with JAX, which would be slow."""
        n, size = len(state.pos), (camera.height, camera.width)
        kinds = (((*size, 4), np.uint8), (size, np.float32), (size, np.int32))
        pictures = tuple(jax.ShapeDtypeStruct((n, *shape), dtype) for shape, dtype in kinds)

        def take(bodies, arms, team):
            self._become(bodies)
            team = np.asarray(team, float)
            check_finite("state", team)
            self.client.place(team)
            return of_drones(self.client, team, np.asarray(arms, float), camera, raw_depth)

        team = _one_array(state, state.rpm)
        return jax.pure_callback(take, pictures, _bodies(params), params.arm, team, vmap_method="sequential")

    def _become(self, bodies: jax.Array) -> None:
        """The bodies of the team that a compiled program calls back with; no longer those of a call with values."""
        self.client.check_open()
        self._params = None
        self.client.set_team(np.asarray(bodies, float))


def _one_array(state: State, rpm: jax.Array) -> jax.Array:
    """What the host sees of a team."""
    omega = jax.vmap(rotation.rotate)(state.quat, state.omega)
    return jnp.concatenate([state.pos, state.quat, state.vel, omega, state.rpm, rpm], axis=-1)


def _bodies(params: Params) -> jax.Array:
    """What Bullet must know of every drone, (n, 20): see `Client.set_team`."""
    shape = [params.collision_radius, params.collision_height, params.collision_offset, params.prop_radius]
    rotor_pos = jnp.reshape(params.rotor_pos, (-1, 12))
    return jnp.concatenate([jnp.stack(shape, axis=-1), rotor_pos, params.mass[:, None], params.inertia], axis=-1)


def _refuse_gradients(function: Callable) -> Callable:
    """The same function, with an error that says what to do where a gradient is asked for."""
    function = jax.custom_jvp(function)

    @function.defjvp
    def jvp(primals, tangents):
        raise TypeError(
            "the Bullet backend has no gradient; for that build the step with the explicit backend, jaxdrones.make_step"
        )

    return function

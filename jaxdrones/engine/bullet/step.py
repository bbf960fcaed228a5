"""Pure step of the Bullet backend: place the bodies, apply the wrenches, step Bullet, read back."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax.typing import ArrayLike

from jaxdrones.accelerate.small import jit_small
from jaxdrones.arguments import checked
from jaxdrones.checks import check_finite, check_params
from jaxdrones.engine.bullet import arrays
from jaxdrones.engine.bullet.camera import drone_pictures, photo, views
from jaxdrones.engine.bullet.client import Client
from jaxdrones.engine.bullet.contacts import Contact, contacts_of_last_step
from jaxdrones.engine.physics import Physics
from jaxdrones.engine.step import HostStep, is_traced
from jaxdrones.engine.team import Layout, check_state, check_team, columns, pack
from jaxdrones.params import Params
from jaxdrones.sensing import Camera, Images, Scene
from jaxdrones.sensing.camera import OneCamera
from jaxdrones.sensing.scene import check_scene
from jaxdrones.state import State

_DEFAULT_CAMERA = Camera()
_FILM_CAMERA = Camera(resolution=(640, 480), near=0.1)


class BulletStep(HostStep):
    """`step(params, state, rpm) -> state`; the output depends on the arguments alone."""

    integrator = "Bullet"

    def __init__(self, client: Client, physics: Physics, substeps: int, dt: float, scene: Scene):
        self.client, self.physics, self.substeps, self.dt, self.scene = client, physics, substeps, dt, scene
        self.period = dt * substeps
        client.set_scene(scene)
        self._loads = arrays.make_loads(physics, dt)
        self._compiled_loads = jit_small(self._loads, static=2)
        self._at_speed = jax.jit(arrays.make_start(physics))
        # Cache of the last concrete call, valid for identical arguments:
        self._params: Params | None = None
        self._shapes: list[tuple[int, ...]] = []
        self._layout: Layout
        self._flat_params: jax.Array  # one array is handed over faster than twenty

    def __repr__(self) -> str:
        return f"<step: Bullet at {1 / (self.dt * self.substeps):.4g} Hz x {self.substeps}>"

    def __enter__(self) -> BulletStep:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def close(self) -> None:
        """End the connection to Bullet."""
        self.client.close()

    def __call__(self, params: Params, state: State, rpm: ArrayLike, scene: Scene | None = None) -> State:
        """Advance a team by one control step; arrays as for the explicit backend.

        With concrete arguments it returns NumPy arrays; under `jit` and `vmap` it goes through a callback.

        Raises:
            ValueError: a wrong shape, a closed client, or concrete numbers that are not finite.
            TypeError: under `jax.grad`.
        """
        return self._flown(params, state, rpm, scene, self.substeps)

    def rate(self, params: Params, state: State, rpm: ArrayLike, scene: Scene | None = None) -> State:
        """Mean time derivative over the next physics step, contacts included.

        Rotors without a lag have their commanded speed at the start of the step, so their rate is zero.
        """
        after = self._flown(params, state, rpm, scene, substeps=1)
        state = self._at_speed(params, state, jnp.asarray(rpm))
        same_sign = jnp.sign(jnp.sum(after.quat * state.quat, axis=-1, keepdims=True))
        after = after.replace(quat=same_sign * after.quat)
        return jax.tree.map(lambda b, a: (b - a) / self.dt, after, state)

    def _flown(self, params: Params, state: State, rpm: ArrayLike, scene: Scene | None, substeps: int) -> State:
        if self._is_traced(params, state, rpm, scene):
            flown = _refuse_gradients(functools.partial(self._traced, substeps))
            return flown(params, state, rpm, self._given(scene))
        acting = self._set_scene(self._given(scene))
        team, aux = self._pack(params, state, rpm), Layout.of(state.aux)
        for k in range(substeps):
            loads = self._loads_on(team, aux, acting)
            if k == 0 and loads[:, arrays.SUSPECT].any():
                check_state("state", state)
                check_finite("rpm", rpm)
            team = _following(np, self.client.advance(team, loads), team, loads)
        return _unpack(team.astype(self._flat_params.dtype), aux)

    def contacts(self, params: Params, state: State, scene: Scene | None = None) -> list[Contact]:
        """Contacts in the next physics step, with the rotors held at `state.rpm`."""
        acting = self._set_scene(self._given(scene))
        team = self._place(params, state)
        self.client.advance(team, self._loads_on(team, Layout.of(state.aux), acting))
        return contacts_of_last_step(self.client, self.dt)

    @checked
    def camera(
        self, params: Params, state: State, camera: OneCamera = _DEFAULT_CAMERA, scene: Scene | None = None
    ) -> Images:
        """Images of the camera of every drone, in the format of `jaxdrones.render`, rendered by Bullet.

        A camera inside an obstacle or underground sees it in black at `near`.
        """
        scene = self._given(scene)
        if self._is_traced(params, state, state.rpm, scene):
            return self._traced_camera(params, state, camera, scene)
        self._set_scene(scene)
        team = self._place(params, state)
        looks = np.asarray(views(params, state, scene, camera), float)
        rgb, depth, segmentation = drone_pictures(self.client, team, looks, camera)
        return Images(*map(jnp.asarray, (rgb, depth.astype(self._flat_params.dtype), segmentation)))

    def photo(
        self,
        params: Params,
        state: State,
        eye: npt.ArrayLike,
        target: npt.ArrayLike,
        camera: Camera = _FILM_CAMERA,
        scene: Scene | None = None,
    ) -> np.ndarray:
        """Upright picture of the team from `eye` towards `target` (3,), m, world: RGB (height, width, 3) uint8.

        Only the lens of the camera is used, not its mounting.
        """
        self._set_scene(self._given(scene))
        self._place(params, state)
        return photo(self.client, eye, target, camera)

    def _is_traced(self, params: Params, state: State, rpm: ArrayLike, scene: Scene | None) -> bool:
        """Whether a call is traced. Its shapes are then validated here, those of a concrete call in `_pack`."""
        traced = is_traced((state, rpm, scene)) or (params is not self._params and is_traced(params))
        if traced:
            check_team(params, state, rpm)
        return traced

    def _given(self, scene: Scene | None) -> Scene:
        self.client.check_open()
        if scene is None:
            return self.scene
        check_scene("scene", scene, files=True)
        return scene

    def _set_scene(self, scene: Scene) -> Scene:
        """Place the bodies of a concrete scene; return the part of it that wrenches depend on."""
        self.client.set_scene(scene if scene is self.scene else jax.device_get(scene))
        return self.physics.seen(scene)

    def _place(self, params: Params, state: State) -> np.ndarray:
        team = self._pack(params, state, state.rpm)
        check_state("state", state)
        self.client.place(team)
        return team

    def _loads_on(self, team: np.ndarray, aux: Layout, scene: Scene) -> np.ndarray:
        team = team.astype(self._flat_params.dtype)
        return np.asarray(self._compiled_loads(self._layout, aux, self._flat_params, team, scene))

    def _pack(self, params: Params, state: State, rpm: ArrayLike) -> np.ndarray:
        """Validate the shapes of concrete arguments, set the team's bodies, and pack the call into one array."""
        n = len(state.pos)
        shapes = [np.shape(x) for x in (*jax.tree.leaves(state), rpm)]
        if params is not self._params or shapes != self._shapes:
            check_team(params, state, rpm)
            check_params(params)
            self.physics.check_lag(params, self.dt)
            self.physics.check_acts(params, state, self.scene)
            self._layout, self._flat_params = Layout.of(params), pack(params, n)
            self.client.set_team(np.asarray(arrays.bodies_of(params), float))
            self._params, self._shapes = params, shapes
        fields = [state.pos, state.quat, state.vel, state.omega, state.rpm, rpm]
        return np.concatenate([*fields, *columns(state.aux, n)], axis=1, dtype=float)

    def _traced(self, substeps: int, params: Params, state: State, rpm: jax.Array, scene: Scene) -> State:
        """Step in a compiled program, which computes the wrenches and calls back for every physics step."""
        bodies, flat_params = arrays.bodies_of(params), pack(params, len(state.pos))
        layout, aux = Layout.of(params), Layout.of(state.aux)
        team, acting, handed = arrays.one_array(state, rpm), self.physics.seen(scene), self._handed(scene)

        def advance(bodies, scene, team, loads):
            self._sync_world(bodies, scene)
            return self.client.advance(np.asarray(team, float), np.asarray(loads, float)).astype(team.dtype)

        def substep(team, _):
            loads = self._loads(layout, aux, flat_params, team, acting)
            after = jax.ShapeDtypeStruct((len(team), arrays.BODY.stop), team.dtype)
            body = jax.pure_callback(advance, after, bodies, handed, team, loads, vmap_method="sequential")
            return _following(jnp, body, team, loads), None

        team, _ = jax.lax.scan(substep, team, length=substeps)
        return _unpack(team, aux)

    def _traced_camera(self, params: Params, state: State, camera: Camera, scene: Scene) -> Images:
        """Camera images in a compiled program; the callback itself avoids JAX, which would be slow."""
        n, size = len(state.pos), camera.resolution[::-1]
        kinds = (((*size, 4), np.uint8), (size, state.pos.dtype), (size, np.int32))
        pictures = tuple(jax.ShapeDtypeStruct((n, *shape), dtype) for shape, dtype in kinds)

        def take(bodies, scene, team, looks):
            self._sync_world(bodies, scene)
            team = np.asarray(team, float)
            check_finite("state", team)
            self.client.place(team)
            rgb, depth, segmentation = drone_pictures(self.client, team, np.asarray(looks, float), camera)
            return rgb, depth.astype(pictures[1].dtype), segmentation

        given = arrays.bodies_of(params), self._handed(scene), arrays.one_array(state, state.rpm)
        looks = views(params, state, scene, camera)
        return Images(*jax.pure_callback(take, pictures, *given, looks, vmap_method="sequential"))

    def _handed(self, scene: Scene) -> Scene | None:
        """Scene as an argument of the callback; `None` for that of `make_step`."""
        return None if scene is self.scene else scene

    def _sync_world(self, bodies: jax.Array, scene: Scene | None) -> None:
        """Set bodies and scene of a callback, and invalidate the cached team of concrete calls."""
        self.client.check_open()
        self._params = None
        self.client.set_scene(self.scene if scene is None else jax.tree.map(np.asarray, scene))
        self.client.set_team(np.asarray(bodies, float))


def _following(xnp: Any, body: Any, team: Any, loads: Any) -> Any:
    """Array of a team after a physics step that left `body`; of NumPy or JAX, as `xnp` is."""
    command = team[:, arrays.COMMAND]
    return xnp.concatenate([body, loads[:, arrays.NEXT_RPM], command, loads[:, arrays.NEXT_AUX]], axis=-1)


def _unpack(team: Any, aux: Layout) -> State:
    fields = {name: team[:, place] for name, place in arrays.COLUMNS.items()}
    return State(**fields, aux=aux.unpack(team, arrays.AUX.start))


def _refuse_gradients(function: Callable) -> Callable:
    """Wrap a function to raise a helpful error under differentiation."""
    function = jax.custom_jvp(function)

    @function.defjvp
    def jvp(primals, tangents):
        raise TypeError(
            "the Bullet backend has no gradient; for that build the step with the explicit backend, jaxdrones.make_step"
        )

    return function

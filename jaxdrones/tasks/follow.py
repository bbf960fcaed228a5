"""Task: follow another drone and keep it in view."""

import functools
import math
from collections.abc import Mapping
from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdrones import rotation
from jaxdrones.arguments import Seconds, checked, number
from jaxdrones.control import Setpoint
from jaxdrones.params import Params
from jaxdrones.quantity import quantities
from jaxdrones.sensing import Camera
from jaxdrones.state import State
from jaxdrones.tasks import shaping
from jaxdrones.tasks.curves import RANDOM_NUMBERS, lissajous, setpoint_on
from jaxdrones.tasks.pairs import nearest_on_the_way
from jaxdrones.tasks.starts import check_apart, thrown
from jaxdrones.tasks.task import ObservationTerm, Task, Team, World, norm
from jaxdrones.vector import unit

HEIGHT = 4.0  # m of the center of the leader's curve
_MAX_DISTANCE = 10.0  # m
_MIN_PERIOD = 2.0  # s
_MAX_SPEED = 30.0  # m/s, bound of an observation
_REACH = 0.1  # m, or a tenth of a shorter distance, of starts about their places along each axis
_SETTLED = 2.0  # s: time after which the leader has to be in view
_IN_VIEW = 0.95  # share of the time
_TOLERANCE = 0.3  # share of the distance

camera = Camera(resolution=(32, 24), field_of_view=60.0)
"""Camera of the task, fixed to the body; drones outside its field of view are lost from sight."""


_TOUCHED = shaping.variable("touched", "One if the drone has touched another one or the ground.")


@checked
def follow(
    drones: Team = 2,
    distance: Annotated[float, number("m", at_least=0.3, at_most=_MAX_DISTANCE)] = 1.5,
    size: Annotated[float, number("m", above=0, at_most=HEIGHT)] = 1.5,
    period: Annotated[float, number("s", at_least=_MIN_PERIOD)] = 12.0,
    duration: Seconds = 12.0,
) -> Task:
    """Drone 0 flies along a random curve; every other drone follows the one before it and keeps it in view.

    A drone is in view when the direction to it is within the field of view of the camera, which points along body x.

    Args:
        drones: number of drones, at least two.
        distance: distance to keep from the followed drone, m.
        size: amplitude of the leader's curve, a Lissajous figure, m.
        period: period of that curve, s.
        duration: duration of an episode, s; of 2 s or less there is no criterion of success.
    """

    def leader(variables: dict[str, Array], t: Array) -> Setpoint:
        """Position of the first drone."""
        center = jnp.array([0, 0, HEIGHT], variables["random"].dtype)
        return setpoint_on(lambda t: center + size * lissajous(variables["random"], variables["phase"] + t / period), t)

    def target(variables: dict[str, Array], t: Array) -> Setpoint:
        """For the leader, its point on the curve; for the others, the point at the distance from the drone before."""
        first = leader(variables, t)
        pos, vel = variables["pos"], variables["vel"]
        return Setpoint.at(
            jnp.concatenate([first.pos[None], pos[:-1] + distance * _level(pos[1:] - pos[:-1])]),
            vel=jnp.concatenate([first.vel[None], vel[:-1]]),
            acc=jnp.zeros_like(vel).at[0].set(first.acc),
        )

    def start(key: jax.Array, params: Params) -> tuple[State, dict[str, Array]]:
        """The leader on its curve, the others in a line behind it, facing it."""
        reach = min(_REACH, distance / 10)
        check_apart(params, distance - 2 * math.sqrt(2) * reach, "a smaller vehicle or a larger distance")
        curve_key, phase_key, bearing_key, start_key = jax.random.split(key, 4)
        dtype = params.mass.dtype
        variables = {
            "random": jax.random.uniform(curve_key, (RANDOM_NUMBERS,), dtype, -1, 1),
            "phase": jax.random.uniform(phase_key, (), dtype),
        }
        first = leader(variables, jnp.zeros((), dtype))
        bearing = jax.random.uniform(bearing_key, (), dtype, -math.pi, math.pi)
        behind = jnp.stack([-jnp.cos(bearing), -jnp.sin(bearing), 0 * bearing])
        pos = first.pos[None] + distance * jnp.arange(drones, dtype=dtype)[:, None] * behind[None]
        state = thrown(start_key, params, pos, reach=reach, speed=0.1, omega=0.1, tilt=0.1)
        facing = jnp.stack([0 * bearing, 0 * bearing, jnp.sin(bearing / 2), jnp.cos(bearing / 2)])
        quat = jax.vmap(rotation.multiply, (None, 0))(facing, state.quat)
        state = state.replace(quat=quat, vel=state.vel + first.vel[None])
        false = jnp.zeros(drones, bool)
        return state, variables | {"pos": state.pos, "vel": state.vel, "touched": false}

    def distance_error(task: Task, world: World) -> Float[Array, " n"]:
        """Difference between actual and desired distance from the followed drone, m; zero for the leader."""
        apart = norm(_to_followed(world))
        return jnp.where(_is_leader(world), 0, jnp.abs(apart - distance))

    return Task(
        name="follow",
        summary="follow another drone and keep it in view",
        drones=drones,
        duration=duration,
        start=start,
        target=target,
        rewards=shaping.REACH_AND_STAY
        | {
            "view": (-1.0, _out_of_sight),
            "crowding": (-5.0, shaping.crowding),
            "touched": (-10.0, _TOUCHED),
        },
        terminations={"touched": shaping.flag("touched", "A drone touches another one or the ground.")}
        | shaping.out_of_control(2 * HEIGHT + distance * drones, center=(0, 0, HEIGHT)),
        advance=_advance,
        metrics={
            "distance_error": distance_error,
            "in_view": _seen,
            "touched": _TOUCHED,
        },
        success=functools.partial(_followed, distance=distance) if duration > _SETTLED else None,
        observations={
            "velocity_error_body": ObservationTerm(
                _observe_velocity_error,
                _MAX_SPEED,
                entries=quantities("velocity of the target, relative", "m/s", "body"),
            ),
            "line_of_sight": ObservationTerm(
                _observe_line_of_sight,
                1.0 + 1e-6,
                entries=quantities("direction of the followed drone", "-", "body"),
            ),
        },
        control_hz=50.0,
        substeps=2,
        camera=camera,
        action="thrust_and_rates",
        observation=(
            "position_error_body",
            "velocity_error_body",
            "velocity_body",
            "line_of_sight",
            "gravity",
            "omega",
            "last_action",
        ),
    )


def _advance(task: Task, world: World) -> dict[str, Array]:
    pos = world.drones.pos
    touching = nearest_on_the_way(world.variables["pos"], pos, None, world.params.collision_radius) < 0
    fell = pos[:, 2] < world.params.collision_radius
    return world.variables | {
        "pos": pos,
        "vel": world.drones.vel,
        "touched": world.variables["touched"] | touching | fell,
    }


def _is_leader(world: World) -> Bool[Array, " n"]:
    return jnp.arange(len(world.drones.pos)) == 0


def _to_followed(world: World) -> Float[Array, "n 3"]:
    """Vector from every drone to the followed one, m, world; zero for the leader."""
    pos = world.drones.pos
    return jnp.concatenate([pos[:1], pos[:-1]]) - pos


def _observe_line_of_sight(task: Task, world: World) -> Float[Array, "n 3"]:
    """Direction of the followed drone, body axes; zero for the leader."""
    return jax.vmap(rotation.rotate_inverse)(world.drones.quat, jax.vmap(unit)(_to_followed(world)))


def _observe_velocity_error(task: Task, world: World) -> Float[Array, "n 3"]:
    """Velocity of the target relative to the drone, m/s, body axes."""
    error = task.target_now(world).vel - world.drones.vel
    return jax.vmap(rotation.rotate_inverse)(world.drones.quat, error)


def _out_of_sight(task: Task, world: World) -> Float[Array, " n"]:
    """One minus the cosine of the angle from the camera's axis to the followed drone; zero for the leader."""
    return jnp.where(_is_leader(world), 0, 1 - _observe_line_of_sight(task, world)[:, 0])


def _in_view(world: World) -> Bool[Array, " n"]:
    """Whether the followed drone is within the field of view; true for the leader."""
    to_followed = jax.vmap(rotation.rotate_inverse)(world.drones.quat, _to_followed(world))
    ahead, left, up = to_followed.T
    horizontal, vertical = camera.slopes
    seen = (ahead > 0) & (jnp.abs(left) < horizontal * ahead) & (jnp.abs(up) < vertical * ahead)
    return seen | _is_leader(world)


def _seen(task: Task, world: World) -> Float[Array, " n"]:
    """One if the followed drone is within the field of view."""
    return _in_view(world).astype(world.drones.pos.dtype)


def _level(v: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Level directions of vectors."""
    return jax.vmap(unit)(v * jnp.array([[1, 1, 0]], v.dtype))


def _followed(metrics: Mapping[str, Array], dt: float, distance: float) -> Array:
    """Whether a drone kept the distance on average and the other drone in view, and touched nothing."""
    error, in_view = (shaping.caught_up(metrics[name], _SETTLED, dt) for name in ("distance_error", "in_view"))
    close = jnp.mean(error, axis=0) < _TOLERANCE * distance
    in_view = jnp.mean(in_view, axis=0) >= _IN_VIEW
    return close & in_view & (metrics["touched"][-1] == 0)

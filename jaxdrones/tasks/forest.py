"""Task: fly through a forest to a goal on the other side, with a depth camera."""

from collections.abc import Mapping
from typing import Annotated

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdrones import rotation
from jaxdrones.arguments import checked, number
from jaxdrones.checks import check_number
from jaxdrones.params import Params
from jaxdrones.quantity import quantities
from jaxdrones.sensing import Camera, Cylinder, Scene
from jaxdrones.sensing import forest as draw_forest
from jaxdrones.state import State
from jaxdrones.tasks import shaping, touching
from jaxdrones.tasks.starts import check_apart, thrown
from jaxdrones.tasks.task import Drones, ObservationTerm, Task, World, norm
from jaxdrones.vector import safe_sqrt

HEIGHT = 1.5  # m, of flight
REACHED = 1.0  # m: distance at which a goal is reached
_HIGHEST = 4.0  # m; trees are higher, so drones cannot fly over them
_TREE_HEIGHT = 5.0  # m
_SPACING = 1.0  # m in y between drones
_CLEARANCE = 1.5  # m between a tree and a start or goal
_REACH, _REACH_OF_TEAM = (0.0, 0.5, 0.2), (0.0, 0.3, 0.2)  # m: spread of the starts of one drone, and of several
_BEHIND = 2.0  # m: margin of the strip before the start and beyond the goal
_MAX_SPEED = 20.0  # m/s
_LANES = 32  # straight flights for the traversability

camera = Camera(resolution=(16, 12), field_of_view=90.0, far=24.0)
"""Camera of the task, fixed to the body; its range is longer than the forest."""


_HAS_REACHED = shaping.variable("reached", f"One if the drone has been within {REACHED:g} m of its goal.")
_ARRIVES = shaping.variable(
    "arrives", f"One in the step in which the drone comes within {REACHED:g} m of its goal for the first time."
)


@checked
def forest(
    drones: Drones = 1,
    speed: Annotated[float, number("m/s", above=0, at_most=_MAX_SPEED)] = 3.0,
    density: Annotated[float, number("trees per m^2", at_least=0)] = 0.15,
    length: Annotated[float, number("m", above=0)] = 20.0,
    width: float = 10.0,
    duration: float | None = None,
) -> Task:
    """Fly through a random forest to a goal on the other side.

    Args:
        drones: number of drones; they start 1 m apart in y.
        speed: commanded speed, m/s; at most 20.
        density: trees per m^2.
        length: distance of the goal, m.
        width: width of the forest, m; leaving it to the side ends the episode.
        duration: duration of an episode, s; by default twice the time at the commanded speed plus 1 s.
    """
    check_number("width", width, "m", above=_SPACING * (drones + 1))
    if duration is None:
        duration = 2 * length / speed + 1
    y = [_SPACING * (i - (drones - 1) / 2) for i in range(drones)]

    def scene(key: jax.Array) -> Scene:
        ends = [(x, place, HEIGHT) for x in (0.0, length) for place in y]
        return draw_forest(
            key,
            density=density,
            length=length,
            width=width,
            height=_TREE_HEIGHT,
            keep_free=ends,
            clearance=_CLEARANCE,
        )

    def start(key: jax.Array, params: Params, scene: Scene) -> tuple[State, dict[str, Array]]:
        """Nearly at rest on one side of the forest."""
        reach = _REACH if drones == 1 else _REACH_OF_TEAM
        check_apart(params, _SPACING - 2 * reach[1])
        place = jnp.asarray([(0.0, place, HEIGHT) for place in y], params.mass.dtype)
        goal = place + jnp.array([[length, 0, 0]], place.dtype)
        state = thrown(key, params, place, reach=reach, speed=0.5, omega=0.5, tilt=0.2)
        zero, false = jnp.zeros_like(params.mass), jnp.zeros(drones, bool)
        return state, touching.variables(params, state.pos, scene) | {
            "goal": goal,
            "start": state.pos,
            "progress": zero,
            "path": zero,
            "reached": false,
            "arrives": false,
        }

    def desired(task: Task, world: World) -> Float[Array, "n 3"]:
        """Velocity towards the goal, m/s, world; slower only at the goal."""
        return shaping.velocity_to_target(task, world, speed, REACHED)

    def velocity(task: Task, world: World) -> Float[Array, " n"]:
        """Magnitude of the velocity error over the commanded speed."""
        return shaping.length(world.drones.vel - desired(task, world), 0.1 * speed) / speed

    def progress(task: Task, world: World) -> Float[Array, " n"]:
        """Speed of approach to the goal over the commanded speed."""
        return world.variables["progress"] / (speed * world.dt)

    def heading(task: Task, world: World) -> Float[Array, " n"]:
        """One minus the cosine of the angle between the camera's axis and the direction of the goal."""
        forward = jax.vmap(lambda quat: rotation.axes(quat)[0])(world.drones.quat)
        return 1 - jnp.sum(forward * desired(task, world), axis=-1) / speed

    def observe_desired(task: Task, world: World) -> Float[Array, "n 3"]:
        """Velocity to the goal at the commanded speed, m/s, body axes."""
        return jax.vmap(rotation.rotate_inverse)(world.drones.quat, desired(task, world))

    def all_reached(task: Task, world: World) -> Bool[Array, " n"]:
        """All drones have reached their goals."""
        return jnp.broadcast_to(jnp.all(world.variables["reached"]), (drones,))

    def left(task: Task, world: World) -> Bool[Array, " n"]:
        """A drone has left the strip of the forest."""
        x, y, z = world.drones.pos.T
        return ~((jnp.abs(x - length / 2) < length / 2 + _BEHIND) & (jnp.abs(y) < width / 2) & (z < _HIGHEST))

    def traversability(task: Task, world: World) -> Float[Array, " n"]:
        """Mean distance of straight flights through the forest until they touch a tree, in widths of the drone.

        It follows the measure of Nous et al. (2016). The flights are level and parallel to x.
        """
        radius = world.params.collision_radius
        lanes = jnp.linspace(-width / 2, width / 2, _LANES, dtype=radius.dtype)
        free = jnp.full((drones, _LANES), length, radius.dtype)
        for trees in world.scene.shapes(radius.dtype):
            if not isinstance(trees, Cylinder):
                continue
            reach = (trees.radius[None] + radius[:, None])[:, :, None]
            chord = reach**2 - (lanes[None] - trees.pos[:, 1:2])[None] ** 2
            hit = trees.active[None, :, None] & (chord > 0)
            entry = jnp.maximum(trees.pos[None, :, :1] - safe_sqrt(chord), 0)
            free = jnp.minimum(free, jnp.min(jnp.where(hit, entry, length), axis=1))
        return jnp.mean(free, axis=1) / (2 * radius)

    return Task(
        name="forest",
        summary=f"fly through a forest to a goal {length:g} m away",
        drones=drones,
        duration=duration,
        start=start,
        target=shaping.goal,
        rewards={
            "alive": (1.0, shaping.alive),
            "velocity": (-1.0, velocity),
            "progress": (0.5, progress),
            "clearance": (-2.0, shaping.clearance()),
            "height": (-0.3, _height),
            "heading": (-0.2, heading),
            "omega": (-0.02, shaping.body_rates),
            "action_change": (-0.02, shaping.action_change),
            "touched": (-10.0, touching.METRICS["touched"]),
            "reached": (10.0, _ARRIVES),
        },
        terminations={
            "touched": shaping.flag("touched", "A drone touches the ground, a tree or another drone."),
            "reached": all_reached,
            "left": left,
            "spinning": shaping.out_of_control(length)["spinning"],
        },
        advance=_advance,
        metrics=touching.METRICS | {"reached": _HAS_REACHED, "detour": _detour, "traversability": traversability},
        success=_reached_untouched,
        success_terminations=("reached",),
        observations={
            "desired_velocity": ObservationTerm(
                observe_desired, _MAX_SPEED, entries=quantities("velocity to the goal", "m/s", "body")
            )
        },
        control_hz=50.0,
        substeps=2,
        scene=scene,
        obstacles_terminate=True,
        camera=camera,
        vision=("depth",),
        action="thrust_and_rates",
        observation=("velocity_body", "gravity", "omega", "desired_velocity", "last_action"),
    )


def _advance(task: Task, world: World) -> dict[str, Array]:
    variables, pos = world.variables, world.drones.pos
    goal, reached = variables["goal"], variables["reached"]
    near = norm(pos - goal) < REACHED
    return touching.advance(task, world) | {
        "progress": norm(variables["pos"] - goal) - norm(pos - goal),
        "path": variables["path"] + norm(pos - variables["pos"]),
        "reached": reached | near,
        "arrives": near & ~reached,
    }


def _reached_untouched(metrics: Mapping[str, Array], dt: float) -> Array:
    """Whether a drone reached its goal and touched nothing."""
    return (metrics["reached"][-1] > 0) & (metrics["touched"][-1] == 0)


def _height(task: Task, world: World) -> Float[Array, " n"]:
    """Squared deviation from the height of flight, m^2."""
    return (world.drones.pos[:, 2] - HEIGHT) ** 2


def _detour(task: Task, world: World) -> Float[Array, " n"]:
    """Length of the path over the straight line."""
    straight = norm(world.drones.pos - world.variables["start"])
    return world.variables["path"] / jnp.where(straight > 0, straight, 1)

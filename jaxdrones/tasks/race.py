"""Task: a race of several drones around a track, in each other's downwash and with contact."""

from collections.abc import Mapping
from typing import Annotated, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdrones.arguments import NonNegativeInt, Switch, checked, number, whole
from jaxdrones.params import Params
from jaxdrones.quantity import quantities
from jaxdrones.sensing import Scene
from jaxdrones.state import State
from jaxdrones.tasks import centerline, crossing, racetrack, shaping
from jaxdrones.tasks.pairs import nearest_on_the_way
from jaxdrones.tasks.racetrack import ARENA, GATES, MIDDLE, OPENING, START
from jaxdrones.tasks.starts import check_apart, hovering, standing_height, thrown
from jaxdrones.tasks.task import Drones, ObservationTerm, Task, World
from jaxdrones.tasks.touching import touches

_GRID, _SPREAD = 0.4, 0.05  # m between starts along y, and half width of random displacements
_LAP_SECONDS, _MAX_LAPS = 8.0, 100  # s of an episode per lap; more laps compile for minutes
_LEAD = 0.2  # m along the track; a drone with a smaller lead is beside the other one
_FINISH = 1.5  # m, between the last gate and the points behind it
_WIDE = 1.0  # m, edge of the opening that counts without contact
_FAR = 100.0  # m, between drones that left the race
_MARGIN, _SOFTNESS = 0.06, 0.03  # m: gap to an obstacle below which the reward falls
_IN_FLIGHT, _FLYING = 0.8, 0.75  # shares of random starts in flight, and of the drones in these that fly
_FIRST = 1.0  # m along the track: the first of the random starts in flight
_BETWEEN = 0.35, 2.0  # m along the track between drones that start in flight: in sight of each other or not
_MIN_SPEED, _RETURN = 1.5, 3.0  # m/s, and 1/s: of the desired velocity
_PREVIEW = (0.3, 0.7, 1.2)  # m, of the observed points of the centerline
_LINE_ENTRIES = (
    *quantities("desired velocity along the centerline", "m/s", "world"),
    *(
        entry
        for x in _PREVIEW
        for entry in quantities(f"point of the centerline {x:g} m ahead, from the drone", "m", "world")
    ),
)


@checked
def race(
    drones: Annotated[Drones, number(name="number of drones of {function}", at_most=4)] = 2,
    level: NonNegativeInt = 3,
    laps: Annotated[int, whole("laps", 1, _MAX_LAPS)] = 1,
    random_start: Switch = False,
    contact: Switch = True,
    acceleration: Annotated[float, number("m/s^2", above=0)] = 12.0,
) -> Task:
    """Drones race through four gates, in each other's downwash and with contact.

    Each drone's episode ends when it passes its last gate, hits an obstacle or is out of control; then it leaves the
    world. Drones touch when their centers come closer than two collision radii.

    Args:
        drones: number of drones, at most 4; they start 0.4 m apart in y, in random order.
        level: 0 nominal; 1 random inertia; 2 gates and poles displaced too; 3 random tracks without poles. The policy
            does not observe the poles.
        laps: number of laps of four gates, at most 100.
        random_start: for training: with probability 0.8 the start is in flight, one behind the other near a random
            place of the track, for three of four drones; the others start on the ground at the start of the track.
        contact: whether there are contact forces of ground and drones, gates and poles end a race, and only flights
            through the opening of a gate count. Training disables it: fewer physics steps, and longer episodes.
        acceleration: largest acceleration of the observed desired velocity, along the centerline and across it, m/s^2.
    """
    scene, total = racetrack.scene_of(level), laps * len(GATES)

    def start(key: jax.Array, params: Params, scene: Scene) -> tuple[State, dict[str, Any]]:
        """On the ground on a line across the track, or in flight one behind the other."""
        check_apart(params, _GRID - 2 * _SPREAD)
        grid_key, flight_key, flying_key = jax.random.split(key, 3)
        n, dtype = len(params.mass), params.mass.dtype
        gates = racetrack.gates_of(scene, dtype)
        origin = jnp.asarray([*START, standing_height(params)[0], 0], dtype)
        ahead = gates[0, :2] - origin[:2]
        origin = origin.at[3].set(jnp.arctan2(ahead[1], ahead[0]))
        course = _course(gates, laps)
        line = centerline.centerline(course, origin, jnp.asarray(acceleration, dtype))
        state, index = _grid(grid_key, params, origin), jnp.zeros(n, jnp.int32)
        if random_start:
            flying, place = _in_flight(flight_key, params, line, total)
            world_key, drone_key = jax.random.split(flying_key)
            flies = jax.random.bernoulli(world_key, _IN_FLIGHT) & jax.random.bernoulli(drone_key, _FLYING, (n,))
            state = jax.tree.map(lambda x, y: jnp.where(flies[:, None], x, y), flying, state)
            index = jnp.where(flies, place, index)
        zero = jnp.zeros(n, dtype)
        return state, {
            "gates": course,
            "line": line,
            "index": index,
            "before": index,
            "pos": state.pos,
            "progress": zero,
            "hit": jnp.zeros(n, bool),
            "touched": jnp.zeros(n, bool),
            "lead": jnp.zeros((n, n), jnp.int32),
            "overtakes": zero,
            "lap_time": zero,
        }

    def advance(task: Task, world: World) -> dict[str, Any]:
        """Gates passed, progress, contacts and order of the drones after a step."""
        variables, pos, active = world.variables, world.drones.pos, world.active
        before, index = variables["pos"], variables["index"]
        racing = active & (index < total)
        earlier, along = jax.vmap(_step_along)(_near(variables), before, pos)
        lead, overtakes = _order(variables["lead"], along, racing)
        return variables | {
            "index": index
            + (racing & racetrack.passes(racetrack.next_gate(variables), before, pos, OPENING if contact else _WIDE)),
            "before": index,
            "pos": pos,
            "progress": jnp.where(racing, along - earlier, 0),
            "hit": touches(world, before, world.scene.replace(ground=False)).scene,
            "touched": variables["touched"] | _touching(world, before),
            "lead": lead,
            "overtakes": variables["overtakes"] + overtakes,
            "lap_time": jnp.where(racing, world.time, variables["lap_time"]),
        }

    def finished(task: Task, world: World) -> Bool[Array, " n"]:
        """A drone has passed all gates."""
        return world.variables["index"] >= total

    def untouched(metrics: Mapping[str, Array], dt: float) -> Array:
        """Whether a drone passed all gates and touched no other one."""
        return (metrics["gates"][-1] == total) & (metrics["touched"][-1] == 0)

    return Task(
        name="race",
        summary="race other drones through gates on random tracks",
        drones=drones,
        duration=_LAP_SECONDS * laps,
        start=start,
        target=racetrack.target,
        rewards={
            "progress": (10.0, shaping.variable("progress", "Distance along the centerline in the last step, m.")),
            "velocity": (-1.0, _velocity),
            "passed": (2.0, racetrack.passed),
            "crashed": (-10.0, racetrack.crash),
            "clearance": (-30.0, _clearance),
            "approach": (-4.0, crossing.REWARDS["approach"][1]),
            "omega": (-0.01, shaping.body_rates),
            "action_change": (-0.02, shaping.action_change),
        },
        terminations={"finished": finished}
        | ({"crashed": racetrack.crashed} if contact else {})
        | shaping.out_of_control(ARENA, center=MIDDLE),
        ends="drone",
        advance=advance,
        metrics=racetrack.METRICS
        | {
            "touched": shaping.variable("touched", "One if the drone has touched another one."),
            "overtakes": shaping.variable("overtakes", "Number of times that the drone went past another one."),
        },
        success=untouched,
        success_terminations=("finished",),
        randomize=racetrack.randomization_of(level),
        observations={
            "gates": racetrack.OBSERVATION,
            "line": ObservationTerm(_observe_line, 20.0, entries=_LINE_ENTRIES),
        },
        scene=scene,
        obstacles_terminate=True,
        contact=("ground", "drones") if contact else (),
        pairs=("downwash",),
        control_hz=50.0,
        action="thrust_and_rates",
        observation=("line", "gates", "rotation_matrix", "velocity", "omega", "opponents"),
    )


def _grid(key: jax.Array, params: Params, start: Float[Array, "4"]) -> State:
    """On the ground on a line along y, in random order."""
    order_key, spread_key = jax.random.split(key)
    n, dtype = len(params.mass), start.dtype
    slot = jax.random.permutation(order_key, n) - (n - 1) / 2
    pos = jnp.broadcast_to(start[:3], (n, 3)).at[:, 1].add(_GRID * slot).at[:, 2].set(standing_height(params))
    return hovering(params, pos.at[:, :2].add(jax.random.uniform(spread_key, (n, 2), dtype, -_SPREAD, _SPREAD)))


def _in_flight(key: jax.Array, params: Params, line: centerline.Centerline, total: int) -> tuple[State, Array]:
    """One behind the other near a random place of the centerline, in random order; and the next gate of each."""
    place_key, gap_key, order_key, speed_key, throw_key = jax.random.split(key, 5)
    n, dtype = len(params.mass), line.along.dtype
    gaps = jax.random.uniform(gap_key, (n,), dtype, *_BETWEEN).at[0].set(0)
    ahead = jnp.cumsum(gaps)
    room = jnp.maximum(line.along[total, 0] - _FIRST - ahead[-1], 0)  # of the last drone, before the last gate
    last = _FIRST + room * jax.random.uniform(place_key, (), dtype)
    place = last + ahead[jax.random.permutation(order_key, n)]
    pos, tangent, fastest = centerline.interpolate(line, place)
    speed = fastest * jax.random.uniform(speed_key, (n,), dtype)
    state = thrown(throw_key, params, pos, reach=0.08, speed=0.5, omega=1.0, tilt=0.4)
    index = jnp.searchsorted(line.along[1:, 0], place, side="right")
    return state.replace(vel=state.vel + speed[:, None] * tangent), index.astype(jnp.int32)


def _course(gates: Float[Array, "g 4"], laps: int) -> Float[Array, "p 4"]:
    """Gates of all laps in order, and two more straight behind the last one, towards which drones finish."""
    ahead = jnp.concatenate([racetrack.direction(gates[-1]), jnp.zeros(1, gates.dtype)])
    behind = [gates[-1:] + (k * _FINISH * ahead)[None] for k in (1, 2)]
    return jnp.concatenate([*[gates] * laps, *behind])


def _near(variables: dict[str, Any]) -> centerline.Centerline:
    """Section of the centerline near every drone."""
    return jax.vmap(variables["line"].near)(variables["index"])


def _step_along(section: centerline.Centerline, before: Array, pos: Array) -> tuple[Array, Array]:
    """Coordinates along the centerline before and after a step, m."""
    earlier, now = (centerline.foot(section, x) @ section.along for x in (before, pos))
    return earlier, now


def _desired_velocity(world: World) -> Float[Array, "n 3"]:
    """Velocity along the centerline and back to it, m/s."""

    def of_drone(section: centerline.Centerline, pos: Array) -> Array:
        weights = centerline.foot(section, pos)
        speed = jnp.maximum(weights @ section.speed, _MIN_SPEED)
        return speed * centerline.tangent(section, weights) + _RETURN * (weights @ section.pos - pos)

    return jax.vmap(of_drone)(_near(world.variables), world.drones.pos)


def _observe_line(task: Task, world: World) -> Float[Array, "n 12"]:
    """Desired velocity, m/s, and points of the centerline ahead, from the drone, m; world axes.

    Points are those of the section near the drone: they are nearer where it ends less than that far ahead.
    """

    def ahead(section: centerline.Centerline, pos: Array) -> Array:
        along = centerline.foot(section, pos) @ section.along
        return jnp.concatenate([centerline.at(section, along + x) @ section.pos - pos for x in _PREVIEW])

    points = jax.vmap(ahead)(_near(world.variables), world.drones.pos)
    return jnp.concatenate([_desired_velocity(world), points], axis=-1)


def _velocity(task: Task, world: World) -> Float[Array, " n"]:
    """Difference from the velocity along the centerline and back to it, m/s."""
    return shaping.length(world.drones.vel - _desired_velocity(world), 0.1)


def _touching(world: World, before: Float[Array, "n 3"]) -> Bool[Array, " n"]:
    """Whether each drone touches another one on the way between two control steps."""
    n, dtype = before.shape[0], before.dtype
    if n == 1:
        return jnp.zeros(1, bool)
    away = jnp.stack([_FAR * (1 + jnp.arange(n, dtype=dtype))] * 3, axis=-1)  # drones that left the world touch none
    before, pos = (jnp.where(world.active[:, None], x, away) for x in (before, world.drones.pos))
    return nearest_on_the_way(before, pos, None, world.params.collision_radius) < 0


def _order(lead: Array, along: Float[Array, " n"], racing: Bool[Array, " n"]) -> tuple[Array, Float[Array, " n"]]:
    """Last clear lead (1), or arrears (-1), of each drone over each other one, and the number of overtakes."""
    ahead = jax.lax.stop_gradient(along[:, None] - along[None])
    both = racing[:, None] & racing[None]
    now = jnp.where(both & (jnp.abs(ahead) > _LEAD), jnp.sign(ahead), lead).astype(lead.dtype)
    return now, jnp.sum((now == 1) & (lead == -1), axis=1).astype(along.dtype)


def _clearance(task: Task, world: World) -> Float[Array, " n"]:
    """Smoothed penetration of a margin of 6 cm about gates and poles, and of the ground by a drone's feet, m.

    Without the second, a policy that is trained without contact begins to turn before it has left the ground.
    """
    obstacles = world.scene.replace(ground=False)
    gap = jax.vmap(obstacles.distance)(world.drones.pos) - world.params.collision_radius - _MARGIN
    height = world.drones.pos[:, 2] - standing_height(world.params)
    return _SOFTNESS * (jax.nn.softplus(-gap / _SOFTNESS) + jax.nn.softplus(-height / _SOFTNESS))

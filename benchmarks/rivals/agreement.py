"""Flights of crazyflow, rotorpy and l2f for benchmarks/agreement.py, which runs this in their environment.

Each has its own vehicle, or ours with the parameters that it accepts, and its own default integrator.
"""

import argparse
import importlib.metadata
import json
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxdrones as jd
from benchmarks.rivals import switches
from benchmarks.rivals.switches import RADIANS_PER_SECOND, Cause, Setup
from jaxdrones import rotation

TAPE = Path(__file__).parents[2] / "tests" / "golden" / "dyn_main_cf2x_random_b_init.npz"
DT, STEPS = 1 / 240, 240
GRAVITY = Cause("constant", "gravity 9.81 m/s^2", lambda setup: setup.but(gravity=9.81))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--without-l2f", action="store_true", help="which could not be installed")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    warnings.filterwarnings("ignore")
    rows = [of_crazyflow(), of_rotorpy()]
    names = ["crazyflow", "rotorpy"]
    if not options.without_l2f:
        rows.append(of_l2f())
        names.append("l2f")
    print(json.dumps({"rows": rows, "versions": {name: importlib.metadata.version(name) for name in names}}))


def ours_of(params: jd.Params) -> Setup:
    """Ours with drag and lagging rotors, by its default integrator."""
    return Setup(params, effects=(jd.drag,), rotors=jd.lagging_rotors)


def without_drag(setup: Setup) -> Setup:
    """The same without the drag of the rotors."""
    return setup.but(effects=tuple(effect for effect in setup.effects if effect is not jd.drag))


def flight_of(params: jd.Params) -> tuple[jd.State, np.ndarray]:
    """The common start with the rotors at hover speed, and the tape with the same shares of the hover speed."""
    with np.load(TAPE) as a:
        fields = {"pos": "pos", "quat": "quat", "vel": "vel", "omega": "body_rates"}
        start = {name: jnp.asarray(a[array][0, 0]) for name, array in fields.items()}
        tape = a["rpm_applied"][:STEPS, 0] / float(jd.load_params("cf2x").hover_rpm)
    return jd.State(**start, rpm=jnp.full(4, params.hover_rpm)), tape * float(params.hover_rpm)


def of_crazyflow() -> dict:
    """Its cf2x_P250 beside our cf21, whose numbers are from there."""
    from crazyflow.dynamics import Dynamics, load_params

    from benchmarks.rivals.crazyflow import make_sim, make_step

    params = jd.load_params("cf21")
    start, tape = flight_of(params)
    sim = make_sim("cf2x_P250", round(1 / DT))
    step, team, states = jax.jit(make_step(sim, 1)), jd.repeat(params, 1), []
    state = jax.tree.map(lambda x: x[None], start)
    for rpm in tape:
        state = step(team, state, jnp.asarray(rpm)[None])
        states.append(state)
    theirs = {name: np.stack([np.asarray(getattr(s, name)[0]) for s in states]) for name in _STATE}

    own = load_params(Dynamics.first_principles, "cf2x_P250")
    rise, rise_square, fall, fall_square = np.asarray(own["rotor_dyn_coef"], float)

    def lag(params, state, command):
        error, square = command - state.rpm, command**2 - state.rpm**2
        up = error > 0
        return state.rpm, jnp.where(up, rise, fall) * error + jnp.where(up, rise_square, fall_square) * square

    thrust, torque = (np.asarray(own[name], float) for name in ("rpm2thrust", "rpm2torque"))
    drag = -np.diag(np.asarray(own["drag_matrix"], float))
    causes = [
        Cause(
            "rotor model", "curves of thrust and torque, not k RPM^2", lambda s: s.plus(switches.curves(thrust, torque))
        ),
        Cause("rotor model", "lag that depends on the speed", lambda s: s.but(rotors=lag)),
        Cause("drag", "N/(m/s), whatever the rotors do", lambda s: without_drag(s).plus(switches.constant_drag(drag))),
        GRAVITY,
        Cause("integration", "explicit Euler, exponential map", lambda s: s.but(integrator=switches.exponential_euler)),
    ]
    return switches.attribution("crazyflow, cf2x_P250", ours_of(params), causes, start, tape, DT, theirs)


def of_rotorpy() -> dict:
    """Its Hummingbird beside ours, whose numbers are from there."""
    from rotorpy.vehicles.hummingbird_params import quad_params as own
    from rotorpy.vehicles.multirotor import Multirotor

    params = jd.load_params("hummingbird")
    start, tape = flight_of(params)
    places = np.array([own["rotor_pos"][f"r{i}"] for i in range(1, 5)])
    order = [int(np.argmin(np.linalg.norm(places - np.asarray(place), axis=1))) for place in params.rotor_pos]
    assert sorted(order) == [0, 1, 2, 3]
    assert (np.asarray(own["rotor_directions"])[order] == params.rotor_spin).all()
    speeds = np.empty_like(tape)
    speeds[:, order] = tape * RADIANS_PER_SECOND
    state = {"x": start.pos, "v": start.vel, "q": start.quat, "w": start.omega, "wind": np.zeros(3)}
    state = {name: np.asarray(x, float) for name, x in state.items()}
    state["rotor_speeds"] = np.full(4, float(params.hover_rpm) * RADIANS_PER_SECOND)
    vehicle, states = Multirotor(own, state), []
    for row in speeds:
        state = vehicle.step(state, {"cmd_motor_speeds": row}, DT)
        states.append(state)
    fields = {"pos": "x", "quat": "q", "vel": "v", "omega": "w"}
    theirs = {name: np.stack([s[field] for s in states]) for name, field in fields.items()}

    per_square = RADIANS_PER_SECOND**2
    body = np.array([own["c_Dx"], own["c_Dy"], own["c_Dz"]])

    def body_drag(params, state):
        velocity = rotation.rotate_inverse(state.quat, state.vel)
        return jd.Wrench.of_force(-jnp.sqrt(jnp.sum(velocity**2)) * jnp.asarray(body) * velocity)

    def lift(params, state):
        local = _at_rotors(params, state)
        return jd.Wrench.of_thrusts(params.rotor_pos, own["k_h"] * jnp.sum(local[:, :2] ** 2, axis=1))

    def drag_at_rotors(params, state):
        forces = -RADIANS_PER_SECOND * state.rpm[:, None] * params.drag_coeff[None] * _at_rotors(params, state)
        force, torque = jnp.sum(forces, axis=0), jnp.sum(jnp.cross(params.rotor_pos, forces), axis=0)
        return jd.Wrench.of_force(force) + jd.Wrench.of_torque(torque)

    numbers = dict(
        kf=own["k_eta"] * per_square,
        km=own["k_m"] * per_square,
        rotor_pos=places[order],
        drag_coeff=[own["k_d"], own["k_d"], own["k_z"]],
        max_rpm=own["rotor_speed_max"] / RADIANS_PER_SECOND,
    )
    lag = dict(rotor_rise_time=own["tau_m"], rotor_fall_time=own["tau_m"])
    causes = [
        Cause("rotor model", "time constant 5 ms", lambda s: s.but(**lag)),
        Cause("drag", "of each rotor, at its place and air speed", lambda s: without_drag(s).plus(drag_at_rotors)),
        Cause("drag", "of the body, with the square of air speed", lambda s: s.plus(body_drag)),
        Cause("rotor model", "translational lift", lambda s: s.plus(lift)),
        GRAVITY,
        Cause("integration", "RK45 of scipy, tolerance 1e-3", lambda s: s.but(fly=_by_scipy)),
        Cause("constant", "five digits of coefficients and places", lambda s: s.but(**numbers)),
    ]
    return switches.attribution("rotorpy, Hummingbird", ours_of(params), causes, start, tape, DT, theirs)


def of_l2f() -> dict:
    """Our cf21 told to it, in single precision."""
    import l2f

    params = jd.load_params("cf21")
    start, tape = flight_of(params)
    device, environment, told, rng = l2f.Device(), l2f.Environment(), l2f.Parameters(), l2f.Rng()
    l2f.initialize_environment(device, environment)
    l2f.initialize_rng(device, rng, 0)
    l2f.initial_parameters(device, environment, told)
    facts = json.loads(l2f.parameters_to_json(device, environment, told))
    highest = float(params.max_rpm)
    inertia = np.asarray(params.inertia, float)
    facts["dynamics"] |= {
        "rotor_positions": np.asarray(params.rotor_pos, float).tolist(),
        "rotor_torque_directions": [[0.0, 0.0, s] for s in np.asarray(params.rotor_spin, float).tolist()],
        "rotor_thrust_coefficients": [[0.0, 0.0, float(params.kf) * highest**2]] * 4,
        "rotor_torque_constants": [float(params.km / params.kf)] * 4,
        "rotor_time_constants_rising": [float(params.rotor_rise_time)] * 4,
        "rotor_time_constants_falling": [float(params.rotor_fall_time)] * 4,
        "mass": float(params.mass),
        "gravity": [0.0, 0.0, -float(params.gravity)],
        "J": np.diag(inertia).tolist(),
        "J_inv": np.diag(1 / inertia).tolist(),
    }
    facts["integration"]["dt"] = DT
    l2f.parameters_from_json(device, environment, json.dumps(facts), told)
    state, after = l2f.State(), l2f.State()
    l2f.initial_state(device, environment, told, state)
    state.position = np.zeros(3)  # beside a position of 60 m single precision would see no motion
    state.orientation = np.roll(np.asarray(start.quat), 1)
    state.linear_velocity, state.angular_velocity = np.asarray(start.vel), np.asarray(start.omega)
    state.rpm = np.asarray(start.rpm) / highest
    states = []
    for rpm in tape:
        l2f.step(device, environment, told, state, (2 * rpm / highest - 1).tolist(), after, rng)
        state.assign(after)
        seen = state.position, state.orientation, state.linear_velocity, state.angular_velocity
        states.append([np.array(x) for x in seen])
    pos, quat, vel, omega = map(np.stack, zip(*states, strict=True))
    theirs = {"pos": pos, "quat": np.roll(quat, -1, axis=1), "vel": vel, "omega": omega}
    causes = [
        Cause("gyroscopic term", "and reaction of the rotors: none", lambda s: s.but(rotor_inertia=0.0)),
        Cause("drag", "none", without_drag),
        Cause("integration", "rk4", lambda s: s.but(integrator=jd.rk4)),
    ]
    start = start.replace(pos=jnp.zeros(3))
    return switches.attribution("l2f, told our cf21", ours_of(params), causes, start, tape, DT, theirs, _SINGLE)


_STATE = ("pos", "quat", "vel", "omega")
_SINGLE = 2e-4  # m, rad, m/s, rad/s: 240 steps of single precision, 3e-5 of the body rates


def _at_rotors(params: jd.Params, state: jd.State) -> jax.Array:
    """(4, 3) velocity of each rotor, m/s, body."""
    velocity = rotation.rotate_inverse(state.quat, state.vel)
    return velocity[None] + jnp.cross(state.omega[None], params.rotor_pos)


def _by_scipy(setup: Setup, start: jd.State, tape: np.ndarray, dt: float) -> jd.State:
    """Our law of motion by scipy's `solve_ivp`, in the units and order of rotorpy, on which its step size depends."""
    from scipy.integrate import solve_ivp

    law, team = jd.make_derivative(effects=setup.effects, rotors=setup.rotors), jd.repeat(setup.params, 1)
    parts = np.cumsum([3, 3, 4, 3, 3])

    @jax.jit
    def rate(numbers, rpm):
        pos, vel, quat, omega, _, speeds = jnp.split(numbers, parts)
        unit = quat / jnp.sqrt(jnp.sum(quat**2))
        state = jd.State(pos, unit, vel, omega, speeds / RADIANS_PER_SECOND)
        k = jax.tree.map(lambda x: x[0], law(team, jax.tree.map(lambda x: x[None], state), rpm[None]))
        turned = jd.rotation.multiply(quat, jnp.append(omega / 2, 0.0))
        return jnp.concatenate([k.pos, k.vel, turned, k.omega, jnp.zeros(3), k.rpm * RADIANS_PER_SECOND])

    numbers = np.concatenate(
        [start.pos, start.vel, start.quat, start.omega, np.zeros(3), start.rpm * RADIANS_PER_SECOND]
    )
    rows = []
    for rpm in tape:
        solved = solve_ivp(lambda t, s, rpm=rpm: np.asarray(rate(s, rpm)), (0.0, dt), numbers, method="RK45")
        numbers = solved.y[:, -1]
        numbers[6:10] /= np.linalg.norm(numbers[6:10])
        rows.append(numbers)
    pos, vel, quat, omega, _, speeds = np.split(np.stack(rows), parts, axis=1)
    return jd.State(*map(jnp.asarray, (pos, quat, vel, omega, speeds / RADIANS_PER_SECOND)))


if __name__ == "__main__":
    main()

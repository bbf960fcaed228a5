"""crazyflow's first-principles plant as a step of this library; runs where crazyflow is installed.

Both give `pos`, `vel` and `quat` (x, y, z, w) in world axes, the angular velocity in body axes and rotor speeds in RPM,
and number the rotors in the same order; `agreement` verifies this.
"""

import jax
import jax.numpy as jnp
import numpy as np
from crazyflow.control import Control
from crazyflow.dynamics import Dynamics, load_params
from crazyflow.sim import Sim
from crazyflow.sim.integration import Integrator

import jaxdrones as jd
from benchmarks.rivals.ours import DRAG, constant_drag
from jaxdrones import rotation

AIRFRAMES = ("cf21B_500", "cf2x_L250", "cf2x_P250", "cf2x_T350")
"""Its Crazyflies, its default first."""


def make_sim(airframe: str, freq: int = 500, integrator: Integrator = Integrator.default) -> Sim:
    """One drone that takes rotor speeds; `freq` physics steps per second."""
    return Sim(
        drone=airframe, dynamics=Dynamics.first_principles, control=Control.rotor_vel, freq=freq, integrator=integrator
    )


def make_step(sim: Sim, substeps: int) -> jd.Step:
    """`step(params, state, rpm) -> state` of a world; vehicle, drag and rotors are the simulation's, not `params`."""
    advance, resting = sim.build_step_fn(), sim.data

    def step(params: jd.Params, state: jd.State, rpm: jax.Array) -> jd.State:
        states = resting.states.replace(
            pos=state.pos[None],
            quat=state.quat[None],
            vel=state.vel[None],
            ang_vel=state.omega[None],
            rotor_vel=state.rpm[None],
        )
        data = resting.replace(states=states, controls=resting.controls.replace(rotor_vel=rpm[None]))
        after = advance(data, n_steps=substeps).states
        return jd.State(*(x[0] for x in (after.pos, after.quat, after.vel, after.ang_vel, after.rotor_vel)))

    return step


def calibrated(airframe: str, trained: jd.Params) -> jd.Params:
    """All that is told of an airframe: its mass and its hover speed.

    Full action asks for the same share of the hover speed as of the vehicle that was `trained` on, more than some
    airframes have; crazyflow cuts the command to the limits of the motors.
    """
    found = load_params(Dynamics.first_principles, airframe)
    mass = jnp.asarray(found["mass"], float)
    hover_rpm = jnp.asarray(speed_of(mass * 9.81 / 4, found["rpm2thrust"]), float)
    return trained.replace(
        mass=mass,
        kf=mass * trained.gravity / (4 * hover_rpm**2),
        max_rpm=trained.max_rpm / trained.hover_rpm * hover_rpm,
    )


def agreement(seconds: float = 0.5, freq: int = 500) -> dict[str, float]:
    """Largest difference between crazyflow and our plant, in float64, after a flight with four constant commands.

    crazyflow is given our Crazyflie and both the same drag; the drone starts turned, moving and tumbling, with its
    rotors at hover speed, so that a wrong frame, unit, sign or order of rotors would show.
    """
    with jax.enable_x64(True):
        params = jax.tree.map(lambda x: x.astype(float), jd.load_params("cf2x"))
        sim = make_sim(AIRFRAMES[0], freq, Integrator.symplectic_euler)
        sim.data = sim.data.replace(params=told(sim.data.params, params))
        steps = round(seconds * freq)
        theirs = make_step(sim, steps)
        ours = jd.make_step(effects=(constant_drag,), rotors=jd.lagging_rotors, dt=1 / freq, substeps=steps)

        team = jd.repeat(params, 1)
        start = jd.State.at_rest(jnp.array([[0.1, 0.2, 2.0]])).replace(
            quat=rotation.exp(jnp.array([0.3, -0.5, 0.8]))[None],
            vel=jnp.array([[0.5, -0.3, 0.2]]),
            omega=jnp.array([[1.0, -2.0, 0.5]]),
            rpm=team.hover_rpm[:, None] * jnp.ones(4),
        )
        command = team.hover_rpm[:, None] * jnp.array([1.02, 1.03, 1.05, 0.97])
        ended = [step(team, start, command) for step in (theirs, ours)]
        names = ("pos", "quat", "vel", "omega", "rpm")
        return {name: float(np.max(np.abs(getattr(ended[0], name) - getattr(ended[1], name)))) for name in names}


def told(theirs, params: jd.Params):
    """The parameters of our vehicle in its words; the momentum of propellers, which we leave out, is zero."""
    zero = jnp.zeros(())
    return theirs.replace(
        mass=params.mass[None],
        L=params.rotor_pos[3, :1],
        prop_inertia=zero[None],
        gravity_vec=jnp.stack([zero, zero, -params.gravity]),
        J=jnp.diag(params.inertia),
        J_inv=jnp.diag(1 / params.inertia),
        rpm2thrust=jnp.stack([zero, zero, params.kf])[None],
        rpm2torque=jnp.stack([zero, zero, params.km])[None],
        drag_matrix=-jnp.diag(DRAG),
        rotor_dyn_coef=jnp.stack([1 / params.rotor_rise_time, zero, 1 / params.rotor_fall_time, zero])[None],
    )


def speed_of(thrust, curve):
    """Rotor speed, RPM, at which the curve a + b w + c w^2 gives a thrust (N), any shape."""
    a, b, c = curve
    return (-b + (b**2 - 4 * c * (a - thrust)) ** 0.5) / (2 * c)

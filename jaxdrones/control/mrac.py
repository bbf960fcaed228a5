"""Model-reference adaptive control of gym-pybullet-drones (2.x): state feedback with adaptive gains.

The state x is position, roll, pitch and yaw, velocity and body rates. In hover its linear model is x' = A x + B u, with
u thrust (N) and torque (N m). The weight is not part of the model; the adaptation compensates it. The feedback places
the poles of the model at -1 to -12 1/s. This closed loop is the reference model of the adaptation (Narendra and
Annaswamy, Stable Adaptive Systems, chapter 3).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdrones import rotation
from jaxdrones.arguments import TimeStep, checked
from jaxdrones.checks import check_number, is_concrete
from jaxdrones.control import pid
from jaxdrones.control.single import Finite, OneParams, OneSetpoint, OneState
from jaxdrones.errors import UserError
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode
from jaxdrones.state import State
from jaxdrones.urdf import load_params
from jaxdrones.vector import safe_sqrt

_POLES = -np.linspace(1, 12, 12)  # 1/s
_WEIGHT = 600.0  # Q of the Lyapunov equation is this times the unit matrix
_LEARNING_RATE = 5e-3
_MAX_TORQUE = 3200.0


class Gains(PyTreeNode):
    """The initial gains, the reference model, and the adaptation rates."""

    feedback: Array
    """(12, 4) K_x of u = K_x^T x + K_r^T r."""
    feedforward: Array
    """(4, 4) K_r."""
    reference: Array
    """(4, 12) matrix from the state of the target to r."""
    model: Array
    """(12, 12) A_m of the reference model, x_m' = A_m x_m + B r."""
    inputs: Array
    """(12, 4) B."""
    lyapunov: Array
    """(12, 12) P, the solution of A_m^T P + P A_m = -600 I."""
    feedback_rate: Array
    """(12, 12) adaptation rate of K_x' = -rate x e^T P B, with e = x - x_m."""
    feedforward_rate: Array
    """(4, 4) adaptation rate of K_r' = -rate r e^T P B."""


class Memory(PyTreeNode):
    """State of the controller of one drone between calls; zero before the first call."""

    feedback: Array
    """(12, 4) adaptation of K_x."""
    feedforward: Array
    """(4, 4) adaptation of K_r."""
    model: Array
    """(12,) state of the reference model."""
    running: Array
    """() 1 after the first call, which initializes the reference model with the state of the drone."""


def gains(params: Params | None = None) -> Gains:
    """Gains of gym-pybullet-drones for `cf2x`, or by its method for another vehicle.

    Poles are placed by the method of Tits and Yang, in float64 on the host.

    Raises:
        ValueError: the parameters are being traced, or there is no gravity.
    """
    from scipy import linalg, signal  # comes with JAX; loading it takes half a second

    if params is None:
        with jax.ensure_compile_time_eval():  # so that `gains()` may be called during tracing
            params = load_params("cf2x")
    if not all(is_concrete(leaf) for leaf in (params.mass, params.inertia, params.gravity)):
        raise UserError(
            "params are being traced, so poles cannot be placed; give values, outside of jax.jit and jax.vmap"
        )
    check_number("params.gravity", params.gravity, "m/s^2", above=0)
    a, b = _hover(*(np.asarray(x, float) for x in (params.mass, params.inertia, params.gravity)))
    k = signal.place_poles(a, b, _POLES).gain_matrix
    model = a - b @ k
    return Gains(
        feedback=jnp.array(-k.T),
        feedforward=jnp.eye(4),
        reference=jnp.array(-np.linalg.pinv(b) @ model),
        model=jnp.array(model),
        inputs=jnp.array(b),
        lyapunov=jnp.array(linalg.solve_continuous_lyapunov(model.T, -_WEIGHT * np.eye(12))),
        feedback_rate=_LEARNING_RATE * jnp.eye(12),
        feedforward_rate=_LEARNING_RATE * jnp.eye(4),
    )


def _hover(mass: np.ndarray, inertia: np.ndarray, gravity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A and B of the linear model in hover, with yaw 0."""
    a, b = np.zeros((12, 12)), np.zeros((12, 4))
    a[:6, 6:] = np.eye(6)
    a[6, 4], a[7, 3] = gravity, -gravity
    b[8:] = np.diag([1 / mass, *1 / inertia])
    return a, b


def init() -> Memory:
    """Memory of a drone before the first call."""
    return Memory(jnp.zeros((12, 4)), jnp.zeros((4, 4)), jnp.zeros(12), jnp.zeros(()))


@checked
def control(
    gains: Finite[Gains], params: OneParams, memory: Memory, state: OneState, setpoint: OneSetpoint, *, dt: TimeStep
) -> tuple[Memory, Float[Array, "4"]]:
    """Rotor speeds of one drone, RPM, between 9,440 and 21,666 and no more than `max_rpm`.

    As in gym-pybullet-drones, thrust is converted to PWM as in `pid`, and the torque in N m is mixed as if in PWM.

    Of the setpoint, pos, vel, yaw and omega (as body rates) are used, acc is not. See `jaxdrones.control`.
    """
    x = _state(state)
    model = jnp.where(memory.running > 0, memory.model, x)
    yaw = jnp.zeros(3).at[2].set(setpoint.yaw)
    r = gains.reference @ jnp.concatenate([setpoint.pos, yaw, setpoint.vel, setpoint.omega])
    u = (gains.feedback + memory.feedback).T @ x + (gains.feedforward + memory.feedforward).T @ r
    error = (x - model) @ gains.lyapunov @ gains.inputs
    memory = Memory(
        feedback=memory.feedback - dt * jnp.outer(gains.feedback_rate @ x, error),
        feedforward=memory.feedforward - dt * jnp.outer(gains.feedforward_rate @ r, error),
        model=model + dt * (gains.model @ model + gains.inputs @ r),
        running=jnp.ones_like(memory.running),
    )
    thrust = pid.rpm_to_pwm(safe_sqrt(jnp.maximum(u[0], 0) / (4 * params.kf)))
    return memory, pid.rotor_speeds(params, thrust, jnp.clip(u[1:], -_MAX_TORQUE, _MAX_TORQUE))


def _state(state: State) -> Float[Array, "12"]:
    """Position, roll, pitch and yaw, velocity, body rates.

    As in gym-pybullet-drones, the rates are rotated to the body by roll, pitch and yaw about moving axes in that order,
    which differs from the attitude.
    """
    roll, pitch, yaw = rpy = rotation.to_rpy(state.quat)
    omega = rotation.rotate(state.quat, state.omega)
    for axis, angle in ((0, roll), (1, pitch), (2, yaw)):
        turn = rotation.exp(jnp.zeros(3).at[axis].set(angle))
        omega = rotation.rotate_inverse(turn, omega)
    return jnp.concatenate([state.pos, rpy, state.vel, omega])

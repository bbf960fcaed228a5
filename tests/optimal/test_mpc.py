"""Model predictive control by CasADi tracks a curve in the simulator."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_loop import hovering, one, team_of

import jaxdrones as jd
from jaxdrones.control import Setpoint
from jaxdrones.status import PlanningError, Status
from jaxdrones.tasks.curves import figure_eight, setpoint_on

pytestmark = pytest.mark.needs("casadi")

DT = 1 / 40


@functools.cache
def model(**options):
    from jaxdrones.optimal.twin import casadi_model

    return casadi_model("cf2x", [jd.drag], **options)


def controller(horizon=20, solver="ipopt", **options):
    from jaxdrones.optimal.mpc import Mpc

    return Mpc(model(**options), DT, horizon=horizon, solver=solver)


@pytest.mark.slow
def test_at_the_target_the_plan_is_hover_and_far_off_it_keeps_to_the_limits():
    mpc, team = controller(horizon=4), team_of("cf2x")
    params, state = one(team), one(hovering(team))
    stay = Setpoint.at(jnp.broadcast_to(jnp.array([0, 0, 1.0]), (5, 3)))
    np.testing.assert_allclose(mpc(state, stay), np.full(4, params.hover_rpm), rtol=1e-5)
    assert mpc.message == "Solve_Succeeded" and mpc.seconds > 0
    mpc.reset()
    rpm = mpc(state, Setpoint.at(stay.pos + jnp.array([[0, 0, 3.0]])))
    assert np.all(rpm <= params.max_rpm) and np.all(rpm > 1.2 * params.hover_rpm)


@pytest.mark.slow
def test_motors_without_a_limit_are_commanded():
    from jaxdrones.optimal.mpc import Mpc
    from jaxdrones.optimal.twin import casadi_model

    team = team_of("cf2x")
    mpc = Mpc(casadi_model(one(team).replace(max_rpm=jnp.asarray(jnp.inf))), DT, horizon=2)
    above = Setpoint.at(jnp.broadcast_to(jnp.array([0, 0, 1.5]), (3, 3)))
    rpm = mpc(one(hovering(team)), above)
    assert mpc.status == Status.OK and np.all(np.isfinite(rpm)) and np.all(rpm > team.hover_rpm)


@pytest.mark.slow
def test_constants_that_are_symbols_are_given_at_each_call():
    """A heavier drone hovers at its own speed, though the model was made for the light one."""
    mpc, team = controller(horizon=4, parameters=("mass",)), team_of("cf2x")
    params, state = one(team), one(hovering(team))
    stay = Setpoint.at(jnp.broadcast_to(jnp.array([0, 0, 1.0]), (5, 3)))
    heavy = params.replace(mass=1.2 * params.mass)
    np.testing.assert_allclose(mpc(state, stay), np.full(4, params.hover_rpm), rtol=1e-5)
    np.testing.assert_allclose(mpc(state, stay, heavy), np.full(4, heavy.hover_rpm), rtol=1e-5)


@pytest.mark.slow
def test_a_state_that_is_not_finite_or_a_plan_that_does_not_converge_gives_the_last_safe_command_or_an_error():
    mpc, team = controller(horizon=4), team_of("cf2x")
    params, state = one(team), one(hovering(team))
    near = Setpoint.at(jnp.broadcast_to(jnp.array([0, 0, 1.3]), (5, 3)))
    lost = state.replace(pos=state.pos.at[0].set(jnp.nan))
    np.testing.assert_allclose(mpc(lost, near), params.hover_rpm, rtol=1e-6)  # without a command before it
    first = mpc(state, near)
    for unlucky, target, status in (
        (lost, near, Status.INVALID_STATE),
        (state, near.replace(yaw=near.yaw.at[1].set(jnp.inf)), Status.INVALID_STATE),
        (state.replace(omega=jnp.full(3, 1e12)), near, Status.INVALID_STATE),
        (state.replace(omega=jnp.array([0.8, 0, -0.61]) * jnp.pi / DT), near, Status.INVALID_STATE),
        (state.replace(vel=jnp.full(3, 500.0)), near, Status.NOT_CONVERGED),
    ):
        assert np.array_equal(mpc(unlucky, target), first) and mpc.status == status
        with pytest.raises(PlanningError, match=status.sentence) as error:
            mpc(unlucky, target, on_failure="raise")
        assert error.value.status == status
        again = mpc(state, near)
        np.testing.assert_array_equal(again, first)  # planned as if it were the first
        assert mpc.status == Status.OK and mpc.message == "Solve_Succeeded"
    mpc(state.replace(omega=jnp.array([0.7, 0, -0.7]) * jnp.pi / DT), near)  # less than half a turn in an interval
    assert mpc.status != Status.INVALID_STATE


@pytest.mark.slow
def test_what_does_not_fit_is_refused():
    from jaxdrones.optimal.mpc import Mpc
    from jaxdrones.optimal.twin import casadi_model

    team = jd.repeat(jd.load_params("cf2x"), 2)
    with pytest.raises(ValueError, match=r"unknown solver 'acados' \(known: fatrop, ipopt\)"):
        controller(solver="acados")
    for option, value in ("dt", 0.0), ("horizon", 1), ("terminal", -1.0):
        with pytest.raises(ValueError, match=f"^{option} is {value}; give a"):
            Mpc(model(), **({"dt": DT} | {option: value}))
    with pytest.raises(ValueError, match="make one for each"):
        Mpc(casadi_model(team), DT)
    with_motors = one(team).replace(aux={"motors": jd.crazyflie_motors()})
    with pytest.raises(ValueError, match="model takes the PWM of pwm_rotors"):
        Mpc(casadi_model(with_motors, rotors=jd.pwm_rotors), DT)
    mpc, one_drone = controller(horizon=4), team_of("cf2x")
    with pytest.raises(ValueError, match=r"setpoints.pos has shape \(3, 3\); expected \(5, 3\)"):
        mpc(one(hovering(one_drone)), Setpoint.at(jnp.zeros((3, 3))))


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.parametrize("solver", ["ipopt", "fatrop"])
def test_the_figure_eight_of_five_seconds_is_tracked_within_three_centimeters(solver):
    mpc, team = controller(solver=solver), team_of("cf2x")
    step = jd.make_step([jd.drag], dt=DT / 6, substeps=6)
    target = jax.jit(jax.vmap(lambda t: setpoint_on(lambda t: jnp.array([0, 0, 2.0]) + figure_eight(None, t / 5), t)))
    ahead = DT * jnp.arange(mpc.horizon + 1)
    state = hovering(team).replace(pos=target(jnp.zeros(1)).pos, vel=target(jnp.zeros(1)).vel)
    errors = []
    for k in range(240):
        rpm = mpc(one(state), target(k * DT + ahead))
        state = step(team, state, jnp.asarray(rpm, jnp.float32)[None])
        assert mpc.status == Status.OK
        errors.append(np.linalg.norm(state.pos[0] - target(jnp.array([(k + 1) * DT])).pos[0]))
    assert np.sqrt(np.mean(np.square(errors[40:]))) < 0.03

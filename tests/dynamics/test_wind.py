"""Air that moves: wind fields, drag of the body, and the thrust of rotors in it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, assert_finite, flying, jit_unoptimized, make_step

import jaxdrones as jd
from jaxdrones.dynamics.aero import flapping_moment, rate_damping
from jaxdrones.dynamics.inflow import flow_through
from jaxdrones.dynamics.power import battery_power

AREA = {"drag_area": jnp.array([2e-3, 3e-3, 6e-3])}
CF2X = jd.load_params("cf2x").replace(aux=AREA)
STATES = flying(jd.repeat(CF2X, 50))
HOVER = jax.tree.map(lambda x: x[0], jd.State.at_rest([[0.0, 0, 1]])).replace(rpm=jnp.full(4, CF2X.hover_rpm))
EFFECTS = {"drag": jd.drag, "quadratic drag": jd.quadratic_drag, "inflow": jd.inflow_thrust}
each_effect = pytest.mark.parametrize("name", EFFECTS)


@jit_unoptimized
def lift(vel):
    """The change of thrust of a hovering Crazyflie, over its weight, at each of some velocities."""
    states = jax.vmap(lambda vel: HOVER.replace(vel=vel))(vel)
    return jax.vmap(jd.inflow_thrust, (None, 0))(CF2X, states).force[:, 2] / CF2X.weight


def test_drag_of_the_body_takes_power_and_grows_with_the_square_of_the_speed():
    drag = jit_unoptimized(jax.vmap(jd.quadratic_drag, (None, 0)))
    wrench, twice = drag(CF2X, STATES), drag(CF2X, STATES.replace(vel=2 * STATES.vel))
    force = jit_unoptimized(jax.vmap(jd.rotation.rotate))(STATES.quat, wrench.force)
    assert np.all(np.sum(force * STATES.vel, axis=1) < 0)
    np.testing.assert_allclose(twice.force, 4 * wrench.force, rtol=1e-12)
    ahead = jd.quadratic_drag(CF2X, HOVER.replace(vel=jnp.array([3.0, 0, 0]))).force
    np.testing.assert_allclose(ahead, [-1.225 / 2 * 2e-3 * 9, 0, 0], rtol=1e-12)


@each_effect
def test_only_the_motion_relative_to_the_air_counts_and_a_uniform_field_is_the_wind_of_the_parameters(name):
    wind = jnp.array([1.0, -2, 0.5])
    effect = jit_unoptimized(jax.vmap(EFFECTS[name], (None, 0)))
    blown = effect(CF2X.replace(wind=wind), STATES.replace(vel=STATES.vel + wind[None]))
    assert_close(blown, effect(CF2X, STATES), 1e-12)
    in_half = jit_unoptimized(jax.vmap(jd.in_wind(lambda pos: wind / 2, EFFECTS[name]), (None, 0)))
    assert_close(in_half(CF2X.replace(wind=wind / 2), STATES), effect(CF2X.replace(wind=wind), STATES), 1e-12)


@each_effect
def test_gradients_at_rest_in_still_air_are_finite(name):
    at_rest = jax.vmap(lambda rpm: HOVER.replace(rpm=jnp.full(4, rpm)))(jnp.array([0.0, 14e3]))
    assert_finite(jit_unoptimized(jax.vmap(jax.jacrev(EFFECTS[name], argnums=(0, 1)), (None, 0)))(CF2X, at_rest))


def test_the_mean_wind_is_logarithmic():
    """At twice the height of 20 ft: ln(40 / 0.15) / ln(20 / 0.15) = 1.1417 times the speed; none at the ground."""
    field = jd.logarithmic_wind(5.0, height=20 * 0.3048, roughness=0.15 * 0.3048, direction=np.pi / 2)
    np.testing.assert_allclose(field(jnp.array([7.0, 8.0, 40 * 0.3048])), [0, 5 * 1.141662, 0], rtol=1e-5, atol=1e-12)
    for height in 0.0, -1.0, 0.0457:
        np.testing.assert_allclose(field(jnp.array([0.0, 0, height])), 0, atol=1e-12)
    assert_finite(jit_unoptimized(jax.jacrev(field))(jnp.array([0.0, 0, -1])))


@pytest.mark.slow
def test_a_field_may_change_with_time():
    """A heavy drone in a wind that swings at 1 Hz: after whole periods the drag has pushed it to and fro."""
    team = jd.repeat(CF2X.replace(mass=jnp.array(1e3), gravity=jnp.array(0.0)), 1)
    swinging = jd.in_wind(lambda pos, time: jnp.array([5.0, 0, 0]) * jnp.sin(2 * jnp.pi * time), jd.drag)
    step = make_step(effects=(swinging,), models=(jd.clock(),), integrator=jd.rk4)
    state = step.init(team, jd.State.at_rest([[0.0, 0, 1]]))
    hover = jnp.full((1, 4), CF2X.hover_rpm)
    end, path = jd.rollout(step, lambda params, memory, s, k: (memory, hover), team, state, None, 240)
    np.testing.assert_allclose(end.aux["clock"], 1.0, rtol=1e-12)
    assert path.vel[119, 0, 0] > 1e-7 and abs(end.vel[0, 0]) < 1e-4 * path.vel[119, 0, 0]


def test_a_slow_climb_loses_the_share_of_thrust_that_the_vehicle_says():
    climb = 0.01
    up, down, still = lift(jnp.array([[0, 0, climb], [0, 0, -climb], [0, 0, 0]]))
    np.testing.assert_allclose([-up, down], CF2X.inflow_loss * climb, rtol=2e-3)
    assert abs(still) < 1e-6


def test_forward_flight_lifts_and_its_gain_is_bounded():
    gains = lift(jnp.array([[1.0, 0, 0], [3, 0, 0], [10, 0, 0], [40, 0, 0]]))
    assert 0 < gains[0] < 0.02 and np.all(np.diff(gains) > 0)
    induced = np.sqrt(CF2X.weight / 4 / (2 * CF2X.air_density * np.pi * CF2X.prop_radius**2))
    assert gains[-1] < 2 * CF2X.inflow_loss * induced


def test_the_flow_through_a_rotor_is_that_of_glauert_and_of_momentum_theory():
    climb, edgewise = jnp.meshgrid(jnp.array([-1.0, 0, 2, 8]), jnp.array([0.0, 1, 3, 10]))
    flow = jit_unoptimized(jax.vmap(flow_through, (0, 0, None)))(climb.ravel(), edgewise.ravel() ** 2, 4.0)
    np.testing.assert_allclose((flow - climb.ravel()) * np.sqrt(edgewise.ravel() ** 2 + flow**2), 16, rtol=1e-6)
    np.testing.assert_allclose(flow[:4], climb[0] / 2 + np.sqrt(climb[0] ** 2 / 4 + 16), rtol=1e-6)


def test_a_rotor_that_moves_down_faster_than_its_neighbors_lifts_more_so_rolling_is_damped():
    rolling = HOVER.replace(omega=jnp.array([0.05, 0, 0]))
    torque = jit_unoptimized(jd.inflow_thrust)(CF2X, rolling).torque
    climbs = (
        0.05 * CF2X.rotor_pos[:, 1]
    )  # of the rotors; each loses that times inflow_loss of its quarter of the weight
    expected = -CF2X.inflow_loss * CF2X.weight / 4 * jnp.dot(climbs, CF2X.rotor_pos[:, 1])
    np.testing.assert_allclose(torque[0], expected, rtol=2e-3)


@pytest.mark.float32
@pytest.mark.slow
def test_in_single_precision_inflow_is_finite_everywhere():
    params = jd.load_params("cf2x")
    still = jax.tree.map(lambda x: x[0], jd.State.at_rest([[0.0, 0, 1]]))
    for vel in [0.0, 0, 0], [30.0, 0, -30], [0, 0, 50.0], [0, 0, -50.0]:
        for rpm in 0.0, 25e3:
            assert_finite(jd.inflow_thrust(params, still.replace(vel=jnp.array(vel), rpm=jnp.full(4, rpm))))


def test_mistakes_are_named():
    with pytest.raises(ValueError, match=r"height of the wind's speed is 0.01; give a number above 0.0457"):
        jd.logarithmic_wind(5.0, height=0.01)
    with pytest.raises(ValueError, match=r"field: 3 is not a function"):
        jd.in_wind(3, jd.drag)
    with pytest.raises(ValueError, match=r"effect: downwash takes .* give a function of \(params, state\)"):
        jd.in_wind(lambda pos: pos, jd.downwash)
    with pytest.raises(ValueError, match=r"field is .*drag.*, an effect on a drone; give in_wind\(field, effect\)"):
        jd.in_wind(jd.drag, lambda pos, time: pos)
    with pytest.raises(ValueError, match=r"field: <lambda> takes .* give a function of \(pos, time\)"):
        jd.in_wind(lambda pos, time, more: pos, jd.drag)
    with pytest.raises(ValueError, match=r"state.aux lacks 'clock'; give models=\(jaxdrones.clock\(\),\)"):
        jd.in_wind(lambda pos, time: pos, jd.drag)(CF2X, HOVER)
    for wind in 3.0, jnp.zeros(2):
        with pytest.raises(ValueError, match=r"wind has shape \(2?,?\); expected \(3,\): m/s, world"):
            jd.in_wind(lambda pos, wind=wind: wind, jd.drag)(CF2X, HOVER)
    with pytest.raises(ValueError, match=r"params.aux lacks 'drag_area'; found nothing"):
        jd.quadratic_drag(CF2X.replace(aux={}), HOVER)


def test_an_effect_that_the_wind_cannot_change_is_refused_in_a_wind_field():
    def gusty(params, state):
        return jd.Wrench.of_force(params.wind)

    for effect in EFFECTS.values():
        jd.in_wind(lambda pos: pos, jax.jit(effect))(CF2X, HOVER)
    np.testing.assert_allclose(jd.in_wind(lambda pos: pos, gusty)(CF2X, HOVER).force, [0, 0, 1])
    blown = jd.make_step((jd.in_wind(lambda pos: pos, jd.external_force),))
    with pytest.raises(ValueError, match=r"in_wind: external_force does not depend on params\.wind"):
        blown(jd.repeat(CF2X, 1), jd.State.at_rest([[0.0, 0, 1]]), jnp.zeros((1, 4)))


def test_rotors_never_pull_down_and_a_descent_at_most_doubles_their_thrust():
    """All vehicles, from standing rotors to the fastest, at up to 100 m/s in all directions; with finite gradients."""
    team = jax.tree.map(lambda *x: jnp.stack(x), *(jd.load_params(name) for name in sorted(jd.assets.vehicles())))
    grid = np.meshgrid(np.linspace(-100, 100, 81), [0.0, 5.0, 100.0], np.linspace(0, 1, 6))
    climb, edgewise, speed = (jnp.array(x.ravel()) for x in grid)

    def change(climb, edgewise, speed, params):
        rpm = jnp.full(4, speed * params.max_rpm)
        vel = jnp.stack([edgewise, jnp.zeros(()), climb])
        return jd.inflow_thrust(params, HOVER.replace(vel=vel, rpm=rpm)).force[2]

    on_grid = jax.vmap(jax.value_and_grad(change, argnums=(0, 1, 2, 3)), (0, 0, 0, None))
    changes, slopes = jit_unoptimized(jax.vmap(on_grid, (None, None, None, 0)))(climb, edgewise, speed, team)
    full = 4 * team.kf[:, None] * (speed[None] * team.max_rpm[:, None]) ** 2
    assert np.all(full + changes >= 0) and np.all(changes <= full)
    assert_finite(slopes)


def test_the_loss_of_every_vehicle_scales_with_the_speed_of_its_blade_tips():
    """A blade element loses its angle of attack by the flow through the disc over the speed of the blade."""

    def tip_speed(params):
        return params.hover_rpm * 2 * np.pi / 60 * params.prop_radius

    vehicles = {name: jd.load_params(name) for name in jd.assets.vehicles()}
    for name, params in vehicles.items():
        assert 30 < tip_speed(params) < 154, name
        expected = CF2X.inflow_loss * tip_speed(CF2X) / tip_speed(params)
        np.testing.assert_allclose(params.inflow_loss, expected, rtol=0.01, err_msg=name)
    drawn = jd.vehicles.median(CF2X)
    np.testing.assert_allclose(drawn.inflow_loss, CF2X.inflow_loss * tip_speed(CF2X) / tip_speed(drawn), rtol=0.01)


def in_air():
    """What all effects of the air do to two drones one above the other: a function of density, gravity and state."""
    air = (jd.drag, jd.inflow_thrust, flapping_moment, rate_damping, jd.ground_effect, jd.quadratic_drag)
    derivative = jd.make_derivative(air, (jd.downwash,), models=(jd.battery(),))
    aux = AREA | {"battery": jd.lithium_polymer()}
    flapping = {"flapping_coeff": jnp.full(2, 1e-7), "rate_damping": jnp.full(3, 1e-5), "aux": aux}
    team = jd.repeat(CF2X.replace(**flapping), 2)
    state = flying(team).replace(pos=jnp.array([[0.0, 0, 0.1], [0.02, 0, 0.8]]))
    state = state.replace(aux={"battery": jax.vmap(jd.battery().init)(team)})

    def felt(density, gravity, state):
        params = team.replace(air_density=jnp.full(2, density), gravity=jnp.full(2, gravity))
        rate = derivative(params, state, state.rpm)
        power = jax.vmap(battery_power)(params, state) - 0.5
        return jnp.concatenate([rate.vel + gravity * jnp.array([[0.0, 0, 1]]), rate.omega, power[:, None]], axis=1)

    return felt, team, state


def test_what_the_air_does_is_proportional_to_its_density_and_nothing_in_a_vacuum():
    felt, team, state = in_air()
    densities = jnp.array([0, 0.6125, 1.225])
    vacuum, half, full = jit_unoptimized(jax.vmap(felt, (0, None, None)))(densities, 9.8, state)
    np.testing.assert_allclose(half - vacuum, (full - vacuum) / 2, rtol=1e-9, atol=1e-9)
    gyroscopic = np.cross(state.omega, team.inertia * state.omega) / team.inertia
    np.testing.assert_allclose(vacuum[:, 3:6], -gyroscopic, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(vacuum[:, [0, 1, 2, 6]], 0, atol=1e-12)


@pytest.mark.slow
def test_no_gradient_of_the_air_is_infinite_in_a_vacuum_or_without_gravity():
    felt, _, state = in_air()
    both = jit_unoptimized(jax.vmap(lambda *x: (felt(*x), jax.jacrev(felt, (0, 1, 2))(*x)), (0, 0, None)))
    assert_finite(both(jnp.array([0, 0.6125, 1.225, 1.225]), jnp.array([9.8, 9.8, 9.8, 0]), state))

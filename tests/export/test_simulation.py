"""What a page simulates is what JAX simulates."""

import dataclasses
import json
import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit_unoptimized
from viewer_payload import decode

import jaxdrones as jd
from jaxdrones.visualization import browser

pytestmark = [
    pytest.mark.needs("casadi"),
    pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed"),
]
GOAL, WIND, PUSH = [0.3, -0.2, 1.4], [1.0, 0.5, 0.0], [0.0, 0.02, 0.01]


def in_node(text, *values):
    """Result of a JavaScript expression of the values a, b, ... as a NumPy array."""
    names = "abcdef"[: len(values)]
    given = "".join(f"const {x} = {json.dumps(value)};\n" for x, value in zip(names, values, strict=True))
    code = f"{given}console.log(JSON.stringify({text}));"
    done = subprocess.run(["node"], input=code, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return np.array(json.loads(done.stdout))


def test_a_function_in_javascript_has_the_values_of_jax():
    """Arithmetic, comparisons, functions and a loop, on both sides of every branch."""
    from jaxdrones.export.equations import javascript

    def function(x, y):
        turned = jnp.arctan2(x[0], x[1]) + jnp.sqrt(jnp.abs(x[2])) ** 1.5
        chosen = jnp.where((x > y) & (x != 0.5), jnp.sin(x) - y, jnp.exp(-x) / (1 + y**2))
        either = jnp.where((x < 0) | ~(y <= 1), jnp.tanh(x), jnp.maximum(x, jnp.minimum(y, 0.25)))
        summed, _ = jax.lax.scan(lambda total, z: (total * 0.5 + jnp.cos(z), None), turned, x)
        return {"a": chosen @ either, "b": summed, "c": jnp.floor(3 * x) + jnp.sign(y)}

    text = javascript("f", function, x=jnp.zeros(3), y=jnp.zeros(3))
    xs, ys = np.random.default_rng(0).normal(size=(2, 20, 3)) * 1.5
    for k, (x, y) in enumerate(zip(xs, ys, strict=True)):
        x[k % 3] = (y[k % 3], 0.0, 0.5, y[k % 3])[k % 4]  # where branches meet
        y[(k + 1) % 3] = 1.0
    found = in_node(
        f"(() => {{ {text}\nreturn a.map((x, k) => {{ const out = []; f(out, x, b[k]); return out; }}); }})()",
        xs.tolist(),
        ys.tolist(),
    )
    expected = jax.tree.leaves(jax.jit(jax.vmap(function))(xs, ys))
    np.testing.assert_allclose(found, np.column_stack(expected), rtol=1e-12, atol=1e-12)


@pytest.fixture(scope="module")
def env():
    return jd.make("hover", effects=(jd.drag, jd.ground_contact))


@pytest.fixture(scope="module")
def made(env):
    from jaxdrones.export.simulation import simulation

    with jax.enable_x64(True):
        return simulation(jd.make_policy("hover"), env)


def flown_by_the_environment(env, state, steps):
    """States after every control step of an episode with this goal, wind and start."""
    _, world = env.reset(jax.random.key(0))
    shift = jnp.asarray([GOAL]) - env.task.target_now(world).pos
    state = jax.tree.map(jnp.asarray, state)
    world = world.replace(
        drones=state.replace(pos=state.pos - shift), params=world.params.replace(wind=jnp.asarray([WIND]))
    )
    policy, observe = jd.make_policy("hover"), jax.jit(env.privileged_observation)
    states = []
    for _ in range(steps):
        _, world, *_ = env.step(jax.random.key(0), world, policy(observe(world).obs))
        states.append(world.drones.replace(pos=world.drones.pos + shift))
    return jax.tree.map(lambda *x: np.concatenate(x), *states)


def start_of(made):
    numbers = np.asarray(made.state)[None]
    pos, quat, vel, omega, rpm = np.split(numbers, (3, 7, 10, 13), axis=1)
    return jd.State(pos=pos, quat=quat, vel=vel, omega=omega, rpm=rpm)


def places(made, pilot, steps, wind):
    """Positions after every command of a pilot in JavaScript."""
    text = f"""(() => {{ {made.script}
let {{ state, memory }} = a, rpm;
const places = [];
for (let k = 1; k <= {steps}; k++) {{
  if ((k - 1) % a.period === 0) {{
    rpm = [];
    {pilot}(rpm, a.gains, memory, state, b);
    memory = rpm.splice(0, rpm.length - 4);
  }}
  const next = [];
  physics(next, state, rpm, c, [a.mass], [0, 0, 0]);
  state = next;
  if (k % a.period === 0) places.push(state.slice(0, 3));
}}
return places; }})()"""
    own = next(vars(one) for one in made.pilots if one.name == pilot)
    return in_node(text, own | {"state": made.state, "mass": made.mass}, GOAL, wind)


@pytest.mark.slow
def test_a_thousand_steps_in_javascript_are_those_of_the_environment(env, made):
    found = places(made, "policy", 1000, WIND)
    expected = flown_by_the_environment(env, start_of(made), len(found)).pos
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
    assert np.linalg.norm(found[-1] - GOAL) < 0.1 < np.linalg.norm(found[0] - GOAL)


@pytest.mark.slow
@pytest.mark.float32
def test_a_thousand_steps_in_javascript_are_those_of_the_environment_in_float32():
    """Steps from the same state differ by rounding. In a flight the gains of the policy amplify it."""
    from jaxdrones.export.simulation import simulation

    env = jd.make("hover", effects=(jd.drag, jd.ground_contact))
    made = simulation(jd.make_policy("hover"), env)
    found = places(made, "policy", 1000, WIND)
    flown = flown_by_the_environment(env, start_of(made), len(found))
    assert flown.pos.dtype == np.float32
    np.testing.assert_allclose(found, flown.pos, rtol=0, atol=1e-4)

    before = jax.tree.map(lambda x: x[:-1], flown)
    numbers = np.hstack([before.pos, before.quat, before.vel, before.omega, before.rpm]).tolist()
    policy = next(one for one in made.pilots if one.name == "policy")
    after = in_node(
        f"""(() => {{ {made.script}
return a.map((start, i) => {{
  let state = start;
  for (let k = 0; k < {policy.period}; k++) {{
    const next = [];
    physics(next, state, b[i], c, [{made.mass}], [0, 0, 0]);
    state = next;
  }}
  return state;
}}); }})()""",
        numbers,
        flown.rpm[1:].tolist(),
        WIND,
    )
    pos, quat, vel, omega, _ = np.split(after, (3, 7, 10, 13), axis=1)
    np.testing.assert_allclose(pos, flown.pos[1:], rtol=0, atol=1e-6)
    np.testing.assert_allclose(quat, flown.quat[1:], rtol=0, atol=1e-6)
    np.testing.assert_allclose(vel, flown.vel[1:], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(omega, flown.omega[1:], rtol=1e-5, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("pilot", ["pid", "geometric", "mellinger"])
def test_a_controller_in_the_page_flies_to_the_goal_and_stays(pilot, made):
    """Far enough and pushed a little; all four rotors turn at the speeds that the controller of JAX commands."""
    found = places(made, pilot, 3000, [0, 0, 0])
    assert np.linalg.norm(found[-1] - GOAL) < 0.03

    control, params = jd.control.CONTROLLERS[pilot], jd.load_params("cf2x")
    zero = jnp.zeros(3)
    target = jd.control.Setpoint(jnp.asarray(GOAL), zero, zero, jnp.zeros(()), zero)
    state = jax.tree.map(lambda x: jnp.asarray(x[0]), start_of(made))
    own = next(one for one in made.pilots if one.name == pilot)
    dt = own.period * made.dt
    _, rpm = control.control(control.gains(), params, control.init(), state, target, dt=dt)
    text = (
        f"(() => {{ {made.script}\nconst out = []; {pilot}(out, a.gains, a.memory, b, c); return out.slice(-4); }})()"
    )
    np.testing.assert_allclose(in_node(text, vars(own), made.state, GOAL), rpm, rtol=1e-5)


@pytest.mark.slow
def test_a_function_of_a_user_flies_to_the_goal_and_stays():
    from jaxdrones.export.simulation import simulation

    env = jd.make("hover", action="position", reach=0.5, tilt=20.0)
    made = simulation(lambda obs: jnp.clip(obs[:, :3] / 0.1, -1, 1), env)
    found = places(made, "policy", 4000, [0, 0, 0])
    assert np.linalg.norm(found[0] - GOAL) > 0.3 and np.linalg.norm(found[-1] - GOAL) < 0.03


@pytest.mark.slow
def test_push_mass_and_weight_obey_newton(made):
    """Falling with stopped rotors, and pushed: a = F / m - g, less a little drag."""
    text = (
        f"(() => {{ {made.script}\nconst out = []; physics(out, a, [0, 0, 0, 0], [0, 0, 0], [b], c); return out; }})()"
    )
    for share in (0.5, 2.0):
        after = in_node(text, made.state, share * made.mass, PUSH)
        acc = after[7:10] / made.dt
        expected = np.array(PUSH) / (share * made.mass) - [0, 0, 9.8]
        np.testing.assert_allclose(acc, expected, rtol=2e-3, atol=2e-3)


def test_a_push_is_in_world_axes_and_a_heavy_drone_turns_as_much_slower_as_it_is_heavier():
    from jaxdrones.export.simulation import _physics

    params, zero, dt = jd.load_params("cf2x"), jnp.zeros(3), 1 / 240
    step = jit_unoptimized(_physics(params, dt))
    level = jax.tree.map(lambda x: x[0], jd.State.at_rest(jnp.array([[0.0, 0, 5]])))
    tilted = level.replace(quat=jd.rotation.from_rpy(jnp.array([0.5, -0.7, 2.0])))
    push = jnp.array([0.1, -0.2, 0.3])
    acc = step(tilted, jnp.zeros(4), zero, params.mass, push).vel / dt + jd.vector.along_z(params.gravity)
    np.testing.assert_allclose(params.mass * acc, push, rtol=1e-9)
    rpm = params.hover_rpm * jnp.array([1.1, 1.0, 0.9, 1.05])
    light, heavy = (step(level, rpm, zero, share * params.mass, zero).omega for share in (1, 3))
    np.testing.assert_allclose(light, 3 * heavy, rtol=1e-9)
    assert (jnp.abs(heavy) > 1e-3).all()


@pytest.mark.parametrize(
    ("task", "says"), [("swap-goals", "it flies a team"), ("forest", "it observes images"), ("hover", "not instant")]
)
def test_what_a_page_cannot_fly_is_refused(task, says):
    from jaxdrones.export.simulation import simulation

    options = {"rotors": "lagging"} if task == "hover" else {}
    with pytest.raises(ValueError, match=says):
        simulation(jd.make_policy(task), jd.make(task, **options))


@pytest.mark.slow
@pytest.mark.skipif(browser.find_browser() is None, reason="there is no Chromium")
def test_a_drone_in_the_page_is_pushed_and_recovers(env, made, tmp_path):
    from jaxdrones.export.simulation import page

    file = page(jd.make_policy("hover"), env, "push me").save(tmp_path / "page.html")
    with browser.open_tab() as tab:
        tab.open(file)
        found = tab.run(
            "(() => { const plant = jaxdrones.plant(), places = [];"
            f"plant.goal = {GOAL}; plant.conditions.wind = {WIND};"
            "for (let k = 1; k <= 1000; k++) { plant.step(); if (k % 5 === 0) places.push(plant.state.slice(0, 3)); }"
            "return places; })()"
        )
        expected = flown_by_the_environment(env, start_of(made), len(found)).pos
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
        tab.run("jaxdrones.simulation.kick()")
        plant = "jaxdrones.simulation.plants[0]"
        away = f"Math.hypot(...{plant}.goal.map((x, i) => x - {plant}.state[i]))"
        tab.wait(f"{away} > 0.2")
        tab.wait(f"{away} < 0.05")
        x, y = tab.run("jaxdrones.player.stage.project(jaxdrones.simulation.place(jaxdrones.simulation.plants[0]))")
        for event, dx in (("mousePressed", 0), ("mouseMoved", 150)):
            tab.call("Input.dispatchMouseEvent", type=event, x=x + dx, y=y, button="left", clickCount=1)
        tab.wait(f"{away} > 0.1")
        tab.call("Input.dispatchMouseEvent", type="mouseReleased", x=x + 150, y=y, button="left", clickCount=1)
        tab.wait(f"{away} < 0.05")
        assert tab.problems == []


@pytest.mark.slow
@pytest.mark.skipif(browser.find_browser() is None, reason="there is no Chromium")
def test_one_of_several_drones_is_pulled_and_all_are_kicked(env, tmp_path):
    from jaxdrones.export.simulation import page

    file = page(jd.make_policy("hover"), env, "push us", drones=3).save(tmp_path / "page.html")
    with browser.open_tab() as tab:
        tab.open(file)
        plants = "jaxdrones.simulation.plants"
        away = f"{plants}.map(({{ goal, state }}) => Math.hypot(...goal.map((x, i) => x - state[i])))"
        goals = np.array(tab.run(f"{plants}.map(({{ goal }}) => goal)"))
        apart = np.linalg.norm(goals[:, None] - goals, axis=-1)
        assert apart[~np.eye(3, dtype=bool)].min() > 0.5
        tab.wait(f"{plants}[0].steps > 500")
        shown = np.array(tab.run("jaxdrones.player.actors.fleet.positions(0)"))
        np.testing.assert_allclose(shown, goals, atol=0.03)
        x, y = tab.run(f"jaxdrones.player.stage.project(jaxdrones.simulation.place({plants}[1]))")
        for event, dx in (("mousePressed", 0), ("mouseMoved", 150)):
            tab.call("Input.dispatchMouseEvent", type=event, x=x + dx, y=y, button="left", clickCount=1)
        tab.wait(f"{away}[1] > 0.1")
        others = tab.run(away)
        assert max(others[0], others[2]) < 0.03
        tab.call("Input.dispatchMouseEvent", type="mouseReleased", x=x + 150, y=y, button="left", clickCount=1)
        tab.wait(f"Math.max(...{away}) < 0.05")
        tab.run("jaxdrones.simulation.kick()")
        tab.wait(f"Math.min(...{away}) > 0.2")
        tab.wait(f"Math.max(...{away}) < 0.05")
        assert tab.problems == []


def test_numbers_that_are_not_finite_are_numbers_of_javascript():
    from jaxdrones.export.equations import javascript

    text = javascript("f", lambda x: jnp.where(x > 0, jnp.array([jnp.inf, -jnp.inf, jnp.nan]), x), x=jnp.zeros(3))
    found = in_node(f"(() => {{ {text}\nconst out = []; f(out, a); return out.map(String); }})()", [1.0, 1.0, 1.0])
    assert found.tolist() == ["Infinity", "-Infinity", "NaN"]


@pytest.mark.parametrize(
    ("task", "options", "reason"),
    [
        ("sling", {}, "it has a load or another model"),
        ("hover", {"delay": (0.0, 0.02)}, "its commands are delayed"),
        pytest.param("tracking", {}, "its target moves", marks=pytest.mark.slow),
        pytest.param("gates", {}, "its target moves", marks=pytest.mark.slow),
    ],
)
def test_a_page_of_a_task_that_it_does_not_simulate_is_refused(task, options, reason):
    from jaxdrones.export.simulation import _check

    with pytest.raises(ValueError, match=reason):
        _check(lambda obs: jnp.zeros((1, 4)), jd.make(task, **options))


def test_controllers_of_a_page_command_at_240_hz_drones_that_hover_at_first_in_a_square(env, monkeypatch):
    from jaxdrones.export import simulation

    periods = []
    monkeypatch.setattr(simulation, "_check", lambda *_: None)
    monkeypatch.setattr(simulation, "_policy", lambda *_: (None, 1, (), ()))
    monkeypatch.setattr(simulation, "_controller", lambda name, params, dt: periods.append(dt))
    monkeypatch.setattr(simulation, "javascript", lambda *_, **__: "")
    made = simulation.simulation(None, env, drones=7)
    np.testing.assert_allclose(periods, [pilot.period * made.dt for pilot in made.pilots[1:]])
    np.testing.assert_allclose(periods, 1 / 240, rtol=0, atol=made.dt / 2)
    np.testing.assert_allclose(made.state[-4:], env.params.hover_rpm[0])
    goals = np.array(made.goals)
    np.testing.assert_allclose(goals[:, 2], 1)
    np.testing.assert_allclose(goals[:, :2].mean(axis=0), 0, atol=1e-12)
    assert len(np.unique(goals.round(9), axis=0)) == 7 and (np.ptp(goals[:, :2], axis=0) < 1.3).all()


def test_drones_of_a_page_begin_at_their_goals_which_it_shows(env, monkeypatch):
    from jaxdrones.export import simulation

    start = [0.5, 0, 1, 0, 0, 0, 1, *np.zeros(10)]
    made = simulation.Simulation("", (), start, [[0.5, 0, 1], [-0.5, 0, 1]], 0.03, 0.005)
    monkeypatch.setattr(simulation, "simulation", lambda *_: made)
    (world,) = decode(simulation.page(None, env, "two", drones=2).payload)["worlds"]
    np.testing.assert_allclose(world["targets"], [made.goals], atol=1e-4)
    np.testing.assert_allclose(world["pos"], [made.goals], atol=1e-4)


@pytest.mark.parametrize("case", ["still", "touched", *[(axis, sign) for axis in range(3) for sign in (1, -1)], 4.9])
def test_a_target_that_changes_when_it_is_passed_in_any_direction_or_late_is_not_simulated(case):
    from jaxdrones.export.simulation import _target_moves

    hover = jd.make("hover").task
    zero = jnp.zeros((1,), bool)

    def start(key, params):
        return hover.start(key, params)[0], {"behind": zero, "passed": zero, "place": jnp.array([[0.0, 0, 1]])}

    def target(variables, time):
        late = jnp.where(time > case, 0.1, 0.0) if isinstance(case, float) else 0.0
        return jd.control.Setpoint.at(variables["place"] + late + 0.3 * variables["passed"][:, None])

    def advance(task, world):
        away = world.drones.pos - world.variables["place"]
        if case == "touched":
            return world.variables | {"passed": world.variables["passed"] | (jnp.max(jnp.abs(away)) < 0.05)}
        if not isinstance(case, tuple):
            return world.variables
        now = case[1] * away[:, case[0]]
        passed = world.variables["passed"] | (world.variables["behind"] & (now > 0))
        return world.variables | {"behind": now < 0, "passed": passed}

    task = dataclasses.replace(hover, start=start, target=target, advance=advance)
    assert bool(_target_moves(jd.make(task), jax.random.key(0))) == (case != "still")


def test_the_policy_of_a_page_flies_without_the_disturbance_of_its_environment(env, monkeypatch):
    """Its draws need a random key, which the page has not."""
    from jaxdrones.export import simulation

    windy = dataclasses.replace(env, disturbance=jd.dryden(7.7))
    world = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(env.reset, jax.random.key(0))[1])
    monkeypatch.setattr(type(windy), "reset", lambda *_: (None, world))
    fly, period, gains, memory = simulation._policy(lambda obs: jnp.zeros((1, 4)), windy)
    assert period == windy.physics.substeps
    state = jax.tree.map(lambda x: x[0], world.drones)
    assert jax.eval_shape(fly, gains, memory, state, jnp.zeros(3))[1].shape == (4,)


@pytest.mark.slow
@pytest.mark.skipif(browser.find_browser() is None, reason="there is no Chromium")
def test_a_page_flies_as_much_as_it_shows_at_any_rate_of_the_physics(env, tmp_path, monkeypatch):
    """At 240 Hz a row of 20 ms is 4.8 steps, of which each had 5: the flight was 4 % too fast."""
    from jaxdrones.export import simulation

    script = "function physics(out, state) { out.push(...state); }\nfunction policy(out) { out.push(0, 0, 0, 0); }"
    state, pilot = [0.0, 0, 1] + [0.0, 0, 0, 1] + 10 * [0.0], simulation.Pilot("policy", 1, [], [])
    still = simulation.Simulation(script, (pilot,), state, [[0.0, 0, 1]], 0.03, 1 / 240)
    monkeypatch.setattr(simulation, "simulation", lambda *_: still)
    file = simulation.page(jd.make_policy("hover"), env, "still").save(tmp_path / "page.html")
    with browser.open_tab() as tab:
        tab.open(file)
        flown, shown = tab.run(
            "(() => { const { player, simulation } = jaxdrones, [plant] = simulation.plants; player.playing = false;"
            "const steps = plant.steps, end = player.end; simulation.fly(47);"
            "return [(plant.steps - steps) * plant.dt, player.end - end]; })()"
        )
        assert tab.problems == []
    np.testing.assert_allclose([flown, shown], 0.94, rtol=0, atol=1 / 240)

"""What the page looks like: sizes, shadows, rotors, downwash and texts, in a real browser."""

import contextlib
import io

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import jaxdrones as jd
from jaxdrones.dynamics.contact import rim
from jaxdrones.dynamics.interaction import _jet
from jaxdrones.dynamics.model import PointMass
from jaxdrones.sensing import Cylinder, Scene
from jaxdrones.visualization import browser
from jaxdrones.visualization.viewer import show

pytestmark = [pytest.mark.slow, pytest.mark.skipif(browser.find_browser() is None, reason="there is no Chromium")]

SMALLEST = 12  # pixels
SEEN = """((index) => {
    const { actors: { fleet }, stage } = jaxdrones.player;
    const { mesh, place } = fleet.slots[0][index], size = 3 * mesh.vertices;
    const drawn = [...mesh.geometry.attributes.position.array.slice(place * size, (place + 1) * size)];
    const point = stage.orbit.target.clone(), seen = [];
    for (let k = 0; k < drawn.length; k += 3) seen.push(stage.project(point.fromArray(drawn, k)));
    return seen;
})"""
PIXELS = f"""((index) => {{
    const seen = {SEEN}(index), extent = (values) => Math.max(...values) - Math.min(...values);
    return Math.max(...[0, 1].map((axis) => extent(seen.map((at) => at[axis]))));
}})"""
BOXES = """[...document.querySelectorAll("h1, #legend, #labels span:not([hidden]), .plot label, .plot output")]
    .map((element) => element.getBoundingClientRect()).filter((box) => box.width)
    .map(({ left, right, top, bottom }) => [left, right, top, bottom])"""


def at_rest(pos, rpm=None):
    """Trajectory of drones at positions (n, 3) that do not change, with rotor speeds (n,)."""
    state = jd.State.at_rest(jnp.asarray(pos, jnp.float32))
    if rpm is not None:
        state = state.replace(rpm=jnp.broadcast_to(jnp.asarray(rpm)[:, None], (len(pos), 4)))
    return jax.tree.map(lambda x: jnp.stack([x] * 3), state)


def page_of(pos, rpm=None, **more):
    return show(at_rest(pos, rpm), jd.repeat(jd.load_params("cf2x"), len(pos)), dt=0.1, **more)


@pytest.fixture
def view(tmp_path):
    """Function that opens a page and moves to its second row; at the end the console must be empty."""
    with contextlib.ExitStack() as stack:
        tabs = []

        def view(page, size=(1100, 720)):
            tabs.append(stack.enter_context(browser.open_tab()))
            tabs[-1].open(page.save(tmp_path / "flight.html"), *size)
            tabs[-1].run("jaxdrones.positionsAt(0.1)")
            return tabs[-1]

        yield view
        assert [tab.problems for tab in tabs] == [[]] * len(tabs)


@pytest.mark.parametrize(("drones", "spacing"), [(1, 10.0), (20, 2.0), (300, 0.5)])
def test_no_drone_is_smaller_than_12_pixels_unless_the_true_size_is_chosen(view, drones, spacing):
    side = int(np.ceil(np.sqrt(drones)))
    pos = spacing * np.stack([np.arange(drones) % side, np.arange(drones) // side, np.ones(drones)], axis=-1)
    tab = view(page_of(pos), (390, 844))
    for away in (1, 3):  # times as far as at first
        tab.run(f"jaxdrones.player.stage.camera.position.multiplyScalar({away}); jaxdrones.player.draw(0)")
        sizes = [tab.run(f"{PIXELS}({drone})") for drone in range(0, drones, max(1, drones // 10))]
        assert min(sizes) >= SMALLEST
    tab.run("jaxdrones.player.panel.set('size', 1); jaxdrones.player.changed(); jaxdrones.player.draw(0)")
    assert tab.run("jaxdrones.player.actors.fleet.largest") == 1
    assert tab.run(f"{PIXELS}(0)") < SMALLEST


@pytest.mark.parametrize("apart", [0.0, 0.12])
def test_the_first_view_shows_drones_as_a_whole_however_close_they_are(view, apart):
    size = (640, 480)
    tab = view(page_of([[0.0, 0.0, 1.0], [0.0, apart, 1.0 + apart]]), size)
    tab.run("jaxdrones.film('orbit', 1)")
    tab.run("jaxdrones.frameAt(0.1, 0)")
    for drone in (0, 1):
        seen = np.array(tab.run(f"{SEEN}({drone})"))
        assert (seen > 0).all() and (seen < size).all()


def test_a_shadow_is_below_its_drone_and_fades_with_height(view):
    heights = np.array([0.05, 0.5, 2.0])
    pos = np.stack([np.arange(3.0), np.zeros(3), heights], axis=-1)
    tab = view(page_of(pos))
    shadows = "jaxdrones.player.actors.fleet.shadows.geometry.attributes"
    drawn = np.reshape(tab.run(f"[...{shadows}.position.array.slice(0, 36)]"), (3, 4, 3))
    np.testing.assert_allclose(drawn.mean(axis=1), pos * [1, 1, 0], atol=1e-4)
    dark = np.reshape(tab.run(f"[...{shadows}.color.array.slice(0, 48)]"), (3, 4, 4))[:, :, 3]
    assert (np.diff(dark.mean(axis=1)) < 0).all() and dark.max() <= 0.5
    nothing = view(page_of(pos, scene=Scene(ground=False)))
    assert nothing.run("jaxdrones.player.actors.fleet.shadows.count") == 0


def test_the_ground_is_darker_where_an_obstacle_is_between_it_and_the_sun(view):
    trunk = Scene.of(Cylinder(pos=(0.0, 0.0, 1.0), radius=0.2, height=2.0))
    shade, sun = (0.45, 0.35, 0.0), (-0.9, 0.7, 0.0)  # half of the way to the end of the shadow, and beside it
    tab = view(page_of([[-1.0, -1.0, 1.0], [1.5, 1.5, 1.0]], scene=trunk))
    tab.run("jaxdrones.player.stage.setSharp(true); jaxdrones.player.draw(0); new Promise(requestAnimationFrame)")
    with Image.open(io.BytesIO(tab.screenshot())) as image:
        picture = np.asarray(image.convert("L"), float)
    at = "(x => jaxdrones.player.stage.project(jaxdrones.player.stage.orbit.target.clone().set(...x)))"
    bright = []
    for point in (shade, sun):
        x, y = (round(value) for value in tab.run(f"{at}({list(point)})"))
        bright.append(np.median(picture[y - 2 : y + 3, x - 2 : x + 3]))
    assert bright[0] < 0.85 * bright[1]


def test_the_discs_of_rotors_are_denser_the_faster_they_turn_and_blades_are_seen_when_they_stand(view):
    hover = float(jd.load_params("cf2x").hover_rpm)
    pos = np.stack([np.arange(4.0) / 4, np.zeros(4), np.ones(4)], axis=-1)
    tab = view(page_of(pos, hover * np.array([0.0, 0.5, 1.0, 1.4])))
    tab.run("jaxdrones.player.panel.set('size', 10); jaxdrones.player.changed(); jaxdrones.player.draw(0)")
    turns = tab.run("[0, 1, 2, 3].map((i) => jaxdrones.player.actors.fleet.turn(jaxdrones.player.worlds[0], 0, i, 0))")
    density = [turn["density"][0] for turn in turns]
    np.testing.assert_allclose(density, np.array([0, 0.5, 1.0, 1.4]) / 1.6, rtol=1e-3)
    assert turns[0]["blades"][0] == 0.0 and turns[1]["blades"][0] is None  # NaN has no JSON
    discs = "jaxdrones.player.actors.fleet.shapes[0][0].discs"
    opacity = np.reshape(
        tab.run(f"[...{discs}.geometry.attributes.color.array.slice(0, 16 * {discs}.vertices)]"), (4, -1, 4)
    )
    np.testing.assert_allclose(opacity[:, :, 3].max(axis=1), 0.75 * np.array(density), rtol=1e-3)


def test_the_cone_of_the_downwash_is_the_jet_that_is_simulated(view):
    tab = view(page_of([[0.0, 0.0, 1.0]]))
    for z in (0.0, 0.4, 1.0, 3.0, 15.0):
        drawn = tab.run(f"jaxdrones.jet({z})")
        np.testing.assert_allclose(drawn["speed"], _jet(jnp.asarray(z), jnp.asarray(0.0)), rtol=1e-5)
        at_edge = _jet(jnp.asarray(z), jnp.asarray(drawn["width"] ** 2))
        np.testing.assert_allclose(at_edge, drawn["speed"] / 2, rtol=1e-5)
    assert tab.run("jaxdrones.player.actors.jets.mesh.count") == 0
    tab.press("d")
    tab.run("jaxdrones.player.draw(0)")
    jets = "jaxdrones.player.actors.jets.mesh"
    cone = np.reshape(tab.run(f"[...{jets}.geometry.attributes.position.array.slice(0, 3 * {jets}.vertices)]"), (-1, 3))
    length = np.sqrt(2) * float(jd.load_params("cf2x").arm)
    np.testing.assert_allclose(np.hypot(cone[:, 0], cone[:, 1]), 0.07668 * (1 - cone[:, 2] + 5.817 * length), rtol=1e-3)


@pytest.mark.parametrize("size", [(390, 844), (880, 600), (1400, 900)])
def test_no_text_covers_another(view, size):
    pos = np.stack([0.02 * np.arange(6.0), np.zeros(6), np.ones(6)], axis=-1)  # closer than their names are long
    tab = view(page_of(pos, title="Six drones side by side"), size)
    boxes = np.array(tab.run(BOXES))
    assert len(boxes) >= 10
    for i, (left, right, top, bottom) in enumerate(boxes):
        others = np.delete(boxes, i, axis=0)
        covers = (others[:, 0] < right) & (others[:, 1] > left) & (others[:, 2] < bottom) & (others[:, 3] > top)
        assert not covers.any()


def test_names_find_places_wherever_their_drones_are(view):
    tab = view(page_of(np.stack([np.arange(12.0), np.zeros(12), np.ones(12)], axis=-1)))
    boxes = """(() => {
        const { names } = jaxdrones.player, random = (k) => Math.sin(k * k), found = [];
        const pixels = ({ style }) => style.transform.match(/-?[\\d.]+/g).slice(0, 2).map(Number);
        const place = ({ element, width }) => [...pixels(element), width];
        for (let seed = 0; seed < 1000; seed++) {
            names.place(({ drone }) => [300 + 90 * random(seed + drone), 70 * random(seed + drone + 100)]);
            found.push(names.labels.map(place));
        }
        return found;
    })()"""
    for x, y, width in np.array(tab.run(boxes)).transpose(0, 2, 1):
        beside = np.abs(x[:, None] - x) >= (width[:, None] + width) / 2
        above = np.abs(y[:, None] - y) >= 18
        assert (beside | above | np.eye(12, dtype=bool)).all()


def test_names_of_drones_in_the_picture_stay_in_it_and_leave_the_title_free(view):
    tab = view(page_of([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [2.0, 0.0, 1.0]], title="A title of some words"))
    places = "[[2, 3], [60, 20], [1095, 6]]"
    tab.run(f"jaxdrones.player.names.place(({{ drone }}) => {places}[drone])")
    boxes = np.array(tab.run(BOXES))[:5]  # title, legend, names
    assert (boxes[:, 0] >= 0).all() and (boxes[:, 1] <= 1100).all() and (boxes[:, 2] >= 0).all()
    for i, (left, right, top, bottom) in enumerate(boxes):
        others = np.delete(boxes, i, axis=0)
        covers = (others[:, 0] < right) & (others[:, 1] > left) & (others[:, 2] < bottom) & (others[:, 3] > top)
        assert not covers.any()


def test_a_flight_far_above_the_ground_fills_the_picture(view):
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    tab = view(page_of(np.stack([np.cos(angles), np.sin(angles), 0 * angles + 1.5], axis=-1)), (640, 360))
    tab.run("jaxdrones.film('orbit', 1)")
    tab.run("jaxdrones.frameAt(0.1, 0)")
    seen = np.concatenate([tab.run(f"{SEEN}({drone})") for drone in range(8)])
    assert np.ptp(seen[:, 0]) > 0.4 * 640 and 0.3 * 360 < seen[:, 1].mean() < 0.7 * 360


def test_a_target_is_as_large_as_its_drone_would_be_there_and_is_seen_behind_obstacles(view):
    trunk = Scene.of(Cylinder(pos=(9.5, 0.0, 1.0), radius=0.2, height=2.0))
    flight = jax.tree.map(lambda x: jnp.stack([x] * 3), jd.State.at_rest(jnp.array([[0.0, 0.0, 1.0]])))
    page = show(flight, jd.repeat(jd.load_params("cf2x"), 1), dt=0.1, targets=np.array([[10.0, 0.0, 1.0]]), scene=trunk)
    tab = view(page)
    arrows, point = "jaxdrones.player.actors.arrows[0]", "jaxdrones.player.stage.orbit.target.clone().set(10, 0, 1)"
    for name in ("targets", "insides"):
        drawn = np.reshape(tab.run(f"[...{arrows}.{name}.mesh.instanceMatrix.array]"), (4, 4))
        np.testing.assert_allclose(drawn[3, :3], [10, 0, 1], atol=1e-4)
        scale = tab.run(f"jaxdrones.player.actors.fleet.scale(0, {point})")
        assert drawn[0, 0] == pytest.approx(0.55 * scale * float(jd.load_params("cf2x").arm), rel=1e-3)
    assert tab.run(f"{arrows}.insides.mesh.material.depthTest") is False
    assert "◇ target" in tab.run("document.getElementById('legend').textContent")


def test_a_drone_behind_an_obstacle_shines_through_and_one_in_front_of_it_looks_as_always(view):
    def blue(trunk):
        """Share of the pixels at the drone, which is blue, that are blue."""
        tab = view(page_of([[0.0, 0.0, 1.0]], scene=Scene.of(Cylinder(pos=trunk, radius=0.06, height=4.0))))
        tab.run("jaxdrones.player.stage.setSharp(true); jaxdrones.player.draw(0); new Promise(requestAnimationFrame)")
        with Image.open(io.BytesIO(tab.screenshot())) as image:
            picture = np.asarray(image.convert("RGB"), float)
        drawn = np.array(tab.run(f"{SEEN}(0)"))
        (left, top), (right, bottom) = drawn.min(axis=0).astype(int), drawn.max(axis=0).astype(int)
        red, _, blue = np.moveaxis(picture[top:bottom, left:right], -1, 0)
        return np.mean(blue > red + 10)

    free, behind, in_front = blue((9.0, 0.0, 2.0)), blue((-0.1, -0.11, 2.0)), blue((0.1, 0.11, 2.0))
    assert behind > 0.3 * free
    assert abs(in_front - free) < 0.1


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_texts_stand_out_from_the_page(view, scheme):
    tab = view(page_of([[0.0, 0.0, 1.0]]))
    tab.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
    tab.call("Page.reload")
    tab.wait(
        f"document.documentElement?.dataset.theme === '{scheme}' && document.documentElement.dataset.ready === 'true'"
    )

    def luminance(script):
        channels = np.array(tab.run(f"{script}.match(/\\d+/g).slice(0, 3).map(Number)")) / 255
        return float(
            np.array([0.2126, 0.7152, 0.0722])
            @ np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
        )

    paper = luminance("getComputedStyle(document.body).backgroundColor")
    for selector in ("body", "#legend", ".plot output"):
        text = luminance(f"getComputedStyle(document.querySelector('{selector}')).color")
        contrast = (max(text, paper) + 0.05) / (min(text, paper) + 0.05)
        assert contrast >= 4.5  # WCAG 2.2, AA


def test_the_error_between_two_flights_is_a_ribbon_from_one_to_the_other(view):
    here, there = (at_rest([[x, 0.0, 1.0], [x, 1.0, 1.0]]) for x in (0.0, 0.2))
    tab = view(show([here, there], jd.repeat(jd.load_params("cf2x"), 2), dt=0.1))
    ribbon = "jaxdrones.player.actors.ribbon.mesh"
    assert not tab.run(f"{ribbon}.visible")
    tab.press("e")
    tab.run("jaxdrones.positionsAt(0.3)")
    assert tab.run(f"{ribbon}.visible && {ribbon}.geometry.drawRange.count") == 6 * 2 * 2  # two legs of two drones
    assert "20 cm between the two flights" in tab.run("document.getElementById('legend').textContent")
    points = np.reshape(tab.run(f"[...{ribbon}.geometry.attributes.position.array]"), (3, 2, 2, 3))
    expected = np.stack([here.pos, there.pos], axis=2)  # rows, drones, flights
    np.testing.assert_allclose(points, expected, atol=1e-4)
    tab.press("g")  # side by side
    tab.run("jaxdrones.player.draw(0)")
    assert not tab.run(f"{ribbon}.visible")
    alone = view(page_of([[0.0, 0.0, 1.0]]))
    assert alone.run("document.querySelector('.error').hidden")


def test_vectors_along_a_path_are_arrows_whose_lengths_are_in_proportion(view):
    flight = at_rest([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
    vectors = np.zeros((3, 2, 3))
    vectors[:, 0], vectors[:, 1] = [0.0, 0.0, 2.0], [0.5, 0.0, 0.0]
    tab = view(show(flight, jd.repeat(jd.load_params("cf2x"), 2), dt=0.1, arrows=vectors))
    matrices = np.reshape(
        tab.run("[...jaxdrones.player.actors.vectors[0].marks.mesh.instanceMatrix.array]"), (3, 2, 4, 4)
    )
    longest = 0.35 * tab.run("jaxdrones.player.stage.radius")
    np.testing.assert_allclose(matrices[..., 3, :3], flight.pos, atol=1e-4)
    np.testing.assert_allclose(matrices[:, 0, 2, :3], [[0, 0, longest]] * 3, atol=1e-5)  # along +z
    np.testing.assert_allclose(matrices[:, 1, 2, :3], [[longest / 4, 0, 0]] * 3, atol=1e-5)
    assert "vectors along the path" in tab.run("document.getElementById('legend').textContent")
    with pytest.raises(ValueError, match=r"arrows have shape \(2, 3\)"):
        show(flight, jd.repeat(jd.load_params("cf2x"), 2), dt=0.1, arrows=np.zeros((2, 3)))


def test_a_load_hangs_where_the_log_says_and_a_contact_force_carries_a_drone(view):
    params = jd.repeat(jd.load_params("cf2x"), 2)
    low = float(rim(jd.load_params("cf2x"))[0] - params.collision_offset[0])
    state = at_rest([[0.0, 0.0, low], [1.0, 0.0, 1.0]])
    load = state.pos + jnp.array([[[0.3, 0.0, -0.4]]])
    state = state.replace(aux={"payload": PointMass(load, state.vel)})
    tab = view(show(state, params, dt=0.1))
    tab.run("document.getElementById('wrench').click(); jaxdrones.player.draw(0)")
    matrices = "[...jaxdrones.player.actors.%s.mesh.instanceMatrix.array]"
    loads, cables, contacts = (
        np.reshape(tab.run(matrices % name), (2, 4, 4))
        for name in ("loads[0].loads", "loads[0].cables", "arrows[0].contact")
    )
    np.testing.assert_allclose(loads[:, 3, :3], load[0], atol=1e-4)
    np.testing.assert_allclose(cables[:, 2, :3], np.broadcast_to([0.3, 0.0, -0.4], (2, 3)), atol=1e-4)
    assert contacts[0, 2, 2] > 0 and not contacts[1].any(
        where=np.eye(4) < 1
    )  # upwards from the ground; none in the air
    assert "contact force" in tab.run("document.getElementById('legend').textContent")


def test_contact_forces_of_a_flight_that_is_running_are_shown_from_the_first_touch_on(view):
    tab = view(page_of([[0.0, 0.0, 1.0]]))
    row = "pos: Float32Array.of(0, 0, 0.02), vel: Float32Array.of(0, 0, 0), omega: Float32Array.of(0, 0, 0), "
    row += "quat: Float32Array.of(0, 0, 0, 1), rpm: Float32Array.of(0, 0, 0, 0)"
    for time, force in ((0.4, "null"), (0.5, "Float32Array.of(0, 0, 0.2)"), (0.6, "null")):
        tab.run(f"jaxdrones.player.append({{ t: Float32Array.of({time}), {row}, contacts: {force} }})")
    tab.press("r")
    arrow = "jaxdrones.player.draw(0), jaxdrones.player.actors.arrows[0].contact.mesh.instanceMatrix.array[10]"
    lengths = [tab.run(f"jaxdrones.player.seek({time}), {arrow}") for time in (0.15, 0.45, 0.55, 0.65)]
    assert [length > 0 for length in lengths] == [False, False, True, False]

"""The page in a real browser, drawn in software."""

import dataclasses
import io
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import jaxdrones as jd
from jaxdrones.flights.fly import fly
from jaxdrones.flights.log import ImageSequence
from jaxdrones.sensing import obstacles_2021
from jaxdrones.visualization import browser
from jaxdrones.visualization.films import film_page
from jaxdrones.visualization.overlay import Lens
from jaxdrones.visualization.shots import FIELD_OF_VIEW, shoot
from jaxdrones.visualization.viewer import show
from jaxdrones.visualization.viewer.live import Live

pytestmark = [pytest.mark.slow, pytest.mark.skipif(browser.find_browser() is None, reason="there is no Chromium")]


@pytest.fixture(scope="module")
def record():
    return fly("circle", drones=4, duration=2.0)


@pytest.fixture(scope="module")
def tab(record, tmp_path_factory):
    folder = tmp_path_factory.mktemp("browser")
    with browser.open_tab() as tab:
        tab.open(show(record, scene=obstacles_2021()).save(folder / "flight.html"))
        yield tab
        tab.run("1")  # what the console still has to say
        assert tab.problems == []


@pytest.mark.parametrize("row", [0, 1, 100, 239])
def test_the_scene_shows_the_drones_where_the_log_says(tab, record, row):
    positions = tab.run(f"jaxdrones.positionsAt({record.t[row]!s})")
    np.testing.assert_allclose(positions[0], record.pos[row], rtol=0, atol=1e-4)


def test_between_two_rows_the_drones_are_between(tab, record):
    time = (record.t[120] + record.t[121]) / 2
    positions = tab.run(f"jaxdrones.positionsAt({time!s})")
    np.testing.assert_allclose(positions[0], (record.pos[120] + record.pos[121]) / 2, rtol=0, atol=1e-4)


def test_the_view_is_not_blank(tab):
    tab.run("jaxdrones.positionsAt(1)")
    with Image.open(io.BytesIO(tab.screenshot())) as image:
        view = np.asarray(image.convert("RGB"))[:400]
    assert view.std() > 12
    assert len(np.unique(view.reshape(-1, 3), axis=0)) > 1000


CAMERA_PIXELS = """(() => {
    const shown = document.querySelector("#cameras canvas"), copy = document.createElement("canvas");
    [copy.width, copy.height] = [shown.width, shown.height];
    copy.getContext("2d").drawImage(shown, 0, 0);
    return [...copy.getContext("2d").getImageData(0, 0, copy.width, copy.height).data];
})()"""


def test_depth_is_yellow_where_it_is_near_and_darker_the_farther(record, tmp_path):
    depth = np.broadcast_to(np.array([[0.0, 1.0], [2.0, 4.0]], np.float32), (2, 4, 2, 2))
    images = {"depth": ImageSequence(np.array([0.0, 1.0]), depth)}
    with browser.open_tab() as tab:
        tab.open(show(dataclasses.replace(record, images=images)).save(tmp_path / "flight.html"))
        tab.run("jaxdrones.positionsAt(0)")
        shown = np.array(tab.run(CAMERA_PIXELS)).reshape(4, 4)[:, :3]
        np.testing.assert_array_equal(shown[[0, 3]], [[0xFD, 0xE7, 0x25], [0x44, 0x01, 0x54]])
        luminance = shown @ [0.2126, 0.7152, 0.0722]
        assert (np.diff(luminance) < -10).all()
        assert "0 (yellow) to 4 m" in tab.run("document.querySelector('#cameras figcaption').textContent")
        assert tab.problems == []


def test_images_of_the_cameras_are_shown_as_they_were_recorded(record, tmp_path):
    rgb = np.random.default_rng(0).integers(0, 256, (3, 4, 6, 8, 3), np.uint8)
    images = {"rgb": ImageSequence(np.array([0.0, 0.5, 1.0]), rgb)}
    with browser.open_tab() as tab:
        tab.open(show(dataclasses.replace(record, images=images)).save(tmp_path / "flight.html"))
        for time, frame in ((0.0, 0), (0.49, 0), (0.5, 1), (1.9, 2)):
            tab.run(f"jaxdrones.positionsAt({time})")
            shown = np.array(tab.run(CAMERA_PIXELS)).reshape(6, 8, 4)
            np.testing.assert_array_equal(shown[..., :3], rgb[frame, 0])
        tab.press("n")
        tab.run("jaxdrones.positionsAt(0)")
        np.testing.assert_array_equal(np.array(tab.run(CAMERA_PIXELS)).reshape(6, 8, 4)[..., :3], rgb[0, 1])
        assert tab.problems == []


@pytest.mark.needs("imageio_ffmpeg")
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # of imageio-ffmpeg's pipes
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_film_of_the_page_has_the_size_that_is_asked_for_and_moves(record, tmp_path):
    import imageio_ffmpeg

    assert film_page(show(record), tmp_path / "flight.mp4", fps=4, size=(320, 180)) == 8
    frames = imageio_ffmpeg.read_frames(str(tmp_path / "flight.mp4"))
    assert next(frames)["size"] == (320, 180)
    pictures = [np.frombuffer(frame, np.uint8).astype(int) for frame in frames]
    assert len(pictures) == 8 and pictures[0].std() > 10
    assert np.abs(pictures[7] - pictures[1]).max() > 60


def test_the_camera_of_a_film_sees_what_it_was_aimed_at(record, tmp_path):
    shot = shoot(record, 4, 16 / 9)
    at = "(x => jaxdrones.player.stage.project(jaxdrones.player.stage.orbit.target.clone().set(...x)))"
    with browser.open_tab() as tab:
        tab.open(show(record).save(tmp_path / "flight.html"), 1280, 720)
        tab.run(f"jaxdrones.film('orbit', {shot.scale})")
        tab.run(f"jaxdrones.frameAt(1, 0.25, {shot.eyes[4].tolist()}, {shot.targets[4].tolist()})")
        seen = [tab.run(f"{at}({pos.tolist()})") for pos in record.pos[shot.rows[4]]]
        assert tab.problems == []
    lens = Lens(shot.eyes[4], shot.targets[4], FIELD_OF_VIEW, (1280, 720))
    np.testing.assert_allclose(seen, lens.project(record.pos[shot.rows[4]])[0], atol=1)


def test_on_board_the_camera_looks_along_the_nose_and_does_not_see_its_own_drone(record, tmp_path):
    row, drone, (width, height) = 60, 2, (1280, 720)
    forward, left, up = np.asarray(jd.rotation.axes(jnp.asarray(record.quat[row, drone])))
    camera = "jaxdrones.player.stage.camera"
    with browser.open_tab() as tab:
        tab.open(show(record).save(tmp_path / "flight.html"), width, height)
        tab.run(f"jaxdrones.player.panel.set('drone', {drone})")
        tab.run("jaxdrones.player.panel.setMode('board')")
        for _ in range(2):  # also of the second picture of one moment
            tab.run(f"jaxdrones.positionsAt({record.t[row]})")
            eye = np.array(tab.run(f"{camera}.position.toArray()"))
            arm = float(jnp.linalg.norm(record.params.rotor_pos[drone, 0]))
            assert np.linalg.norm(eye - record.pos[row, drone]) < arm
            point = eye + 2 * forward + 0.3 * left + 0.2 * up
            seen = tab.run(f"jaxdrones.player.stage.project({camera}.position.clone().set(...{point.tolist()}))")
            shape = tab.run("[jaxdrones.player.stage.canvas.clientWidth, jaxdrones.player.stage.canvas.clientHeight]")
            focal = shape[1] / 2 / np.tan(np.radians(75) / 2)
            expected = np.array(shape) / 2 - focal * np.array([0.15, 0.1])
            np.testing.assert_allclose(seen, expected, atol=0.5)
        scale = "(mesh.matrices ?? mesh.instanceMatrix.array)[16 * place]"
        drawn = tab.run(f"jaxdrones.player.actors.fleet.slots[0].map(({{ mesh, place }}) => {scale})")
        assert [x != 0 for x in drawn] == [i != drone for i in range(4)]


def test_keys_play_pause_step_and_choose(tab):
    tab.run("jaxdrones.positionsAt(0.5)")
    tab.press("ArrowRight")
    assert tab.run("jaxdrones.player.time") == pytest.approx(0.5 + 1 / 120, abs=1e-5)
    tab.press("ArrowLeft", shift=True)
    assert tab.run("jaxdrones.player.time") == pytest.approx(0.5 - 9 / 120, abs=1e-5)
    tab.press(" ")
    tab.wait("jaxdrones.player.time > 0.6")
    tab.press(" ")
    time = tab.run("jaxdrones.player.time")
    assert tab.run("new Promise((done) => setTimeout(() => done(jaxdrones.player.time), 200))") == time
    for key, mode in (("2", "follow"), ("3", "board"), ("1", "orbit")):
        tab.press(key)
        assert tab.run("jaxdrones.player.stage.mode") == mode
    tab.press("n")
    assert tab.run("document.getElementById('drone').value") == "1"
    tab.press("End")
    assert tab.run("jaxdrones.player.time") == pytest.approx(2.0)


def test_everything_that_can_be_used_has_a_name_for_screen_readers(tab):
    tree = tab.call("Accessibility.getFullAXTree")["nodes"]
    used = {"button", "slider", "combobox", "checkbox", "image", "img", "dialog", "toolbar", "group", "region"}
    nodes = [node for node in tree if not node["ignored"] and node["role"]["value"] in used]
    assert [node["role"]["value"] for node in nodes if not node.get("name", {}).get("value")] == []
    names = {node["name"]["value"] for node in nodes}
    assert {"Play", "Time in seconds", "Follow", "Drone", "Three-dimensional view of the flight"} <= names


def test_worlds_are_ghosts_or_side_by_side(record, tmp_path):
    flights = {"pid": record, "again": fly("circle", drones=4, duration=1.0, seed=1)}
    with browser.open_tab() as tab:
        tab.open(show(flights, others="side by side").save(tmp_path / "two.html"))
        positions = tab.run("jaxdrones.positionsAt(0.5)")
        row = int(np.abs(record.t - 0.5).argmin())
        for flown, seen in zip(flights.values(), positions, strict=True):
            np.testing.assert_allclose(seen, flown.pos[row], rtol=0, atol=1e-4)
        tab.press("g")  # hidden
        assert tab.run("jaxdrones.positionsAt(0.5)")[1] == [None] * 4
        tab.press("g")  # ghosts
        assert np.shape(tab.run("jaxdrones.positionsAt(0.5)")[1]) == (4, 3)
        assert tab.problems == []


def test_the_page_follows_a_running_flight_and_holds_what_was_logged():
    flown = []
    with browser.open_tab() as tab:
        with Live() as live:
            pilot = threading.Thread(
                target=lambda: flown.append(fly("circle", drones=4, duration=8.0, watch=live.add)), daemon=True
            )
            pilot.start()
            tab.open(live.url)
            tab.wait("jaxdrones.player.time > 1")
            assert tab.run("jaxdrones.player.following && !document.getElementById('live').hidden")
            tab.press("Home")  # a user who looks at the start is left alone
            tab.wait("jaxdrones.player.end > 3 && jaxdrones.player.playing")
            assert not tab.run("jaxdrones.player.following")
            tab.press("End")
            assert tab.run("jaxdrones.player.following")
            pilot.join(60)
        tab.wait("!jaxdrones.player.running")
        (record,) = flown
        for row in (0, 1, 400, len(record.t) - 1):
            positions = tab.run(f"jaxdrones.positionsAt({record.t[row]!s})")
            np.testing.assert_allclose(positions[0], record.pos[row], rtol=0, atol=1e-4)
        assert tab.run("document.getElementById('live').hidden")
        assert tab.run("jaxdrones.player.actors.trails[0].legs") == len(record.t) - 1
        tab.press(" ")  # what was flown is played again, without the server
        tab.wait("jaxdrones.player.playing")
        assert tab.problems == []


def test_the_page_shows_every_new_policy_of_a_training(record):
    later = fly("circle", drones=4, duration=1.0, seed=1)
    with browser.open_tab() as tab, Live() as live:
        live.show(record, "update 1", [(1, 0.25)])
        tab.open(live.url)
        live.show(later, "update 2", [(1, 0.25), (2, 0.75)])
        tab.wait("document.title === 'update 2'")
        positions = tab.run(f"jaxdrones.positionsAt({later.t[60]!s})")
        np.testing.assert_allclose(positions[0], later.pos[60], rtol=0, atol=1e-4)
        curve = tab.run("document.querySelector('#curve svg').getAttribute('aria-label')")
        assert curve == "Learning curve: success 75 % after update 2"
        assert tab.problems == []


def test_drones_of_a_few_pixels_are_where_the_log_says(tmp_path):
    side = 0.5 * np.stack(np.meshgrid(np.arange(15.0), np.arange(20.0)), axis=-1).reshape(-1, 2)
    pos = np.broadcast_to(np.concatenate([side, np.ones((300, 1))], axis=1), (30, 300, 3))
    pos = pos + np.sin(np.arange(30.0))[:, None, None]
    rest = jax.vmap(jd.State.at_rest)(jnp.asarray(pos, jnp.float32))
    page = show(rest, jd.repeat(jd.load_params("cf2x"), 300), dt=0.1)
    vertices = """(() => {
        const fleet = jaxdrones.player.actors.fleet, slot = fleet.slots[0][7], count = 3 * slot.mesh.vertices;
        return [...slot.mesh.geometry.attributes.position.array.slice(slot.place * count, (slot.place + 1) * count)];
    })()"""
    with browser.open_tab() as tab:
        tab.open(page.save(tmp_path / "flight.html"))
        for share in (1.0, 0.25):  # of the resolution: drones with more detail, and with less
            tab.run(f"jaxdrones.player.stage.setSharp(false); jaxdrones.player.stage.share = {share}")
            seen = tab.run("jaxdrones.positionsAt(2.0)")[0]
            np.testing.assert_allclose(seen, pos[19], rtol=0, atol=1e-4)
        drawn = np.reshape(tab.run(vertices), (-1, 3))
        reach = tab.run("jaxdrones.player.actors.fleet.largest * jaxdrones.player.arm")
        assert np.abs(drawn - pos[19, 7]).max() < 1.5 * reach
        np.testing.assert_allclose(drawn[:, :2].mean(axis=0), pos[19, 7, :2], atol=1e-3)
        assert tab.problems == []


def test_the_curve_of_an_untrained_policy_is_a_point(record):
    """The first evaluation of a training is at update 0, of which a share of the way was not a number."""
    with Live(wait=0) as live, browser.open_tab() as tab:
        live.show(record, "training", [(0, 0.25)])
        tab.open(live.url)
        assert tab.run("[...document.querySelectorAll('#curve circle')].map((x) => x.getAttribute('cx'))") == ["6"]
        assert tab.problems == []


def test_plots_of_a_long_flight_show_a_peak_of_one_row(record, tmp_path):
    rows = 30_011
    row = np.minimum(np.arange(rows), len(record.t) - 1)
    names = ("pos", "quat", "vel", "omega", "rpm", "target_pos", "target_vel")
    arrays = {name: getattr(record, name)[row] for name in names}
    arrays["rpm"][12_345, 0, 2] = 50_000.0
    long = dataclasses.replace(record, t=np.arange(1, rows + 1) / 100, load_pos=np.asarray(np.nan), **arrays)
    with browser.open_tab() as tab:
        tab.open(show(long).save(tmp_path / "long.html"))
        plots = "jaxdrones.player.plots.flatMap((plot) => plot.curves(500))"
        assert tab.run(f"Math.max(...{plots}.flatMap((curve) => curve.y))") == pytest.approx(50_000, rel=1e-3)
        assert tab.problems == []

"""Films are of the size and length that was asked for and show drones, trails, targets, shadows and a clock."""

import dataclasses
import itertools

import numpy as np
import pytest

pytest.importorskip("PIL")

from jaxdrones.errors import UserError
from jaxdrones.sensing import Box, Scene
from jaxdrones.visualization import drawn_film, films, shots, video
from jaxdrones.visualization.overlay import Lens, Overlay
from jaxdrones.visualization.palette import as_rgb, colors

SIZE = (640, 360)
FPS = 2


@pytest.fixture(scope="module")
def record(part_of_circle):
    return part_of_circle(drones=4, seconds=3.0)


@pytest.fixture(scope="module")
def film(record):
    return list(drawn_film.frames(record, "a title", FPS, SIZE))


@pytest.fixture(scope="module")
def lens(record):
    shot = shots.shoot(record, FPS, SIZE[0] / SIZE[1])  # of a camera that stands still
    return Lens(shot.eyes[0], shot.targets[0], shots.FIELD_OF_VIEW, SIZE)


def row_at(record, k):
    return shots.rows_of_frames(record, FPS)[k]


def patch(frame, pixel, half=9):
    x, y = np.round(pixel).astype(int)
    return frame[max(0, y - half) : y + half, max(0, x - half) : x + half].reshape(-1, 3).astype(float)


def hue(rgb):
    """Direction of a color away from gray, of length 1."""
    away = rgb - rgb.mean(axis=-1, keepdims=True)
    return away / np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-9)


def share_of(color, pixels):
    """Share of pixels that have the hue of a color and are no gray."""
    colorful = np.ptp(pixels, axis=-1) > 40
    return np.mean(colorful & (hue(pixels) @ hue(as_rgb(color).astype(float)) > 0.97))


@pytest.mark.slow
def test_every_drone_has_its_color_where_it_is(record, film, lens):
    for k in (0, 5):
        pixels, _ = lens.project(record.pos[row_at(record, k)])
        for i, color in enumerate(colors(4)):
            shares = [share_of(color, patch(film[k], pixel)) for pixel in pixels]
            assert np.argmax(shares) == i and shares[i] > 0.15


@pytest.mark.slow
def test_a_trail_is_where_the_drone_was_and_a_target_where_it_is(record, film, lens):
    row = row_at(record, 5)
    for i, color in enumerate(colors(4)):
        for point in (record.pos[row // 2, i], record.pos[row // 4, i]):
            assert share_of(color, patch(film[5], lens.project(point)[0], half=4)) > 0.1
        assert share_of(color, patch(film[5], lens.project(record.target_pos[row, i])[0], half=12)) > 0.02


@pytest.mark.slow
def test_an_obstacle_hides_the_trail_behind_it(record, lens):
    row = row_at(record, 5)
    bare = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    overlay = Overlay(dataclasses.replace(record, labels=("",) * 4), "", 1.0)
    nothing, wall = np.full(bare.shape[:2], 1e3), np.full(bare.shape[:2], 0.1)
    pixel = lens.project(record.pos[row // 2, 0])[0]
    assert patch(overlay.draw(bare, nothing, lens, row, 0.0), pixel, 2).max() > 100
    assert patch(overlay.draw(bare, wall, lens, row, 0.0), pixel, 2).max() == 0


def test_the_clock_goes(record, lens):
    overlay = Overlay(record, "", 1.0)
    bare, depth = np.zeros((SIZE[1], SIZE[0], 3), np.uint8), np.full((SIZE[1], SIZE[0]), 1e3)
    film = [overlay.draw(bare, depth, lens, 0, time) for time in (0.0, 0.5, 1.0)]
    corner = [frame[-50:, -130:].astype(int) for frame in film]
    assert all(np.abs(a - b).max() > 100 for a, b in itertools.pairwise(corner))


def test_trails_of_a_crowd_are_of_two_seconds(record):
    overlay = Overlay(record, "", 1.0)
    assert len(overlay._path(0, 300)) == 301
    overlay._colors = 7 * overlay._colors
    path = overlay._path(0, 300)
    np.testing.assert_array_equal(path[[0, -1]], record.pos[[60, 300], 0])  # of 120 rows a second


@pytest.mark.slow
def test_drones_cast_shadows_on_the_ground(record):
    """Where the shadow of a drone falls it is darker than in other frames, unless something is drawn over it."""
    size = (SIZE[0] // 2, SIZE[1] // 2)
    shot = shots.shoot(record, FPS, size[0] / size[1])
    film = list(drawn_film.frames(record, "", FPS, size))
    pos = record.pos[row_at(record, 5)]
    spots = pos - np.array(drawn_film.SUN) * pos[:, 2:] / drawn_film.SUN[2]
    lens = Lens(shot.eyes[0], shot.targets[0], shots.FIELD_OF_VIEW, size)
    pixels = np.round(lens.project(spots)[0]).astype(int)
    brightness = np.array([[frame[y, x].mean() for x, y in pixels] for frame in film])
    assert (brightness[5] < 0.8 * brightness.max(axis=0)).sum() >= 3


@pytest.mark.slow
@pytest.mark.needs("imageio_ffmpeg")
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # of imageio-ffmpeg's pipes
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_film_is_720p_and_has_a_frame_for_every_24th_of_a_second(record, tmp_path):
    import imageio_ffmpeg

    short = dataclasses.replace(record, t=record.t / 30)  # 0.1 s
    shares = []
    assert films.film(short, tmp_path / "film.mp4", "a title", "jax", on_frame=shares.append) == 2
    about = next(imageio_ffmpeg.read_frames(str(tmp_path / "film.mp4")))
    assert about["size"] == (1280, 720) and about["fps"] == 24
    assert shares == [0.5, 1.0]


def test_a_team_far_apart_is_drawn_larger_and_the_title_says_so(record):
    far = record.pos * [200, 200, 1] + [0, 0, 5]
    far = dataclasses.replace(record, pos=far, scene=Scene.of(Box(pos=(0.0, 0.0, 1.0), size=(1.0, 1.0, 1.0))))
    shot = shots.shoot(far, FPS, SIZE[0] / SIZE[1])
    assert shot.scale == 10
    assert "10 times as large" in Overlay(far, "", shot.scale)._title


def test_the_page_films_where_there_is_a_browser_and_jax_elsewhere(monkeypatch, tmp_path):
    monkeypatch.setattr(films, "find_browser", lambda: "/usr/bin/chromium")
    assert films.choose_renderer(None, tmp_path / "film.gif") == "page"
    monkeypatch.setattr(films, "find_browser", lambda: None)
    assert films.choose_renderer(None, tmp_path / "film.gif") == "jax"
    with pytest.raises(
        ValueError, match="there is no Chromium for --renderer page; install it, or take --renderer jax"
    ):
        films.choose_renderer("page", tmp_path / "film.gif")
    with pytest.raises(ValueError, match="unknown renderer 'pge'; did you mean 'page'"):
        films.choose_renderer("pge", tmp_path / "film.gif")


@pytest.mark.parametrize(
    ("fps", "says"), [(0, "fps is 0; give a whole"), (51, "a GIF has at most 50 frames per second, not 51")]
)
def test_frames_that_no_film_can_show_in_time_are_refused(fps, says, record, tmp_path):
    for make in (films.film, films.film_page):
        with pytest.raises(ValueError, match=says):
            make(record, tmp_path / "film.gif", *["title"] * (make is films.film), fps=fps)


@pytest.mark.parametrize("size", [(0, 0), (641, 360), (640,), ("a", 2)])
def test_a_film_has_an_even_number_of_pixels_along_each_side(size, record, tmp_path):
    for make in (films.film, films.film_page):
        with pytest.raises(UserError, match=r"size is .*; give width and height, two even numbers of pixels"):
            make(record, tmp_path / "film.gif", *["title"] * (make is films.film), size=size)


def test_a_page_is_filmed_by_a_camera_that_it_has(record, tmp_path):
    with pytest.raises(UserError, match="unknown camera 'folow'; did you mean 'follow'"):
        films.film_page(record, tmp_path / "film.gif", camera="folow")


GRAY = np.full((32, 48, 3), 128, np.uint8)


@pytest.mark.needs("imageio_ffmpeg")
@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_frames_of_a_script_become_a_film_in_a_new_folder(suffix, tmp_path):
    from PIL import Image

    path = tmp_path / "new" / f"film{suffix}"
    assert video.write((GRAY for _ in range(3)), str(path), fps=5) == 3
    assert path.stat().st_size > 100
    if suffix == ".gif":
        with Image.open(path) as picture:
            assert picture.n_frames * picture.info["duration"] == 600  # ms


def test_the_progress_of_a_film_is_the_share_of_its_frames(record, tmp_path, monkeypatch):
    monkeypatch.setattr(films, "_frames", lambda *_: (GRAY for _ in range(6)))
    shares = []
    films.film(record, str(tmp_path / "film.gif"), "a title", "jax", FPS, on_frame=shares.append)  # of 3 s
    assert shares == [(k + 1) / 6 for k in range(6)]


@pytest.mark.needs("imageio_ffmpeg")
@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
@pytest.mark.parametrize(
    ("frames", "says"),
    [
        ([], "there are no frames"),
        ([GRAY / 255], r"frame 0 is an array \(32, 48, 3\) of float64; give"),
        ([GRAY, GRAY[..., 0]], r"frame 1 is an array \(32, 48\) of uint8; give"),
        ([GRAY, GRAY[1:]], r"frame 1 has shape \(31, 48, 3\), the first \(32, 48, 3\)"),
    ],
)
def test_frames_that_make_no_film_are_refused_and_leave_no_file(frames, says, suffix, tmp_path):
    with pytest.raises(UserError, match=says):
        video.write(iter(frames), tmp_path / f"film{suffix}", fps=5)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "fps", "says"), [("a.avi", 5, "films end in"), ("a.gif", 0, "fps is 0")])
def test_a_film_of_another_format_or_of_no_rate_is_refused(name, fps, says, tmp_path):
    with pytest.raises(UserError, match=says):
        video.write([GRAY], tmp_path / name, fps=fps)

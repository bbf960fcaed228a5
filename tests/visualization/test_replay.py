"""Films and on-board pictures of recorded flights."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from helpers import mostly_slow
from matplotlib.image import imread
from PIL import Image

from jaxdrones.flights.fly import fly
from jaxdrones.visualization import films, replay, shots, video

imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
pytestmark = [  # imageio-ffmpeg leaves its pipes to the garbage collector
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture(scope="module")
def record(part_of_circle):
    return part_of_circle(drones=2, seconds=1.5)


def read(path) -> tuple[dict, list[np.ndarray]]:
    frames = imageio_ffmpeg.read_frames(str(path))
    about = next(frames)
    width, height = about["size"]
    return about, [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in frames]


@pytest.mark.slow
@pytest.mark.needs("pybullet")
def test_a_film_has_a_frame_for_every_24th_of_a_simulated_second_and_moves(record, tmp_path):
    assert films.film(record, tmp_path / "flight.mp4", "", "bullet", size=(640, 360)) == 36
    about, frames = read(tmp_path / "flight.mp4")
    assert about["fps"] == 24 and len(frames) == 36
    assert frames[0].std() > 10
    moved = np.abs(frames[-1].astype(int) - frames[12].astype(int)).max(axis=-1) > 60
    assert 20 < moved.sum() < 0.05 * moved.size  # the drones, not the camera


@pytest.mark.needs("pybullet")
@pytest.mark.slow
def test_a_film_may_be_a_gif(record, tmp_path):
    films.film(record, tmp_path / "flight.gif", "", "bullet", fps=8, size=(320, 180))
    with Image.open(tmp_path / "flight.gif") as picture:
        assert picture.n_frames == 12
        durations = [picture.seek(frame) or picture.info["duration"] for frame in range(12)]
    assert sum(durations) == 1500  # ms, in whole hundredths of a second


@pytest.mark.needs("pybullet")
@pytest.mark.parametrize("name", mostly_slow(["short.mp4", "short.gif", "-x:y %d.mp4"], ["-x:y %d.mp4"]))
def test_the_shortest_flight_is_one_frame_whatever_its_file_is_called(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert films.film(fly("circle", drones=2, duration=0.01), Path(name), "", "bullet", size=(320, 180)) == 1
    assert (tmp_path / name).stat().st_size > 100


@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e30])
def test_a_flight_that_breaks_is_filmed_until_then(wrong, record):
    pos = np.array(record.pos)
    pos[60:, 1] = wrong
    rows = shots.rows_of_frames(dataclasses.replace(record, pos=pos), fps=10)
    assert len(rows) == 15 and rows[-1] == 59
    with pytest.raises(ValueError, match="the film is not written: no state of the flight is finite"):
        shots.shoot(dataclasses.replace(record, pos=np.full_like(pos, wrong)), 10, 16 / 9)


@pytest.mark.needs("pybullet")
@pytest.mark.parametrize("fault", ["no file", "no film", "a folder"])
def test_a_film_that_ffmpeg_cannot_write_is_one_line_and_leaves_the_old_one(
    fault, record, tmp_path, monkeypatch, capfd
):
    film = tmp_path / "film.mp4"
    film.mkdir() if fault == "a folder" else film.write_bytes(b"old")
    counted = imageio_ffmpeg.count_frames_and_secs

    def count(new):
        if fault == "no file":
            new.unlink()
        elif fault == "no film":
            new.write_bytes(b"half")
        return counted(new)

    monkeypatch.setattr(imageio_ffmpeg, "count_frames_and_secs", count)
    with pytest.raises(OSError, match=r"film\.mp4 cannot be written, ffmpeg failed; is the disk full") as error:
        films.film(record, film, "", "bullet", fps=2, size=(320, 180))
    assert "\n" not in str(error.value) and capfd.readouterr().err == ""
    assert [file.name for file in tmp_path.iterdir()] == ["film.mp4"]
    assert fault == "a folder" or film.read_bytes() == b"old"


def test_frames_are_in_step_with_simulated_time(record):
    rows = shots.rows_of_frames(record, fps=10)
    assert len(rows) == 15
    late = dataclasses.replace(record, t=record.t + np.float64(1000.0))  # by the time of the day
    assert np.abs(shots.rows_of_frames(late, fps=10) - rows).max() <= 1
    assert [*rows[1:]] == [round(frame / 10 * 120) - 1 for frame in range(1, 15)]  # row k is at (k + 1) / 120 s


@pytest.mark.needs("pybullet")
def test_every_drone_leaves_its_pictures(record, tmp_path):
    """At the times of the log, also of one by the time of the day."""
    earlier = "drone 1/00099.png", "drone 5/00000.png"  # of a longer flight
    for name in *earlier, "drone 5/my.png", "mine/00000.png":
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    late = dataclasses.replace(record, t=record.t + np.float64(1000.0))
    images = replay.save_cameras(late, tmp_path, fps=4)
    assert images.frames.shape == (6, 2, 48, 64, 4)
    np.testing.assert_allclose(images.t, late.t[0] + 0.25 * np.arange(6), rtol=1e-12)
    pictures = sorted((tmp_path / "drone 1").glob("*.png"))
    assert len(pictures) == 6 and imread(pictures[0]).shape == (48, 64, 4)
    assert [file.name for folder in ("drone 5", "mine") for file in (tmp_path / folder).iterdir()] == [
        "my.png",
        "00000.png",
    ]


def test_an_unknown_kind_of_film_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"flight\.avi: films end in \.mp4 or \.gif"):
        video.check_video(tmp_path / "flight.avi")
    video.check_video(tmp_path / "flight.gif", 50)


def test_without_ffmpeg_the_error_names_the_extra(monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    with pytest.raises(ValueError, match=r'imageio_ffmpeg is not installed.*pip install ".*\[video\]"'):
        video.check_video(tmp_path / "flight.mp4")

"""What a viewer hears of a running flight is what is flown; viewers come, go and stay away."""

import dataclasses
import threading
import time
import urllib.request

import numpy as np
import pytest
from live_viewer import Viewer, parts, play, same

from jaxdrones.flights.fly import fly
from jaxdrones.visualization.viewer import live as module
from jaxdrones.visualization.viewer.live import Live


@pytest.mark.slow
def test_two_viewers_hear_the_flight_as_it_is_logged(record):
    with Live() as live:
        viewers = [Viewer(live), Viewer(live)]
        flown = fly("circle", drones=2, duration=0.5, watch=live.add)
    for viewer in viewers:
        same(viewer.flight(), flown)
        assert len(viewer.heard) > 3
        assert viewer.header["live"] == {"rows": len(flown.t), "end": pytest.approx(0.5), "running": True}
    np.testing.assert_allclose(flown.pos, record.pos, rtol=0, atol=1e-5)
    for name in ("t", "target_pos", "labels"):
        np.testing.assert_array_equal(getattr(flown, name), getattr(record, name))


def test_a_viewer_that_comes_late_hears_the_flight_from_its_start(record):
    with Live(wait=0.0) as live:
        play(live, record)
        viewer = Viewer(live)
        while not viewer.heard:
            time.sleep(0.01)
    same(viewer.flight(), record)
    assert [event for event, _ in viewer.heard] == ["begin", "end"]


def test_a_flight_that_is_watched_is_no_faster_than_real_time(record):
    with Live() as live:
        viewer, start = Viewer(live), time.monotonic()
        play(live, record)
        assert time.monotonic() - start >= 0.49
    same(viewer.flight(), record)


def test_without_a_viewer_the_flight_waits_for_a_while_and_goes_on(record):
    lines = []
    with Live(wait=0.1, say=lines.append) as live:
        play(live, record)
    assert lines == ["waiting for a viewer, 0.1 s at most", "no viewer came; the flight continues without one"]


def test_when_the_viewer_leaves_the_flight_goes_on_without_waiting(record, monkeypatch):
    monkeypatch.setattr(module, "_RELOADING", 0.05)
    slow, lines = dataclasses.replace(record, t=1000 * record.t), []  # ten minutes
    with Live(say=lines.append) as live:
        flight = parts(slow)
        pilot = threading.Thread(target=lambda: [live.add(part, float(slow.t[-1])) for part in flight], daemon=True)
        viewer = Viewer(live, events=1)
        pilot.start()
        viewer.join(20)
        pilot.join(20)
        assert not pilot.is_alive() and live.viewers == 0
    assert lines[-1] == "the viewer has left; the flight continues without one"


def test_a_page_that_is_loaded_again_sees_the_rest_in_real_time(record):
    with Live() as live:
        first = Viewer(live, events=1)
        pilot = threading.Thread(target=play, args=(live, record), daemon=True)
        pilot.start()
        first.join(20)
        second = Viewer(live)
        pilot.join(20)
    same(second.flight(), record)


def test_another_flight_begins_anew_and_a_whole_one_is_shown_with_its_learning_curve(record):
    with Live() as live:
        viewer = Viewer(live)
        play(live, record)
        play(live, record)
        live.show(record, "update 2", [(1, 0.0), (2, 0.5)])
        while not viewer.heard or viewer.header["title"] != "update 2":
            time.sleep(0.01)
    viewer.join(20)
    assert [event for event, _ in viewer.heard].count("begin") == 3
    assert viewer.header["live"]["running"] is False
    assert viewer.header["live"]["curve"] == {"label": "success", "points": [[1, 0.0], [2, 0.5]]}
    np.testing.assert_allclose(viewer.header["worlds"][0]["pos"], record.pos, rtol=0, atol=1e-4)


def test_a_flight_that_is_interrupted_ends_the_stream_and_the_server(record, capsys):
    with pytest.raises(KeyboardInterrupt), Live() as live:
        viewer = Viewer(live)
        for part in parts(record):
            live.add(part, 0.5)
            raise KeyboardInterrupt
    viewer.join(20)
    assert [event for event, _ in viewer.heard] == ["begin", "end"]
    with pytest.raises(OSError):
        urllib.request.urlopen(live.url, timeout=5)


def test_more_than_a_browser_plays_is_refused(record):
    with Live(wait=0.0) as live, pytest.raises(ValueError, match="more than a page plays"):
        live.add(next(parts(record)), 1e5)


def test_a_viewer_hears_of_contacts_while_they_last(record):
    weight = float(record.params.mass[0] * record.params.gravity[0])
    lying = dataclasses.replace(
        record, pos=record.pos * [1, 1, 0], vel=0 * record.vel, rpm=0 * record.rpm, quat=0 * record.quat + [0, 0, 0, 1]
    )
    with Live() as live:
        viewer = Viewer(live)
        play(live, lying)
    viewer.join(20)
    contacts = [data["rows"]["contacts"] for event, data in viewer.heard if event == "rows"]
    assert contacts
    for forces in contacts:
        np.testing.assert_allclose(forces, np.broadcast_to([0, 0, weight], forces.shape), rtol=1e-3)

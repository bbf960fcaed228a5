"""What the page holds of a flight is what was flown."""

import base64
import dataclasses
import hashlib
import json
import re
import shutil
import subprocess
from html import unescape
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from documents import ROOT
from helpers import flying
from live_viewer import same
from viewer_payload import decode

import jaxdrones as jd
from jaxdrones.cli import main
from jaxdrones.dynamics.model import PointMass
from jaxdrones.flights import read_log, save_npz
from jaxdrones.flights.fly import fly
from jaxdrones.flights.log import ImageSequence
from jaxdrones.sensing import Box, Capsule, Cylinder, Scene, Sphere
from jaxdrones.visualization.viewer import payload, show
from jaxdrones.visualization.viewer.show import records_of, show_history

ARRAYS = ("pos", "quat", "vel", "omega", "rpm")
SCENE = Scene.of(
    Box(pos=(1.0, 0.0, 0.5), size=(0.2, 1.0, 1.0), quat=(0.0, 0.0, 0.6, 0.8), color=(0.9, 0.3, 0.1, 1.0)),
    Sphere(pos=(0.0, 1.0, 0.5), radius=0.25),
    Cylinder(pos=(-1.0, 0.0, 0.75), radius=0.1, height=1.5),
    Capsule(pos=(0.0, -1.0, 0.5), radius=0.1, height=0.5, quat=(0.6, 0.0, 0.0, 0.8)),
    ground=False,
)


@pytest.fixture(scope="module")
def team():
    return jd.repeat(jd.load_params("cf2x"), 3)


def trajectory(params, steps=20, seed=0, spread=0.1):
    """States of a team on straight lines, by no law of physics."""
    state = flying(params, seed)
    times = spread * jnp.arange(float(steps))
    path = jax.vmap(lambda t: state.replace(pos=state.pos + t * state.vel))(times)
    return jax.tree.map(np.asarray, path)


def header(page):
    return decode(page.payload)


def test_positions_in_the_page_equal_the_record_to_a_tenth_of_a_millimetre(record):
    same(header(show(record))["worlds"][0], record)


def test_a_log_by_the_time_of_the_day_begins_at_zero(record):
    """Float32 has steps of 128 s at the seconds since 1970."""
    late = dataclasses.replace(record, t=record.t + 1.7e9)
    np.testing.assert_allclose(header(show(late))["worlds"][0]["t"], record.t - record.t[0], atol=1e-6)


def test_the_thrust_in_the_page_is_that_in_the_air_of_the_flight(record):
    thin = dataclasses.replace(record, params=record.params.replace(air_density=0.5 * record.params.air_density))
    kf, in_thin_air = (header(show(x))["vehicles"][0]["kf"] for x in (record, thin))
    assert in_thin_air == pytest.approx(0.5 * kf)


@pytest.mark.parametrize("extent", [1e-3, 1.0, 6.0, 7.0, 400.0])
def test_positions_are_as_exact_in_small_and_large_flights(team, extent):
    path = trajectory(team)
    path = path.replace(pos=extent * (path.pos - path.pos.min()) / np.ptp(path.pos))
    world = header(show(path, team, dt=0.01))["worlds"][0]
    np.testing.assert_allclose(world["pos"], path.pos, rtol=0, atol=1e-4)


def test_a_drone_that_stands_still_or_breaks_is_in_the_page_as_it_is(team):
    path = trajectory(team)
    broken = np.array(path.pos)
    broken[:, 0] = 1.25
    broken[5:, 1] = np.nan
    broken[7:, 2] = -3e38
    world = header(show(path.replace(pos=broken), team, dt=0.01))["worlds"][0]
    np.testing.assert_allclose(world["pos"], broken, rtol=1e-6)


def test_a_trajectory_of_worlds_is_as_many_worlds(team):
    paths = jax.tree.map(lambda *x: np.stack(x), *(trajectory(team, seed=seed) for seed in range(3)))
    worlds = header(show(paths, team, dt=0.01))["worlds"]
    assert [world["name"] for world in worlds] == ["world 0", "world 1", "world 2"]
    for w, world in enumerate(worlds):
        np.testing.assert_allclose(world["pos"], paths.pos[w], rtol=0, atol=1e-4)
        np.testing.assert_allclose(world["t"], 0.01 * np.arange(1, 1 + len(paths.pos[w])), rtol=1e-6)  # after steps


@pytest.mark.slow
def test_worlds_may_have_vehicles_targets_and_lengths_of_their_own(team, record):
    heavy = jd.stack([jd.load_params("racer"), jd.load_params("cf2x"), jd.load_params("cf2x")])
    goals = np.arange(9.0).reshape(3, 3)
    one = show(trajectory(heavy, steps=5), heavy, dt=0.01, targets=goals)
    first = header(one)
    assert first["worlds"][0]["vehicle"] == [0, 1, 1]
    np.testing.assert_allclose(first["vehicles"][0]["rotor_pos"], heavy.rotor_pos[0])
    np.testing.assert_allclose(first["worlds"][0]["targets"], np.broadcast_to(goals, (5, 3, 3)), rtol=0, atol=1e-4)
    both = header(show({"short": record, "long": fly("circle", drones=1, duration=0.7)}))
    assert [(world["name"], len(world["t"])) for world in both["worlds"]] == [("short", 60), ("long", 84)]
    assert len(both["vehicles"]) == 1 and len(both["scenes"]) == 1


def test_every_obstacle_of_the_scene_is_in_the_page(record):
    scene = header(show(record, scene=SCENE))["scenes"][0]
    assert scene["ground"] is False
    assert [solid["kind"] for solid in scene["obstacles"]] == ["Box", "Sphere", "Cylinder", "Capsule"]
    for entry, solid in zip(scene["obstacles"], SCENE.obstacles, strict=True):
        for name in entry.keys() - {"kind"}:
            np.testing.assert_allclose(entry[name], getattr(solid, name), rtol=1e-6)


def test_obstacles_that_are_not_active_are_not_in_the_page(record):
    scene = Scene.of(Sphere(pos=np.zeros((3, 3)), radius=0.1, active=[True, False, True]))
    assert len(header(show(record, scene=scene))["scenes"][0]["obstacles"]) == 2


def test_a_log_shows_what_its_record_shows(record, tmp_path):
    record = dataclasses.replace(record, scene=SCENE)
    save_npz(record, tmp_path / "log.npz")
    assert show(tmp_path, title="").payload == show(str(tmp_path / "log.npz"), title="").payload
    assert header(show(tmp_path, title="")) | {"worlds": []} == header(show(record, title="")) | {"worlds": []}
    loaded = read_log(tmp_path / "log.npz")
    for name in (*ARRAYS, "t", "rpy", "target_pos", "labels"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(record, name))
    for ours, theirs in zip(jax.tree.leaves(loaded.params), jax.tree.leaves(record.params), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert jax.tree.structure(loaded.scene) == jax.tree.structure(record.scene.replace(**_active(record.scene)))


def _active(scene):
    """A scene that was read says of all its obstacles that they are there, or of none."""
    return {name: getattr(scene, name) for name in ("boxes", "spheres", "cylinders", "capsules")}


def test_a_notebook_shows_the_same_page_in_a_frame_without_rights(record):
    page = show(record, title="<b> & 'quotes'", height=321)
    frame = page._repr_html_()
    assert unescape(re.search(r'srcdoc="([^"]*)"', frame)[1]) == page.html
    assert 'sandbox="allow-scripts"' in frame and "height: 321px" in frame
    assert "<title>&lt;b&gt; &amp;" in page.html


def test_the_page_asks_nothing_of_the_network_and_carries_its_licence(record):
    page = show(record).html.replace(show(record).payload, "")
    outside = {"http://www.w3.org/1999/xhtml", "http://www.w3.org/2000/svg"}  # names, not addresses
    assert set(re.findall(r"https?://[\w./-]+", page)) <= outside | set(
        re.findall(r"https?://[\w./-]+", page.split("<html")[0])
    )
    assert not re.search(r"""(?:src|href)=["'](?!data:)""", page.split("<script", 1)[0])
    assert "Permission is hereby granted, free of charge" in page and "three.js authors" in page
    assert len(page) < 1.5e6


def test_the_page_was_built_from_its_sources():
    folder = ROOT / "viewer"
    files = [*sorted((folder / "src").iterdir()), folder / "build.mjs", folder / "package.json"]
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    path = ROOT / "jaxdrones" / "visualization" / "viewer" / "page.html"
    if not path.exists():
        pytest.skip("the page is not built: there is no npm")
    built = path.read_text()
    assert f"sources sha256 {digest}" in built, "the sources of the viewer have changed; run `make viewer`"


@pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")
@pytest.mark.parametrize("rows", [1, 100, 401, 4_001, 100_003])
def test_plots_of_long_flights_show_every_short_peak(rows):
    """A peak of one row, up or down, is drawn wherever it is, and a curve is not drawn with more points than needed."""
    code = f"""
    import {{ extremes }} from {json.dumps((ROOT / "viewer" / "src" / "extremes.js").as_uri())};
    const rows = {rows}, found = [];
    for (const peak of [0, 0.333, 0.5, 0.7777, 0.99999].map((x) => Math.floor(x * rows))) {{
      for (const height of [-9, 9]) {{
        const values = Array.from({{ length: rows }}, (_, k) => Math.sin(k / 50));
        if (peak > 0) values[peak - 1] = NaN;
        if (peak + 1 < rows) values[peak + 1] = height > 0 ? Infinity : -Infinity;
        values[peak] = height;
        const drawn = extremes(rows, 100, (row) => values[row]);
        const sorted = drawn.every((x, k) => !k || x > drawn[k - 1]);
        found.push([drawn.includes(peak), drawn[0], drawn.at(-1), drawn.length, sorted]);
      }}
    }}
    console.log(JSON.stringify(found));
    """
    done = subprocess.run(["node", "--input-type=module", "-e", code], capture_output=True, text=True, check=True)
    for has_peak, first, last, count, is_sorted in json.loads(done.stdout):
        assert (has_peak, first, last, is_sorted) == (True, 0, rows - 1, True)
        assert count <= 400 and (count == rows or rows > 400)


@pytest.mark.parametrize(
    ("flight", "arguments", "message"),
    [
        (lambda path: path, {"dt": 0.01}, "params is left out; a trajectory needs params"),
        (lambda path: path, {"params": "team"}, "dt is left out; a trajectory needs dt"),
        (lambda path: path, {"params": "team", "dt": -1.0}, "dt"),
        (lambda path: path, {"params": "one", "dt": 0.01}, r"params are of a team of shape \(\)"),
        (lambda path: path, {"params": "team", "dt": 0.01, "targets": np.zeros((2, 3))}, "targets have shape"),
        (lambda path: path, {"params": "team", "dt": 0.01, "targets": np.inf}, "targets are not finite"),
        (lambda path: path, {"params": "team", "dt": 0.01, "targets": -1e300}, "too large for float32"),
        (lambda path: path, {"params": "team", "dt": 0.01, "labels": ["a"]}, "labels are 1 names"),
        (lambda path: path, {"params": "team", "dt": 0.01, "others": "ghost"}, "did you mean 'ghosts'"),
        (lambda path: jax.tree.map(lambda x: x[0], path), {"params": "team", "dt": 0.01}, r"shape \(3, 3\)"),
        (lambda path: 3, {}, "3 cannot be shown"),
        (lambda path: [], {}, "give at least one"),
        (lambda path: "nowhere/log.npz", {}, "nowhere/log.npz does not exist; fly first"),
        (lambda path: __file__, {}, r"is not an \.npz file"),
    ],
)
def test_a_mistake_is_one_line_that_says_what_to_do(team, flight, arguments, message):
    known = {"team": team, "one": jd.load_params("cf2x")}
    arguments = {
        name: known.get(value, value) if isinstance(value, str) else value for name, value in arguments.items()
    }
    with pytest.raises(ValueError, match=message) as error:
        show(flight(trajectory(team)), **arguments)
    assert "\n" not in str(error.value)


def test_an_argument_that_the_flight_knows_itself_is_refused(record):
    with pytest.raises(ValueError, match="dt is given beside a flight that has its own; leave it out"):
        show(record, dt=0.01)


def test_more_than_a_browser_plays_is_refused(team):
    path = jax.tree.map(lambda x: np.broadcast_to(x[0], (1_000_000, *x.shape[1:])), trajectory(team))
    with pytest.raises(ValueError, match="more than a page plays"):
        show(path, team, dt=0.01)


def test_the_payload_is_json_and_numbers_that_any_reader_finds(record):
    import zlib

    data = zlib.decompress(base64.b64decode(show(record).payload))
    entries = json.loads(data[4 : 4 + int.from_bytes(data[:4], "little")])
    assert entries["worlds"][0]["labels"] == ["drone 0", "drone 1"]
    assert entries["worlds"][0]["pos"]["shape"] == [60, 2, 3]


def test_images_of_the_cameras_are_in_the_log_and_in_the_page(team, record, tmp_path):
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (20, 3, 4, 6, 3), np.uint8)
    depth = np.where(rng.random((20, 3, 4, 6)) < 0.5, 2.0, np.inf)
    page = header(show(trajectory(team), team, dt=0.01, images={"rgb": rgb, "depth": depth}))
    colors, grey = page["worlds"][0]["images"]
    assert (colors["name"], grey["name"]) == ("rgb", "depth")
    np.testing.assert_array_equal(colors["frames"], rgb)
    np.testing.assert_array_equal(grey["frames"][..., 0], 0)  # what is farthest
    np.testing.assert_allclose(grey["t"], 0.01 * np.arange(1, 21), rtol=1e-6)
    images = {"rgb": ImageSequence(np.arange(3.0), rgb[:3, :2])}
    save_npz(dataclasses.replace(record, images=images), tmp_path / "log.npz")
    loaded = read_log(tmp_path / "log.npz").images["rgb"]
    np.testing.assert_array_equal(loaded.frames, images["rgb"].frames)
    np.testing.assert_array_equal(loaded.t, images["rgb"].t)
    with pytest.raises(ValueError, match=r"images 'depth' have shape .* of 20 times and 3 drones"):
        show(trajectory(team), team, dt=0.01, images={"depth": rgb})


def test_pixels_of_depth_are_of_its_share_of_the_farthest_up_to_ten_meters(team):
    depth = np.broadcast_to([[0.0, 2.5], [5.0, 1000.0]], (20, 3, 2, 2))
    (images,) = header(show(trajectory(team), team, dt=0.01, images={"depth": depth}))["worlds"][0]["images"]
    assert images["frames"][0, 0, ..., 0].tolist() == [[255, 191], [128, 0]] and images["farthest"] == 10


@pytest.mark.parametrize("option", [("--camera", "follow"), ("--size", "64x48"), ("--fps", "10")])
def test_an_option_of_a_film_is_refused_without_one(option, capsys):
    assert main(["view", "nowhere", *option]) == 2
    assert f"{' '.join(option)} is given without --video FILE; give both or none" in capsys.readouterr().err


@pytest.mark.needs("PIL")
@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--size", "0x0"], "--size is (0, 0); give width and height, two even numbers of pixels"),
        (["--fps", "60"], "a GIF has at most 50 frames per second, not 60"),
        ([], "there is no Chromium; install it"),
    ],
)
def test_a_film_that_cannot_be_is_refused_before_its_flight_is_read(arguments, says, capsys, monkeypatch):
    monkeypatch.setattr("jaxdrones.visualization.browser.find_browser", lambda: None)
    assert main(["view", "nowhere", "--video", "film.gif", *arguments]) == 2
    assert says in capsys.readouterr().err


def test_a_page_that_no_browser_opens_is_said(record, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("webbrowser.open", lambda url: False)
    save_npz(record, tmp_path / "log.npz")
    assert main(["view", str(tmp_path), "--open"]) == 0
    assert "no browser was found; open the page in one" in capsys.readouterr().err


def test_of_several_paths_those_that_are_no_flights_are_skipped_with_a_note(record, tmp_path, capsys):
    """As `runs/compare/*` holds a figure beside the logs; but not one that is not there, a damaged log, or all."""
    for name in "one", "other":
        (tmp_path / name).mkdir()
        save_npz(record, tmp_path / name / "log.npz")
    (tmp_path / "compare.png").write_bytes(b"\x89PNG")
    (tmp_path / "empty").mkdir()
    np.savez(tmp_path / "weights.npz", weights=np.zeros(3))
    page = ["--json", "--output", str(tmp_path / "page.html")]
    assert main(["view", *map(str, sorted(tmp_path.iterdir())), *page]) == 0
    told = capsys.readouterr()
    skipped = [str(tmp_path / name) for name in ("compare.png", "empty", "weights.npz")]
    assert told.err == f"skipped, as no flights: {', '.join(skipped)}\n"
    assert json.loads(told.out)["skipped"] == skipped
    assert json.loads(told.out)["flights"] == [str(tmp_path / name) for name in ("one", "other")]
    whole = (tmp_path / "one" / "log.npz").read_bytes()
    (tmp_path / "damaged.npz").write_bytes(whole[:2000])
    (tmp_path / "directory.npz").write_bytes(whole.replace(b"PK\x01\x02", b"PK\x01\x03"))  # of the archive, at its end
    for others, message in (
        (["nowhere"], "nowhere does not exist"),
        (["damaged.npz"], "damaged.npz: is not an .npz file"),
        (["directory.npz"], "directory.npz: is not an .npz file"),
    ):
        assert main(["view", str(tmp_path / "one"), *(str(tmp_path / x) for x in others), *page]) == 2
        assert message in capsys.readouterr().err
    assert main(["view", *skipped, *page]) == 2 and "is a flight" in capsys.readouterr().err


def test_every_array_begins_at_a_whole_number_of_four_bytes():
    """As typed arrays of a browser must."""
    arrays = payload._Arrays()
    assert [arrays.add_bytes(np.zeros(3, np.uint8))["offset"], arrays.add(np.zeros(3))["offset"]] == [0, 4]


def test_policies_of_a_training_are_named_with_their_success(record):
    evaluated = [SimpleNamespace(update=3, value=0.875, flight=record)]
    (world,) = header(show_history(evaluated, 3, "success", "a title"))["worlds"]
    assert world["name"] == "update 3: success 87.5 %"


def test_loads_on_cables_are_in_the_page_and_in_a_log(team, tmp_path):
    path = trajectory(team)
    load = PointMass(path.pos - np.array([0.1, 0.0, 0.5]), path.vel)
    carried = path.replace(aux={"payload": load})
    world = header(show(carried, team, dt=0.01))["worlds"][0]
    np.testing.assert_allclose(world["loads"], load.pos, rtol=0, atol=1e-4)
    assert header(show(path, team, dt=0.01))["worlds"][0]["loads"] is None
    many = jax.tree.map(lambda x: np.stack([x, x + 1]), carried)
    second = header(show(many, team, dt=0.01))["worlds"][1]
    np.testing.assert_allclose(second["loads"], load.pos + 1, rtol=0, atol=1e-4)
    (record,) = records_of(carried, {"params": team, "dt": 0.01, "targets": None, "labels": None, "images": None})
    save_npz(record, tmp_path / "log.npz")
    np.testing.assert_array_equal(read_log(tmp_path / "log.npz").load_pos, load.pos)


def test_a_trajectory_of_other_shapes_and_an_empty_one_are_refused(team):
    flown = trajectory(team)
    for wrong, said in (
        (flown.replace(quat=flown.quat[..., :3]), r"quat of the trajectory has shape \(20, 3, 3\); give \(20, 3, 4\)"),
        (flown.replace(vel=flown.vel[:5]), r"vel of the trajectory has shape \(5, 3, 3\); give \(20, 3, 3\)"),
        (jax.tree.map(lambda x: x[:0], flown), "give at least one time, drone and world"),
        (jax.tree.map(lambda x: x[None][:0], flown), "give at least one time, drone and world"),
    ):
        with pytest.raises(ValueError, match=said):
            show(wrong, team, dt=0.1)
    with pytest.raises(ValueError, match=r"labels is 'abc'; give a sequence, for example \('left',\)"):
        show(flown, team, dt=0.1, labels="abc")


@pytest.mark.parametrize(
    ("kind", "frames", "says"),
    [
        ("rgb", np.full((20, 3, 4, 4, 3), 0.5), "type float64; give uint8, from 0 to 255"),
        ("rgb", np.full((20, 3, 4, 4, 3), 300), "type int64; give uint8, from 0 to 255"),
        ("rgb", np.zeros((20, 3, 4, 4, 2), np.uint8), r"shape .*; give \(K, n, height, width, 3 or 4\)"),
        ("segmentation", np.zeros((20, 3, 4, 4)), "type float64; give whole numbers"),
        ("depth", np.zeros((20, 3, 0, 4)), r"shape .*; give \(K, n, height, width\)"),
    ],
)
def test_images_of_other_numbers_are_refused(team, kind, frames, says):
    """Colors from 0 to 1 were shown as black, and 300 as 44."""
    with pytest.raises(ValueError, match=f"images '{kind}' .* {says}"):
        show(trajectory(team), team, dt=0.1, images={kind: frames})

"""How many frames per second does the page of the viewer draw without a GPU, for recorded and for simulated flights?

Crazyflies on circles, 1,000 rows at 100 Hz, played at normal speed in a headless Chromium with software rendering, in a
window of 1,100 x 720 pixels. In `simulated` flights the page computes the physics at 500 Hz and the policy of hover at
100 Hz. The page lowers the resolution of the view while frames take longer than 1/32 s; the resolution is reported
along each side. `at half` are the frames per second at half of the resolution along each side, whatever a frame takes,
and `CPU ms` is the CPU time of all processes of the browser for such a frame; it hardly depends on other programs. The
size of the page and the times to make and to load it are also measured.
"""

import argparse
import os
import tempfile
import time
from pathlib import Path

import numpy as np

import jaxdrones as jd
from jaxdrones.visualization.browser import Tab, find_browser, open_tab
from jaxdrones.visualization.viewer import Page

DT = 0.01  # s
FRAMES = 60  # of which the processor time is taken
PLAY_AT_HALF = """(() => {
    const { player } = jaxdrones, { stage } = player;
    stage.adapt = () => stage.setSharp(false);
    stage.share = 0.5;
    stage.resize();
    Object.assign(player, { again: true, playing: true });
})()"""
DRAW = """(() => {
    const { player } = jaxdrones, { stage } = player, gl = stage.renderer.getContext();
    player.playing = false;
    stage.setSharp(false);
    stage.share = 0.5;
    stage.resize();
    for (let k = 0; k < COUNT; k++) {
        player.time = (player.end * (k + 1)) / (COUNT + 1);
        player.draw(0.03);
        gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4)); // waits until it is drawn
    }
})()"""


def recorded_page(drones: int, rows: int) -> tuple[Page, float]:
    """A page of so many drones on circles around places of a grid, and the seconds that it takes to make it."""
    side = int(np.ceil(np.sqrt(drones)))
    places = 0.5 * np.stack([np.arange(drones) % side, np.arange(drones) // side, np.zeros(drones)], axis=-1)
    t = DT * np.arange(rows)[:, None]
    phase = t + np.arange(drones)
    pos = places + np.stack([0.2 * np.cos(phase), 0.2 * np.sin(phase), 1 + 0.1 * np.sin(3 * phase)], axis=-1)
    vel = np.gradient(pos, DT, axis=0)
    quat = np.stack([0 * phase, 0 * phase, np.sin(phase / 2), np.cos(phase / 2)], axis=-1)
    params = jd.repeat(jd.load_params("cf2x"), drones)
    rpm = np.asarray(params.hover_rpm)[:, None] * np.ones((rows, drones, 4))
    flight = jd.State(pos, quat, vel, np.zeros_like(vel), rpm)
    start = time.perf_counter()
    page = jd.show(flight, params, dt=DT)
    return page, time.perf_counter() - start


def simulated_page(drones: int) -> tuple[Page, float]:
    """A page that simulates so many drones, and the seconds that it takes to make it."""
    from jaxdrones.export import simulation  # which needs casadi

    start = time.perf_counter()
    with jd.make("hover") as env:
        page = simulation.page(jd.make_policy("hover", env), env, "simulated", drones)
    return page, time.perf_counter() - start


def processor_seconds() -> float:
    """Processor time of the processes that this one has started, and of theirs, s."""
    parents, seconds = {}, {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            fields = (process / "stat").read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        parents[int(process.name)], seconds[int(process.name)] = int(fields[1]), sum(map(int, fields[11:15]))

    def is_ours(process: int) -> bool:
        return parents.get(process) == os.getpid() or (process in parents and is_ours(parents[process]))

    return sum(seconds[process] for process in seconds if is_ours(process)) / os.sysconf("SC_CLK_TCK")


def frame_rate(tab: Tab, seconds: float) -> float:
    """Frames per second that a page draws in some seconds."""
    begun, first = time.perf_counter(), tab.run("jaxdrones.player.frames")
    time.sleep(seconds)
    last, ended = tab.run("jaxdrones.player.frames"), time.perf_counter()
    return (last - first) / (ended - begun)


def measure(page: Page, seconds: float) -> dict:
    """Frames per second, and what belongs to them: half of the time lets the page settle, a third is counted."""
    with tempfile.TemporaryDirectory() as folder, open_tab() as tab:
        file = page.save(Path(folder) / "page.html")
        start = time.perf_counter()
        tab.open(file, 1100, 720)
        loaded = time.perf_counter() - start
        tab.run("jaxdrones.player.playing || jaxdrones.player.toggle()")
        time.sleep(seconds / 2)
        played = frame_rate(tab, seconds / 3)
        share = tab.run("jaxdrones.player.stage.share")
        tab.run(PLAY_AT_HALF)
        time.sleep(seconds / 10)
        at_half = frame_rate(tab, seconds / 3)
        tab.run(DRAW.replace("COUNT", "5"))
        before = processor_seconds()
        tab.run(DRAW.replace("COUNT", str(FRAMES)))
        spent = processor_seconds() - before
        return {
            "frames/s": played,
            "share": share,
            "at half (frames/s)": at_half,
            "CPU ms": 1000 * spent / FRAMES,
            "MB": file.stat().st_size / 1e6,
            "loaded (s)": loaded,
        }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--drones", type=int, nargs="+", default=[1, 20, 100, 1000])
    parser.add_argument(
        "--simulated", type=int, nargs="*", default=[1, 20], metavar="DRONES", help="of pages that simulate"
    )
    parser.add_argument("--rows", type=int, default=1000)


def line(row: dict) -> str:
    """One row of the table."""
    drawn = f"{row['frames/s']:8.1f}  {100 * row['share']:8.0f} %"
    half = f"{row['at half (frames/s)']:7.1f}  {row['CPU ms']:7.1f}"
    cost = f"{row['MB']:7.2f}  {row['made (s)']:6.2g}  {row['loaded (s)']:8.2g}"
    return f"{row['flight']:9}  {row['drones']:6,}  {drawn}  {half}  {cost}"


def main(options: argparse.Namespace) -> tuple[dict, list[str]]:
    if find_browser() is None:
        raise SystemExit("there is no Chromium")
    if options.quick:
        options.drones, options.simulated, options.rows = [4], [], 200
    cases = [("recorded", count, lambda n=count: recorded_page(n, options.rows)) for count in options.drones]
    cases += [("simulated", count, lambda n=count: simulated_page(n)) for count in options.simulated]
    rows = []
    for kind, count, make in cases:
        page, made = make()
        rows.append({"flight": kind, "drones": count} | measure(page, options.rows * DT) | {"made (s)": made})
    lines = ["flight     drones  frames/s  resolution  at half   CPU ms  page MB  made s  loaded s"]
    lines += [line(row) for row in rows]
    facts = {"cores": len(os.sched_getaffinity(0)), "load": os.getloadavg()[0]}
    lines.append(f"load {facts['load']:.1f}")
    return {"about": facts, "rows": rows}, lines

"""`pytest --shard K/N --since TIME --minutes M`: first the tests of files that changed, then one part of the others."""

import subprocess
import time
import zlib
from collections import Counter
from pathlib import Path

import pytest

NOT_RUN = pytest.StashKey[Counter]()
END = pytest.StashKey[float]()


def pytest_addoption(parser):
    parser.addoption("--shard", metavar="K/N", help="run the K-th of N parts of the tests, and those of changed files")
    parser.addoption("--since", metavar="TIME", help="a file is changed if a commit after TIME touched it (git log)")
    parser.addoption("--minutes", type=float, default=float("inf"), help="skip what has not begun by then")


def pytest_configure(config):
    config.stash[NOT_RUN] = Counter()
    config.stash[END] = time.monotonic() + 60 * config.getoption("minutes")
    if config.pluginmanager.hasplugin("xdist"):
        config.pluginmanager.register(FromWorkers(config), "shards-from-workers")


@pytest.hookimpl(trylast=True)  # what `-m` leaves
def pytest_collection_modifyitems(config, items):
    if not config.getoption("shard"):
        return
    part, parts = map(int, config.getoption("shard").split("/"))
    changed = changed_tests(config.rootpath, config.getoption("since"))
    kept = [item for item in items if item.path in changed or zlib.crc32(item.nodeid.encode()) % parts == part % parts]
    config.stash[NOT_RUN].update(item.location[0] for item in set(items) - set(kept))
    items[:] = sorted(kept, key=lambda item: item.path not in changed)


def pytest_runtest_setup(item):
    if time.monotonic() > item.config.stash[END]:
        pytest.skip(f"NOT RUN: the {item.config.getoption('minutes'):g} minutes are over")


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session):
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["not_run"] = dict(session.config.stash[NOT_RUN])


def pytest_terminal_summary(terminalreporter, config):
    not_run = config.stash[NOT_RUN]
    if not_run:
        terminalreporter.section(f"NOT RUN: {not_run.total()} tests of other shards")
        for file, count in sorted(not_run.items()):
            terminalreporter.line(f"{count:4} {file}")


class FromWorkers:
    """With xdist only the workers collect tests; all collect the same."""

    def __init__(self, config):
        self.config = config

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        self.config.stash[NOT_RUN] = Counter(getattr(node, "workeroutput", {}).get("not_run", {}))


def changed_tests(root: Path, since: str | None) -> set[Path]:
    """Test files that changed, or whose module did: tests/a/test_b.py for jaxdrones/a/b.py, or else all of tests/a."""
    if not since:
        return set()
    command = ["git", "log", f"--since={since}", "--name-only", "--format="]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
    found = set()
    for name in set(done.stdout.split("\n")):
        path = Path(name)
        if path.parts[:1] == ("tests",):
            found.add(root / path)
        elif path.parts[:1] == ("jaxdrones",):
            folder = root / "tests" / Path(*path.parts[1:-1])
            own = folder / f"test_{path.name}"
            found |= {own} if own.exists() else set(folder.glob("test_*.py"))
    return found

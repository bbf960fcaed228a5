"""Headless Chromium, controlled by its debugging protocol through a pipe, without a port or a library."""

import base64
import contextlib
import json
import os
import selectors
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxdrones.errors import UserError

_PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_FLAGS = ("--headless=new", "--remote-debugging-pipe", "--no-first-run", "--hide-scrollbars", "--disable-extensions")
_SOFTWARE = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
_READY = "document.documentElement?.dataset.ready === 'true'"  # of the viewer's page
_LAUNCH = """import os, sys
read, write = (os.dup(os.dup(int(fd))) for fd in sys.argv[1:3])
os.dup2(read, 3), os.dup2(write, 4)
os.execv(sys.argv[3], sys.argv[3:])"""  # Chromium reads commands from 3 and answers on 4


def find_browser() -> str | None:
    """Path of a Chromium or Chrome; `None` if not found."""
    return next(filter(None, map(shutil.which, _PROGRAMS)), None)


def needed_browser() -> str:
    """Path of a Chromium or Chrome.

    Raises:
        ValueError: not found.
    """
    program = find_browser()
    if program is None:
        raise UserError(f"there is no Chromium; install it, under one of the names {', '.join(_PROGRAMS)}")
    return program


class Tab:
    """Page in the browser."""

    def __init__(self, write: int, read: int) -> None:
        self._write, self._read = write, read
        self._buffer, self._count = b"", 0
        self._session: str | None = None
        self._url = ""
        self.problems: list[str] = []
        """Errors and warnings of the console, exceptions, and requests beyond the file or the server."""

    def open(self, page: Path | str, width: int = 1100, height: int = 720, ready: str = _READY) -> None:
        """Open a file, or the address of a local server, and wait until a JavaScript condition holds."""
        self._url = page if isinstance(page, str) else page.absolute().as_uri()
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in "Page", "Runtime", "Log", "Network":
            self.call(f"{domain}.enable")
        size = dict(width=width, height=height, deviceScaleFactor=1, mobile=False)
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.call("Page.navigate", url=self._url)
        self.wait(ready)

    def call(self, method: str, timeout: float = 120, **arguments: Any) -> dict[str, Any]:
        """Call a method of the protocol; return its result."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": arguments}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        end = time.monotonic() + timeout
        while (answer := self._next(end)).get("id") != self._count:
            self._note(answer)
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']}")
        return answer["result"]

    def run(self, script: str, **more: Any) -> Any:
        """Value of a JavaScript expression; a promise is awaited."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True, **more)
        if "exceptionDetails" in answer:
            raise RuntimeError(answer["exceptionDetails"]["exception"].get("description", script))
        return answer["result"].get("value")

    def wait(self, condition: str, timeout: float = 120) -> None:
        """Wait until an expression is true."""
        end = time.monotonic() + timeout
        while not self.run(condition):
            if time.monotonic() > end:
                raise TimeoutError(f"{condition} is not true after {timeout} s; {self.problems}")
            time.sleep(0.05)

    def press(self, key: str, code: str = "", shift: bool = False) -> None:
        """Press a key."""
        text: dict[str, Any] = {"text": key} if len(key) == 1 else {}
        for kind in "keyDown", "keyUp":
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=code, modifiers=8 * shift, **text)

    def screenshot(self) -> bytes:
        """Screenshot as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", optimizeForSpeed=True)["data"])

    def _next(self, end: float) -> dict[str, Any]:
        with selectors.DefaultSelector() as selector:
            selector.register(self._read, selectors.EVENT_READ)
            while b"\0" not in self._buffer:
                if not selector.select(max(0, end - time.monotonic())):
                    raise TimeoutError("the browser does not answer")
                data = os.read(self._read, 1 << 20)
                if not data:
                    raise RuntimeError("the browser has ended")
                self._buffer += data
        message, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(message)

    def _note(self, message: dict[str, Any]) -> None:
        method, params = message.get("method"), message.get("params", {})
        if method == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning", "assert"):
            self.problems.append(str([x.get("value", x.get("description")) for x in params["args"]]))
        elif method == "Runtime.exceptionThrown":
            self.problems.append(str(params["exceptionDetails"]))
        elif method == "Log.entryAdded" and params["entry"]["level"] in ("error", "warning"):
            self.problems.append(params["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            url = params["request"]["url"]
            served = self._url.startswith("http") and url.startswith(self._url)
            if not served and not url.startswith(("file:", "data:", "blob:", "about:")):
                self.problems.append(f"a request to {url}")


@contextlib.contextmanager
def open_tab() -> Iterator[Tab]:
    """Context with a page in a new browser with software rendering.

    Raises:
        ValueError: no browser.
    """
    program = needed_browser()
    from_us, write = os.pipe()
    read, to_us = os.pipe()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [sys.executable, "-I", "-c", _LAUNCH, str(from_us), str(to_us), program]
        process = subprocess.Popen(
            [*command, *_FLAGS, *_SOFTWARE, f"--user-data-dir={profile}", "about:blank"],
            pass_fds=(from_us, to_us),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(from_us)
        os.close(to_us)
        try:
            yield Tab(write, read)
        finally:
            os.close(write)
            process.kill()
            process.wait()
            os.close(read)

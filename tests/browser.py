"""A headless Chromium over a pair of pipes, for pages that run a script: no driver, no port, no package."""

import contextlib
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
PATIENCE_S = 60.0
SAID = ("Runtime.exceptionThrown", "Log.entryAdded", "Runtime.consoleAPICalled", "Page.javascriptDialogOpening")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
    "--hide-scrollbars", "--disable-dev-shm-usage", "--remote-debugging-pipe", "--enable-unsafe-swiftshader",
)  # fmt: skip


class Page:
    """One tab. requests: the addresses of all that was asked for; said: what the page wrote to its console, errors
    too."""

    def __init__(self, to_browser: int, from_browser: int) -> None:
        self.pipes = (to_browser, from_browser)
        self.number, self.buffer, self.session = 0, b"", None
        self.requests: list[str] = []
        self.said: list[str] = []

    def send(self, method: str, **params: Any) -> dict:
        self.number += 1
        message = {"id": self.number, "method": method, "params": params}
        message |= {"sessionId": self.session} if self.session else {}
        os.write(self.pipes[0], json.dumps(message).encode() + b"\0")
        while True:
            got = self._next()
            if got.get("id") == self.number:
                assert "error" not in got, got["error"]
                return got["result"]
            self._note(got)

    def _note(self, event: dict) -> None:
        params = event.get("params", {})
        if event.get("method") == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])
        if event.get("method") in SAID:
            self.said.append(json.dumps(params)[:500])

    def _next(self) -> dict:
        end = time.monotonic() + PATIENCE_S
        while b"\0" not in self.buffer:
            ready, _, _ = select.select([self.pipes[1]], [], [], max(0.0, end - time.monotonic()))
            data = os.read(self.pipes[1], 1 << 20) if ready else b""
            assert data, "the browser does not answer"
            self.buffer += data
        line, self.buffer = self.buffer.split(b"\0", 1)
        return json.loads(line)

    def open(self, path: Path | str, fragment: str = "") -> None:
        self.send("Emulation.setDeviceMetricsOverride", width=1400, height=1000, deviceScaleFactor=1, mobile=False)
        self.send("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "light"}])
        self.send("Page.navigate", url="about:blank")
        self.wait("location.href === 'about:blank'")  # a page that follows at once is answered never, now and then
        self.send("Page.navigate", url=(path if isinstance(path, str) else path.absolute().as_uri()) + fragment)
        self.wait("document.readyState === 'complete'")

    def run(self, script: str) -> Any:
        got = self.send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in got, got["exceptionDetails"]
        return got["result"].get("value")

    def press(self, key: str) -> None:
        for kind in ("keyDown", "keyUp"):
            self.send("Input.dispatchKeyEvent", type=kind, key=key, code=key)

    def mouse(self, kind: str, x: float, y: float, button: str = "left", **more: Any) -> None:
        """Move, press, release or turn the wheel: kind is mouseMoved, mousePressed, mouseReleased, mouseWheel."""
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, **more)

    def click(self, x: float, y: float) -> None:
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x, y, clickCount=1)

    def drag(self, begin: tuple[float, float], end: tuple[float, float], button: str = "left", steps: int = 5) -> None:
        self.mouse("mousePressed", *begin, button, clickCount=1)
        for k in range(1, steps + 1):
            at = [a + (b - a) * k / steps for a, b in zip(begin, end, strict=True)]
            self.mouse("mouseMoved", *at, button, buttons={"left": 1, "right": 2}[button])
        self.mouse("mouseReleased", *end, button, clickCount=1)

    def wait(self, script: str) -> None:
        end = time.monotonic() + PATIENCE_S
        while not self.run(script):
            assert time.monotonic() < end, f"never true: {script}; {self.said}"
            time.sleep(0.02)


@contextlib.contextmanager
def browser(folder: Path) -> Iterator[Page]:
    chromium = next((path for name in NAMES if (path := shutil.which(name))), None)
    if chromium is None:
        pytest.skip("no chromium on this machine (apt-get install chromium)")
    (ours_in, theirs_out), (theirs_in, ours_out) = os.pipe(), os.pipe()

    def connect() -> None:  # the protocol's pipes are 3 and 4
        spare = [os.dup(theirs_in), os.dup(theirs_out)]
        os.dup2(os.dup(spare[0]), 3)
        os.dup2(os.dup(spare[1]), 4)

    command = [chromium, *FLAGS, f"--user-data-dir={folder}", "about:blank"]
    with open(folder.with_name("chromium.log"), "wb") as log:
        process = subprocess.Popen(command, preexec_fn=connect, close_fds=False, stdout=log, stderr=log)
    os.close(theirs_in)
    os.close(theirs_out)
    try:
        page = Page(ours_out, ours_in)
        targets = page.send("Target.getTargets")["targetInfos"]
        target = next(one["targetId"] for one in targets if one["type"] == "page")
        page.session = page.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            page.send(f"{domain}.enable")
        yield page
    finally:
        process.kill()
        process.wait()
        os.close(ours_in)
        os.close(ours_out)

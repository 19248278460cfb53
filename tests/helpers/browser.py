"""A real Chromium without a window, driven through the DevTools protocol over a pair of pipes."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = ("--headless", "--no-sandbox", "--disable-dev-shm-usage", "--remote-debugging-pipe", "--hide-scrollbars")
FLAGS += ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run", "--disable-extensions")
_SECONDS = 60.0


def _pipe() -> tuple[int, ...]:
    """A pipe whose ends are above 9: Chromium reads from 3 and writes to 4."""
    import fcntl  # of POSIX

    ends = os.pipe()
    high = tuple(fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in ends)
    for end in ends:
        os.close(end)
    return high


class Browser:
    """One page; what it logs, and what it asks for on the network, is kept."""

    def __init__(self, folder: Path) -> None:
        program = next((found for found in map(shutil.which, NAMES) if found), None)
        if program is None:
            pytest.skip(f"no Chromium found as {', '.join(NAMES)}")
        (theirs, self.to), (self.source, ours) = (_pipe(), _pipe())
        code = f"import os, sys; os.dup2({theirs}, 3); os.dup2({ours}, 4); os.execv(sys.argv[1], sys.argv[1:])"
        words = [sys.executable, "-S", "-c", code, program, *FLAGS, f"--user-data-dir={folder}"]
        self.process = subprocess.Popen(words, pass_fds=(theirs, ours), stderr=subprocess.DEVNULL)
        for descriptor in (theirs, ours):
            os.close(descriptor)
        self.number, self.buffer, self.session = 0, b"", ""
        self.problems: list[str] = []
        self.requests: list[str] = []
        self.loaded = False
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self.to)  # it ends where nobody writes to it any more
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        os.close(self.source)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The result of a method of the protocol."""
        self.number += 1
        number, message = self.number, {"id": self.number, "method": method, "params": parameters}
        os.write(self.to, json.dumps(message | ({"sessionId": self.session} if self.session else {})).encode() + b"\0")
        while True:
            answer = self._read()
            if answer.get("id") == number:
                assert "error" not in answer, (method, answer.get("error"))
                result: dict[str, Any] = answer["result"]
                return result

    def run(self, expression: str) -> Any:
        """The value of a JavaScript expression, of a promise what it resolves to."""
        done = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in done, done["exceptionDetails"]
        return done["result"].get("value")

    def open(self, path: Path | str, ready: str = "true") -> None:
        """Load a file, or what is at a URL, and wait until an expression is true."""
        self.problems, self.requests, self.loaded = [], [], False
        self.call("Page.navigate", url=path if isinstance(path, str) else path.resolve().as_uri())
        while not self.loaded:
            self._read()
        self.wait(ready)

    def wait(self, expression: str) -> None:
        """Until an expression is true."""
        end = time.monotonic() + _SECONDS
        while not self.run(expression):
            assert time.monotonic() < end, f"after {_SECONDS} s not {expression}: {self.problems}"
            time.sleep(0.05)

    def size(self, width: int, height: int, scheme: str = "light", motion: str = "reduce") -> None:
        """The size of the page in CSS pixels, one of the screen's each, its colour scheme, and how much may move."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600
        )
        wanted = {"prefers-color-scheme": scheme, "prefers-reduced-motion": motion}
        features = [{"name": name, "value": value} for name, value in wanted.items()]
        self.call("Emulation.setEmulatedMedia", features=features)

    def picture(self, data_url: str) -> np.ndarray[Any, Any]:
        """RGB in [0, 1], `(H, W, 3)`, of a PNG in a data URL."""
        content = np.frombuffer(base64.b64decode(data_url.partition(",")[2]), np.uint8)
        return cv2.imdecode(content, cv2.IMREAD_COLOR)[:, :, ::-1] / 255.0

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self.buffer:
            assert select.select([self.source], [], [], _SECONDS)[0], f"no answer for {_SECONDS} s"
            part = os.read(self.source, 2**16)
            assert part, "Chromium has ended"
            self.buffer += part
        message, _, self.buffer = self.buffer.partition(b"\0")
        value: dict[str, Any] = json.loads(message)
        method, given = value.get("method"), value.get("params", {})
        if method == "Network.requestWillBeSent":
            self.requests.append(given["request"]["url"])
        elif method == "Page.loadEventFired":
            self.loaded = True
        elif method == "Runtime.exceptionThrown":
            self.problems.append(str(given["exceptionDetails"]))
        elif method == "Log.entryAdded" and given["entry"]["level"] in ("warning", "error"):
            self.problems.append(given["entry"]["text"])
        elif method == "Runtime.consoleAPICalled" and given["type"] in ("warning", "error"):
            self.problems.append(str(given["args"]))
        return value

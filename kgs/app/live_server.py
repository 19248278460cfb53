"""Serves one page, and the newest splat for it, to browsers on this machine; from memory, without a file.

It listens on the loopback interface alone. Other accounts of this machine can reach its port, so all of it is below a
path that is a secret, which only the console shows. Any page that a browser shows can send requests there, so two more
checks keep others out: the Host header has to name this server (a domain that was made to resolve to 127.0.0.1 does
not), and the splat is only for the page itself (Fetch Metadata). Without CORS headers no other page could read an
answer.
"""

import json
import logging
import re
import secrets
import socketserver
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from threading import Condition, Lock, Thread
from typing import Any, Generic, TypeVar

from .page.data import Packed

HOST = "127.0.0.1"
_WAIT = 20.0  # seconds after which a request is answered though there is nothing new
_IDLE = 10.0  # seconds after which a connection that does not go on is closed
_GRACE = 1.0  # seconds that the end waits for a page that is open
_RECENT = 3.0  # seconds since its last request for which a page counts as open
_POLL = 0.1  # seconds that the end may wait for the thread of the server
_SPLAT = re.compile(r"splat\?after=(\d{1,9})", re.ASCII)
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'",  # the rest is in the page
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
T = TypeVar("T")
_log = logging.getLogger("kgs")


class LiveServer:
    """The server, from its start until :meth:`close`.

    What there is to show has a version, a counter. A page asks for what is newer than the version that it has, and the
    answer comes when there is something.

    Args:
        page: makes the HTML of the page, once, in a thread of the server.

    Raises:
        OSError: the system gives no port.

    Attributes:
        page: the HTML.
        port: on which it listens.
        path: what every address begins with, a slash, 22 random characters and a slash.
        url: of the page.
        seconds: processor time that all answers took until now.
    """

    def __init__(self, page: Callable[[], bytes]) -> None:
        self.page = _Once(page)
        self.seconds = 0.0
        self._changed = Condition()  # guards all that changes
        self._news: dict[str, Any] = {"version": 0, "text": "", "isOver": False}
        self._splat: _Once[Packed] | None = None
        self._splat_version = 0
        self._waiting = 0  # requests that wait for something new
        self._busy = 0  # those that are being answered, too
        self._told = 0  # the newest version that was sent
        self._asked = float("-inf")  # time of the last request
        self._server = _Server((HOST, 0), lambda *request: _Handler(self, *request))
        self.port: int = self._server.server_address[1]
        self.path = f"/{secrets.token_urlsafe(16)}/"
        self.url = f"http://{HOST}:{self.port}{self.path}"
        self._thread = Thread(target=self._server.serve_forever, args=(_POLL,), daemon=True)
        self._thread.start()

    @property
    def is_awaited(self) -> bool:
        """Whether a page is open and has all that there is."""
        return self._waiting > 0

    def show(self, text: str, splat: Callable[[], Packed] | None = None, *, is_over: bool = False) -> None:
        """Send this to all pages.

        Args:
            text: how far the fit is.
            splat: makes the new splat, once, if it is asked for, in a thread of the server. None: as before.
            is_over: whether nothing follows.
        """
        with self._changed:
            self._news = {"version": self._news["version"] + 1, "text": text, "isOver": is_over}
            if splat is not None:
                self._splat = _Once(splat)
                self._splat_version = self._news["version"]
            self._changed.notify_all()

    def close(self, text: str) -> None:
        """Send the last text to pages that are open, which takes a second at most, and end."""
        self.show(text, is_over=True)
        with self._changed:
            if self._busy or time.monotonic() - self._asked < _RECENT:
                self._changed.wait_for(lambda: not self._busy and self._told == self._news["version"], _GRACE)
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    @contextmanager
    def newer_than(self, version: int) -> Iterator[list[bytes]]:
        """Wait for what is newer, and yield it as live.js reads it; [] if nothing comes, or not for a while.

        It has been sent when the block ends.
        """
        with self._changed:
            self._busy += 1
            self._waiting += 1
            self._changed.wait_for(lambda: self._news["version"] > version or self._news["isOver"], _WAIT)
            self._waiting -= 1
            self._asked = time.monotonic()
            news = dict(self._news)
            splat = self._splat if self._splat_version > version else None
        try:
            if news["version"] <= version:
                yield []
            elif splat is None:
                yield [json.dumps(news).encode() + b"\n"]
            else:
                packed = splat()
                yield [json.dumps(news | {"layout": packed.layout}).encode() + b"\n", packed.content]
        finally:
            with self._changed:
                self._busy -= 1
                self._told = max(self._told, news["version"])
                self._changed.notify_all()

    def count(self, seconds: float) -> None:
        """Add the processor time of an answer."""
        with self._changed:
            self.seconds += seconds


class _Once(Generic[T]):
    """A value that is made when it is first asked for, by whichever thread."""

    def __init__(self, make: Callable[[], T]) -> None:
        self._make: Callable[[], T] | None = make
        self._lock = Lock()

    def __call__(self) -> T:
        with self._lock:
            if self._make is not None:
                self._value = self._make()
                self._make = None
        return self._value


class _Server(socketserver.ThreadingTCPServer):
    """Not `http.server.HTTPServer`, which asks the name service for the name of this machine."""

    daemon_threads = True

    def handle_error(self, *_: object) -> None:
        """Say nothing of a page that was closed while it was sent, or was idle; keep other errors for who debugs."""
        if not isinstance(sys.exception(), OSError):
            _log.debug("the live page was not answered", exc_info=True)


class _Handler(BaseHTTPRequestHandler):
    """Answers one request; HTTP/1.0, so that no connection outlives it."""

    timeout = _IDLE

    def __init__(self, live: LiveServer, *request: Any) -> None:
        self._live = live
        super().__init__(*request)

    def handle(self) -> None:
        """Answer, and count the time."""
        begin = time.thread_time()
        try:
            super().handle()
        finally:
            self._live.count(time.thread_time() - begin)

    def do_GET(self) -> None:
        """Answer with the page or the splat."""
        count = len(self._live.path)
        is_known = secrets.compare_digest(self.path[:count].encode(), self._live.path.encode())  # in a constant time
        rest = self.path[count:]
        after = _SPLAT.fullmatch(rest)
        if self.headers["Host"] not in (f"{HOST}:{self._live.port}", f"localhost:{self._live.port}"):
            self.send_error(HTTPStatus.FORBIDDEN)
        elif not is_known or not (rest == "" or after):
            self.send_error(HTTPStatus.NOT_FOUND)
        elif after is None:
            self._send("text/html; charset=utf-8", [self._live.page()])
        elif self.headers.get("Sec-Fetch-Site", "same-origin") not in ("same-origin", "none"):
            self.send_error(HTTPStatus.FORBIDDEN)
        else:
            with self._live.newer_than(int(after[1])) as parts:
                self._send("application/octet-stream", parts)

    do_HEAD = do_GET

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Refuse the request, with no more words than the code has."""
        self._send("text/plain", [HTTPStatus(code).phrase.encode()], code)

    def _send(self, kind: str, parts: list[bytes], code: int = HTTPStatus.OK) -> None:
        self.send_response(code if parts else HTTPStatus.NO_CONTENT)
        headers = {"Content-Type": kind, "Content-Length": str(sum(map(len, parts)))} if parts else {}
        for name, value in (headers | _HEADERS).items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            for part in parts:
                self.wfile.write(part)

    def version_string(self) -> str:
        """What the Server header says."""
        return "kgs"

    def log_message(self, *_: object) -> None:
        """Say nothing: the console belongs to the fit."""

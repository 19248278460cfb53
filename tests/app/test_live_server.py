"""The server of the live page: what it serves, to whom, and when."""

from __future__ import annotations

import json
import logging
import socket
import sys
import time
from collections.abc import Iterator
from threading import Event, Thread
from typing import Any

import pytest

from kgs.app import live_server
from kgs.app.live_server import LiveServer
from kgs.app.page.data import Packed

SPLAT = Packed({"count": 2, "degree": 0, "columns": ["x"]}, b"\0\n345678")
OTHER_HOSTS = ("evil.example:{}", "127.0.0.1", "localhost", "127.0.0.1:1", "127.0.0.1:{}.evil.example")
OTHER_PATHS = ("/index.html", "/splat", "/splat?after=", "/splat?after=-1", "/splat?after=1x", "/splat?after=1&b=2")
OTHER_PATHS += ("/../../../../etc/passwd", "/%2e%2e/etc/passwd", "/?", "/favicon.ico", "/http://127.0.0.1/", "//")


@pytest.fixture
def server(monkeypatch: Any) -> Iterator[LiveServer]:
    server = LiveServer(lambda: b"<p>a page")
    server.show("step 0", lambda: SPLAT)
    yield server
    if server._thread.is_alive():
        monkeypatch.setattr(live_server, "_GRACE", 0.0)
        server.close("over")


def ask(
    server: LiveServer, words: str = "GET /", *headers: str, host: str | None = None, path: str | None = None
) -> tuple[int, str, bytes]:
    """Code, head and body of the answer to a request, written by hand; its path is below the secret one."""
    method, below = words.split(" /", 1)
    whole = (server.path if path is None else path) + below
    lines = [f"{method} {whole} HTTP/1.1", f"Host: {host or f'127.0.0.1:{server.port}'}", *headers, "", ""]
    with socket.create_connection(("127.0.0.1", server.port), timeout=20) as connection:
        connection.sendall("\r\n".join(lines).encode())
        answer = b"".join(iter(lambda: connection.recv(65536), b""))
    head, _, body = answer.partition(b"\r\n\r\n")
    return int(head.split()[1]), head.decode().lower(), body


def news(server: LiveServer, after: int) -> tuple[dict[str, Any], bytes]:
    code, _, body = ask(server, f"GET /splat?after={after}")
    assert code == 200
    line, _, content = body.partition(b"\n")
    return json.loads(line), content


def waiting(server: LiveServer, after: int) -> tuple[Thread, list[tuple[dict[str, Any], bytes]]]:
    """A client that waits for what comes after this version, and what it will find."""
    found: list[tuple[dict[str, Any], bytes]] = []
    client = Thread(target=lambda: found.append(news(server, after)))
    client.start()
    while not server.is_awaited:
        time.sleep(0.01)
    return client, found


def test_the_page_and_the_splat(server: LiveServer) -> None:
    code, head, body = ask(server, host=f"localhost:{server.port}")
    assert (code, body) == (200, b"<p>a page")
    assert "content-type: text/html; charset=utf-8" in head
    assert f"content-length: {len(body)}" in head
    assert news(server, 0) == ({"version": 1, "text": "step 0", "isOver": False, "layout": SPLAT.layout}, SPLAT.content)


def test_a_splat_is_sent_once_and_made_once(server: LiveServer) -> None:
    made = []
    server.show("step 1", lambda: made.append(0) or SPLAT)
    assert not made
    assert [news(server, 0)[0]["version"] for _ in range(3)] == [2, 2, 2]
    assert len(made) == 1
    server.show("step 2")
    assert news(server, 2) == ({"version": 3, "text": "step 2", "isOver": False}, b"")
    assert news(server, 1)[1] == SPLAT.content


def test_what_is_not_there_yet_is_waited_for(server: LiveServer, monkeypatch: Any) -> None:
    assert not server.is_awaited
    client, found = waiting(server, 1)
    assert not found
    server.show("step 7", lambda: SPLAT)
    client.join()
    assert found[0][0]["text"] == "step 7"
    assert not server.is_awaited
    monkeypatch.setattr(live_server, "_WAIT", 0.05)
    code, _, body = ask(server, "GET /splat?after=2")
    assert (code, body) == (204, b"")


REFUSED = [
    *((f"GET {path}", host, 403) for path in ("/", "/splat?after=0") for host in OTHER_HOSTS),
    *((f"GET {path}", "localhost:{}", 404) for path in OTHER_PATHS),
    *((f"{method} /", None, 501) for method in ("POST", "PUT", "DELETE", "OPTIONS", "CONNECT", "TRACE", "get")),
]
SAID = {403: b"Forbidden", 404: b"Not Found", 501: b"Not Implemented"}


@pytest.mark.parametrize(("words", "host", "expected"), REFUSED)
def test_other_hosts_paths_and_methods_are_refused(
    server: LiveServer, words: str, host: str | None, expected: int
) -> None:
    code, head, body = ask(server, words, host=host and host.format(server.port))
    assert (code, body) == (expected, SAID[expected])
    assert "content-type: text/plain" in head


def test_nothing_is_there_without_the_secret_path(server: LiveServer) -> None:
    """Other accounts of the machine can reach the port."""
    secret = server.path.strip("/")
    assert server.url == f"http://127.0.0.1:{server.port}/{secret}/"
    assert len(secret) >= 22  # 128 bits
    others = ("/", "//", f"/{secret}", f"/{secret[:-1]}/", f"/{secret}x/", f"/{secret.swapcase()}/", "*", "/\u00ff/")
    for path in others:
        for below in ("", "splat?after=0"):
            assert ask(server, f"GET /{below}", path=path)[::2] == (404, b"Not Found"), path
    other = LiveServer(lambda: b"another fit")
    other.close("over")
    assert other.path != server.path


def test_a_request_without_a_host_is_refused(server: LiveServer) -> None:
    with socket.create_connection(("127.0.0.1", server.port), timeout=20) as connection:
        connection.sendall(b"GET / HTTP/1.0\r\n\r\n")
        assert b" 403 " in connection.recv(100)


@pytest.mark.parametrize("path", ["/", "/splat?after=0"])
def test_head_has_no_body(server: LiveServer, path: str) -> None:
    code, head, body = ask(server, f"HEAD {path}")
    assert (code, body) == (200, b"")
    assert head.split("\r\ncontent", 1)[1] == ask(server, f"GET {path}")[1].split("\r\ncontent", 1)[1]


def test_pages_of_others_cannot_read_or_frame_it(server: LiveServer) -> None:
    for site in ("cross-site", "same-site"):  # another port of localhost is the same site
        assert ask(server, "GET /splat?after=0", f"Sec-Fetch-Site: {site}", "Origin: https://evil.example")[0] == 403
    assert ask(server, "GET /splat?after=0", "Sec-Fetch-Site: same-origin")[0] == 200
    for path in ("/", "/splat?after=0", "/none"):
        _, head, _ = ask(server, f"GET {path}", "Origin: https://evil.example")
        assert "access-control" not in head
        assert "frame-ancestors 'none'" in head
        assert "cross-origin-resource-policy: same-origin" in head
        assert "python" not in head


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere 127.0.0.2 is no address of this machine")
def test_it_listens_on_one_address_only(server: LiveServer) -> None:
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", server.port), timeout=5)


def test_it_says_nothing(server: LiveServer, capfd: Any) -> None:
    ask(server)
    ask(server, "GET /nothing")
    with socket.create_connection(("127.0.0.1", server.port), timeout=5) as connection:
        connection.sendall(b"\0\xff nonsense\r\n\r\n")
        assert connection.recv(100)
    client = socket.create_connection(("127.0.0.1", server.port), timeout=5)
    client.sendall(f"GET {server.path}splat?after=1 HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n\r\n".encode())
    while not server.is_awaited:
        time.sleep(0.01)
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
    client.close()  # reset: the answer cannot be sent
    large = Packed({}, bytes(10**7))
    server.show("step 1", lambda: large)
    server.close("over")
    said = capfd.readouterr()
    assert (said.out, said.err) == ("", "")


def test_an_error_in_making_a_splat_is_logged_and_the_server_goes_on(server: LiveServer, caplog: Any) -> None:
    server.show("step 1", lambda: Packed({}, bytes(1 // 0)))
    with caplog.at_level(logging.DEBUG, "kgs"):
        with pytest.raises(IndexError):
            ask(server, "GET /splat?after=1")  # closed without an answer
        assert ask(server)[0] == 200
        server.close("over")
    assert "ZeroDivisionError" in caplog.text


def test_the_end_is_told_to_who_waits_and_then_the_port_is_closed(server: LiveServer) -> None:
    client, found = waiting(server, 1)
    server.close("the end")
    client.join()
    assert found == [({"version": 2, "text": "the end", "isOver": True}, b"")]
    with pytest.raises(ConnectionRefusedError):
        ask(server)


def test_the_end_is_told_to_who_has_just_got_a_splat(server: LiveServer) -> None:
    news(server, 0)
    closing = Event()
    closer = Thread(target=lambda: (closing.set(), server.close("the end")))
    closer.start()
    closing.wait()
    time.sleep(0.2)  # in which a page decodes its splat
    assert news(server, 1)[0]["isOver"]
    closer.join()


def test_the_end_waits_for_nobody_who_is_not_there(server: LiveServer) -> None:
    begin = time.monotonic()
    server.close("the end")
    assert time.monotonic() - begin < live_server._GRACE / 2

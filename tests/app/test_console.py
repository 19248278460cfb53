"""Lines and progress: by name, sparse without a terminal, and no reader or terminal that is gone ends the work."""

import io
import sys
from pathlib import Path

import pytest

from kgs._support.errors import DataError
from kgs.app.console import as_line, open_in_browser, progress, quiet, say, say_next


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("total", "done", "seconds", "told"),
    [
        (200, 50, [0.1] * 150, []),  # less than half a minute
        (1000, 500, [1.0] * 70, ["530 of 1000 steps, 7.8 minutes left", "560 of 1000 steps, 7.3 minutes left"]),
        (10, 0, [12.0] * 10, [f"{i} of 10 steps, {120 - 12 * i} s left" for i in (3, 6)]),
        (10, 0, [40.0] + [2.0] * 9, ["2 of 10 steps, 16 s left"]),  # kernels are compiled in the first step
    ],
)
def test_without_a_terminal_a_few_lines_with_the_time_that_is_left(capsys, monkeypatch, total, done, seconds, told):
    now = 100.0
    monkeypatch.setattr("kgs.app.console.time.monotonic", lambda: now)
    with progress(total, "fit", done=done) as advance:
        for each in seconds:
            now += each
            advance("fine")
    assert capsys.readouterr().err.splitlines() == [f"fit: {line}, fine" for line in told]


def test_on_a_terminal_a_bar_with_the_name(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    with progress(4, "fit") as advance:
        for _ in range(4):
            advance("loss=0.1")
    assert "fit: 100%" in sys.stderr.getvalue()
    assert "loss=0.1" in sys.stderr.getvalue()


def test_letters_that_the_terminal_lacks_become_escapes():
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding="ascii", write_through=True)
    say("caf\u00e9 \u6f22 \udcff", stream)
    assert raw.getvalue().strip() == rb"caf\xe9 \u6f22 \udcff"


@pytest.mark.parametrize("kind", ["none", "closed", "broken"])
def test_a_reader_that_has_gone_ends_nothing(monkeypatch, kind):
    class Broken(io.StringIO):
        def write(self, text):
            raise BrokenPipeError(32, "Broken pipe")

    stream = {"none": None, "closed": io.StringIO(), "broken": Broken()}[kind]
    if kind == "closed":
        stream.close()
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, stream)
    say("a line")
    with progress(2, "fit") as advance:
        advance()
        advance()


def test_control_characters_in_names_become_escapes(capsys):
    say("one\x1b[31m\ntwo\r")
    assert capsys.readouterr().out == "one\\x1b[31m\ntwo\\r\n"
    assert str(DataError("a\nb", "c\nd", "a file")) == "a\\nb: c\\nd: expected a file"
    assert as_line("kgs", "a b", "it's\na \\") == r"kgs 'a b' $'it\'s\na \\'"
    assert as_line("d\udcff \x85é") == r"$'d\xff \xc2\x85é'"
    assert as_line("kgs", Path("./-a"), "-o", Path("b")) == "kgs ./-a -o b"


def test_quiet_leaves_errors_and_warnings(capsys):
    with quiet(True):
        say("a")
        say_next("b", "c")
        say("wrong", sys.stderr)
        with progress(2, "fit") as advance:
            advance("loss=0.1")
    say("d")
    said = capsys.readouterr()
    assert (said.out, said.err) == ("d\n", "wrong\n")


def test_off_a_terminal_the_first_step_alone_is_suggested(capsys, monkeypatch):
    say_next("a", "b")
    assert capsys.readouterr().out == "next: a\n"
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    say_next("a", "b")
    assert capsys.readouterr().out == "next:\n  a\n  b\n"


@pytest.mark.parametrize("has_browser", [True, False])
def test_a_page_is_opened_in_a_browser(tmp_path, monkeypatch, capsys, has_browser):
    opened = []
    monkeypatch.setattr("kgs.app.console.webbrowser.open", lambda url: opened.append(url) or has_browser)
    open_in_browser(tmp_path / "my page.html")
    assert opened == [f"{tmp_path.as_uri()}/my%20page.html"]
    assert ("no browser was found" in capsys.readouterr().err) != has_browser

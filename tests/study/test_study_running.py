"""How far running cells are: told by workers, shown as bars or lines."""

import io
import sys
from types import SimpleNamespace

import pytest

from kgs.study import running
from kgs.study.grid import run_grid
from kgs.study.running import Running, tell_steps


class Terminal(io.StringIO):
    def isatty(self):
        return True


def count_to_four(cell):
    """Work that tells its steps, as a fit does."""
    tell = tell_steps()
    for step in (1, 2, 3, 4):
        trainer = SimpleNamespace(step=step, plan=SimpleNamespace(schedule=SimpleNamespace(steps=4)))
        assert tell(trainer, 0.5) is False  # the fit goes on
    return {"steps": step}


def told(step, steps=100, key="k"):
    return 0.0, {"key": key, "step": step, "steps": steps}


def test_outside_a_worker_nothing_is_told():
    assert tell_steps() is None


def test_the_steps_of_a_cell_are_shown_where_the_grid_was_started(tmp_path, threads, monkeypatch, capsys):
    monkeypatch.setattr(running, "SECONDS", 0.0)
    rows = run_grid([{"x": 1}], count_to_four, tmp_path / "g.jsonl", scheduler=threads, name=lambda _: "one")
    assert rows[0]["result"] == {"steps": 4}
    said = capsys.readouterr()
    assert said.err.splitlines() == [f"one: {step} of 4 steps" for step in (1, 2, 3)]
    assert "1 of 1: one" in said.out.splitlines()


def test_a_cell_tells_no_more_often_than_it_should(tmp_path, threads, monkeypatch, capsys):
    monkeypatch.setattr(running, "SECONDS", 1e6)
    run_grid([{"x": 1}], count_to_four, tmp_path / "g.jsonl", scheduler=threads, name=lambda _: "one")
    assert capsys.readouterr().err == "one: 1 of 4 steps\n"


def test_without_a_terminal_each_quarter_is_a_line(capsys):
    shown = Running()
    shown.begin("k", "fern")
    for step in (1, 10, 24, 26, 30, 60, 90, 99, 100):
        shown.hear(told(step))
    shown.hear(told(50, key="of another run"))
    shown.end("k")
    shown.hear(told(50))  # too late
    assert capsys.readouterr().err.splitlines() == [f"fern: {step} of 100 steps" for step in (26, 60, 90)]


def test_on_a_terminal_each_cell_is_a_bar_until_it_is_done(monkeypatch):
    pytest.importorskip("tqdm")
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    shown = Running(lambda line: screen.write(f"{line}\n"))
    for key in ("a", "b"):
        shown.begin(key, f"cell {key}")
    shown.hear(told(30, key="a"))
    bar = shown._cells["a"].bar
    assert (bar.n, bar.total) == (30, 100)
    shown.hear(told(2, key="a"))  # its worker died, and another one does it
    assert (bar.n, bar.total) == (2, 100)
    shown.say("a line")
    for key in ("a", "b"):
        shown.end(key)
    assert bar.disable  # closed
    assert "cell a" in screen.getvalue()
    assert "cell b" in screen.getvalue()

"""The option `--tables=FOLDER`: a run of the tests ends with tables of what they found, printed and written there.

    pytest tests/fuzz tests/faults -m "" --tables=docs/results

A test leaves a row with `record_property(table, row)`, with or without pytest-xdist. Of rows with the same first column
the one with the most trials is shown, so that the slow tests replace what the fast ones found.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

from kgs.bench.output import markdown_table, write_csv
from kgs.fit.outputs import versions

__all__ = ["pytest_addoption", "pytest_configure", "pytest_terminal_summary"]

Row = dict[str, Any]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--tables",
        type=Path,
        metavar="FOLDER",
        help="print the tables of damaged files and of faults, and write them as Markdown, CSV and JSON into FOLDER",
    )


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("tables") and config.inipath is None:  # pytest took FOLDER for tests and looked there for it
        raise pytest.UsageError("expected --tables=FOLDER with its equals sign, in the root of the repository")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    folder = terminalreporter.config.getoption("tables")
    if folder is None:
        return
    reports = [report for group in terminalreporter.stats.values() for report in group]
    found = [p for r in reports if isinstance(r, pytest.TestReport) and r.when == "call" for p in r.user_properties]
    for name, make in _TABLES.items():
        rows = _of_most_trials(row for table, row in found if table == name)
        if rows:
            (folder / name).mkdir(parents=True, exist_ok=True)
            path = folder / name / name
            path.with_suffix(".md").write_text(text := make(rows), encoding="utf-8")
            content = json.dumps({"rows": rows, "versions": versions()}, indent=1)
            path.with_suffix(".json").write_text(content + "\n", encoding="utf-8")
            write_csv(path.with_suffix(".csv"), rows)
            terminalreporter.write_line(text)


def _of_most_trials(rows: Iterable[Row]) -> list[Row]:
    kept: dict[str, Row] = {}
    for row in rows:
        name, trials, *_ = row.values()
        if name not in kept or trials > list(kept[name].values())[1]:
            kept[name] = row
    return [kept[name] for name in sorted(kept, key=str.casefold)]


def _hostile(rows: list[Row]) -> str:
    def mib(value: int | None) -> str:
        return "not measured" if value is None else f"{value / 2**20:.1f}"

    counts = ("tried", "sound", "DataError", "other")
    lines = [
        [r["reader"], *(r[key] for key in counts), r["slowest_s"], mib(r["memory"]), mib(r["allowed"])] for r in rows
    ]
    memory = max((row["memory"] for row in rows if row["memory"] is not None), default=None)
    total = [sum(row[key] for row in rows) for key in counts]
    lines.append(["all", *total, max(row["slowest_s"] for row in rows), mib(memory), ""])
    title = (
        "Damaged files (valid ones with seeded changes): loaded with sound numbers, refused with DataError, or other"
    )
    heads = ("tried", "loaded, sound", "DataError", "other", "slowest [s]", "memory [MiB]", "allowed [MiB]")
    return markdown_table(title, heads, lines, first="reader")


def _faults(rows: list[Row]) -> str:
    heads = ("trials", "lost", "what was found", "verdict")
    return markdown_table("Faults of long fits", heads, [list(row.values()) for row in rows], first="fault")


_TABLES: dict[str, Callable[[list[Row]], str]] = {"hostile": _hostile, "faults": _faults}

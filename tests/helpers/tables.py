"""The option `--tables=FOLDER`: a run of the tests ends with tables of what they found, printed and written there.

    pytest tests/faults tests/stiff -m "" --tables=docs/results

A test leaves a row with `record_property(table, row)`, with or without pytest-xdist. Of rows with the same name the one
with the most trials is shown, so that the slow tests replace what the fast ones found.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from kgs.bench.output import markdown_table, write_results

Row = dict[str, Any]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--tables",
        type=Path,
        metavar="FOLDER",
        help="print the tables of tests/faults and stiff, and write them as Markdown and CSV into FOLDER",
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
    for name, (subfolder, make) in _TABLES.items():
        if rows := [row for table, row in found if table == name]:
            path = folder / subfolder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            rows = _of_most_trials(rows)
            write_results(path, rows, make(rows, path))


def _of_most_trials(rows: list[Row]) -> list[Row]:
    """One row per name, sorted by it; rows without trials are left as they came."""
    if "trials" not in rows[0]:
        return rows
    kept: dict[str, Row] = {}
    for row in sorted(rows, key=lambda row: (row["name"].casefold(), row["trials"])):
        kept[row["name"]] = row
    return list(kept.values())


def _faults(rows: list[Row], _: Path) -> str:
    heads = ("trials", "lost", "what was found", "verdict")
    return markdown_table("Faults of long fits", heads, [list(row.values()) for row in rows], first="fault")


def _bits(rows: list[Row], _: Path) -> str:
    heads = ("what is stiff", "float32", "float64", "treatment")
    lines = [[f"{x:.0e}" if isinstance(x, float) else x for x in row.values()] for row in rows]
    return markdown_table("Largest difference of images and gradients, which must be 0", heads, lines, first="case")


def _flatness(rows: list[Row], _: Path) -> str:
    lines = [[row["name"], *(f"{value:.1e}" for value in list(row.values())[2:])] for row in rows]
    return markdown_table("Largest difference between float32 images", list(rows[0])[2:], lines)


def _projection(rows: list[Row], path: Path) -> str:
    """Also plots."""
    from matplotlib.figure import Figure

    figure, angles = Figure(figsize=(9, 3.8), layout="constrained"), {row["angle"]: [] for row in rows}
    for row in rows:
        angles[row["angle"]].append(row)
    names = {"covariance_error": "relative error of the covariance", "mean_error_sigmas": "error of the mean [sigma]"}
    for axis, (column, label) in zip(figure.subplots(1, 2), names.items(), strict=True):
        for angle in list(angles)[column == "mean_error_sigmas" :]:  # on the axis the mean is exact
            x, y = zip(*((row["sigma_over_z"], row[column]) for row in angles[angle]), strict=True)
            axis.loglog(x, y, "o-", label=f"{angle}°")
        axis.set(xlabel="sigma / z", ylabel=label)
        axis.legend(title="off axis")
    figure.savefig(path.with_suffix(".png"), dpi=120)
    sigmas = [row["sigma_over_z"] for row in next(iter(angles.values()))]
    lines = [[f"{angle}°", *(f"{row['covariance_error']:.1e}" for row in of)] for angle, of in angles.items()]
    changes = [max(row["quadrature_change"] for row in rows if row["sigma_over_z"] == sigma) for sigma in sigmas]
    lines.append(["change with 4 for 5 quadrature nodes", *(f"{value:.0e}" for value in changes)])
    title = "First-order footprint: relative error of the covariance by angle and sigma / z"
    return markdown_table(title, sigmas, lines)


_TABLES: dict[str, tuple[str, Callable[[list[Row], Path], str]]] = {  # by folder
    "faults": ("faults", _faults),
    "bits": ("extremes", _bits),
    "projection": ("precision", _projection),
    "flatness": ("precision", _flatness),
}

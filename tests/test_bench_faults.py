"""Fits that are killed, terminated and short of disk lose nothing."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from kgs.bench.faults import measure_faults

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="limits and signals of POSIX, memory from /proc"),
]


def test_nothing_is_lost(tmp_path: Path) -> None:
    result = measure_faults(tmp_path, say=lambda line: None)
    assert [row for row in result["rows"] if row["verdict"] != "met"] == []
    kills = result["rows"][0]
    assert (kills["trials"], kills["lost"]) == (30, 0)
    assert {"faults.csv", "faults.json", "faults.md"} <= {path.name for path in tmp_path.iterdir()}

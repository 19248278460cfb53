"""`import kgs` makes the threads of torch that wait sleep, where torch is not there yet and the user said nothing."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import contextlib, os, sys, types
{before}
with contextlib.suppress(ImportError):  # without site-packages there is no torch, which would take seconds
    import kgs
print(os.environ.get("OMP_WAIT_POLICY"))
"""


@pytest.mark.parametrize(
    ("variables", "before", "expected"),
    [
        ({}, "", "PASSIVE"),
        ({}, "sys.modules['torch'] = types.ModuleType('torch')", "None"),
        ({"OMP_WAIT_POLICY": "ACTIVE"}, "", "ACTIVE"),
        ({"GOMP_SPINCOUNT": "1000"}, "", "None"),
    ],
)
def test_the_policy_is_set_before_torch_is_loaded(variables, before, expected):
    kept = {name: value for name, value in os.environ.items() if name not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    run = [sys.executable, "-S", "-c", PROGRAM.format(before=before)]
    done = subprocess.run(
        run, cwd=Path(__file__).parents[2], env=kept | variables, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == expected

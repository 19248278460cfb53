"""Torch's waiting threads sleep where a program asks for it and the user said nothing; `import kgs` changes nothing."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import os, sys, types
{before}
import kgs
before = os.environ.get("OMP_WAIT_POLICY")
print(kgs.wait_passively(), before, os.environ.get("OMP_WAIT_POLICY"))
"""


@pytest.mark.parametrize(
    ("variables", "before", "expected"),
    [
        ({}, "", "True None PASSIVE"),
        ({}, "sys.modules['torch'] = types.ModuleType('torch')", "False None None"),
        ({"OMP_WAIT_POLICY": "ACTIVE"}, "", "False ACTIVE ACTIVE"),
        ({"GOMP_SPINCOUNT": "1000"}, "", "False None None"),
    ],
)
def test_the_policy_is_set_before_torch_is_loaded(variables, before, expected):
    kept = {name: value for name, value in os.environ.items() if name not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    run = [sys.executable, "-c", PROGRAM.format(before=before)]
    done = subprocess.run(
        run, cwd=Path(__file__).parents[2], env=kept | variables, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == expected

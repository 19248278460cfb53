"""The wheel, as someone without this repository gets it: every module and data file is in it, and can be imported."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = {"kgs": "kgs", "losses": "kgs/losses", "datasets": "kgs/datasets"}  # in the repository, in the wheel
IMPORT_ALL = """
import importlib, pkgutil, sys
import kgs
for found in pkgutil.walk_packages(kgs.__path__, "kgs."):
    if found.name != "kgs.__main__":
        importlib.import_module(found.name)
print(*(module.__file__ for name, module in sys.modules.items() if name.split(".")[0] == "kgs"), sep="\\n")
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel of this checkout, built in a copy, so that no former build can lend it files."""
    copy = tmp_path_factory.mktemp("copy")
    for name in FOLDERS:
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("setup.cfg", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy / name)
    code = "from setuptools import build_meta; build_meta.build_wheel('.')"
    done = subprocess.run([sys.executable, "-c", code], cwd=copy, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return next(copy.glob("*.whl"))


def test_every_file_of_the_packages_is_in_it(wheel):
    expected = set()
    for folder, target in FOLDERS.items():
        files = [path for path in (ROOT / folder).rglob("*") if path.is_file() and "__pycache__" not in path.parts]
        expected |= {f"{target}/{path.relative_to(ROOT / folder).as_posix()}" for path in files}
    inside = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert inside == expected, "setup.cfg: packages or package_data"


def test_every_module_can_be_imported_from_it(wheel, tmp_path):
    pytest.importorskip("numba")
    site = tmp_path / "site"
    zipfile.ZipFile(wheel).extractall(site)
    environment = os.environ | {"PYTHONPATH": str(site), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "-c", IMPORT_ALL], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    modules = {Path(line).relative_to(site).as_posix() for line in done.stdout.split()}
    assert modules >= {name for name in zipfile.ZipFile(wheel).namelist() if name.endswith(".py")} - {"kgs/__main__.py"}

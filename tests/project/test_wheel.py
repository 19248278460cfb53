"""The wheel, as someone without this repository gets it: every module and data file is in it, and can be imported."""

import email
import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = {"kgs": "kgs", "losses": "kgs/losses", "datasets": "kgs/datasets"}  # in the repository, in the wheel
FILES = ("README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff")
IMPORT_ALL = """
import importlib, pkgutil, sys
import kgs
for found in pkgutil.walk_packages(kgs.__path__, "kgs."):
    if found.name != "kgs.__main__":
        importlib.import_module(found.name)
print(*(module.__file__ for name, module in sys.modules.items() if name.split(".")[0] == "kgs"), sep="\\n")
"""


def build(kind, folder):
    """The path of the wheel or sdist of this folder."""
    code = f"from setuptools import build_meta; build_meta.build_{kind}('.')"
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return next(folder.glob("*.whl" if kind == "wheel" else "*.tar.gz"))


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """What packages are built of, copied, so that no former build can lend files."""
    copy = tmp_path_factory.mktemp("copy")
    for name in FOLDERS:
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "tests/project").mkdir(parents=True)
    for name in (*FILES, "setup.cfg", "pyproject.toml", "MANIFEST.in", "tests/project/test_wheel.py"):
        shutil.copy(ROOT / name, copy / name)
    return copy


@pytest.fixture(scope="module")
def wheel(copy):
    """The wheel of this checkout."""
    return build("wheel", copy)


def test_every_file_of_the_packages_is_in_it(wheel):
    expected = set()
    for folder, target in FOLDERS.items():
        files = [path for path in (ROOT / folder).rglob("*") if path.is_file() and "__pycache__" not in path.parts]
        expected |= {f"{target}/{path.relative_to(ROOT / folder).as_posix()}" for path in files}
    inside = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert inside == expected, "setup.cfg: packages or package_data"


def test_the_sdist_makes_the_same_wheel(copy, wheel, tmp_path):
    with tarfile.open(build("sdist", copy)) as archive:
        safe = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}  # Python 3.11.4
        archive.extractall(tmp_path, **safe)
    (source,) = tmp_path.iterdir()
    assert {path.name for path in source.iterdir() if path.is_file()} > set(FILES)
    assert not (source / "tests").exists(), "some of the tests, which need the others, would be there"
    names = [zipfile.ZipFile(path).namelist() for path in (wheel, build("wheel", source))]
    assert sorted(names[0]) == sorted(names[1])


def test_what_an_index_shows_of_it(wheel):
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
        metadata = email.message_from_string(archive.read(name).decode())
    assert (metadata["Name"], metadata["License-Expression"] or metadata["License"]) == ("kgs-splat", "Apache-2.0")
    assert metadata.get_all("License-File") == ["LICENSE", "kgs/app/demo_photos/LICENSE"]  # MIT, of the photos
    assert metadata["Requires-Python"] == ">=3.11"
    assert metadata["Description-Content-Type"].startswith("text/markdown")
    assert metadata.get_payload().strip() == (ROOT / "README.md").read_text(encoding="utf-8").strip()
    assert len(metadata["Summary"]) <= 512  # what an index takes
    kinds = {line.partition(" ::")[0] for line in metadata.get_all("Classifier")}
    assert {"Development Status", "Intended Audience", "Programming Language", "Topic", "Typing"} <= kinds
    assert metadata["Author"]


@pytest.mark.slow  # all modules are imported from the checkout, and all their files are in the wheel
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

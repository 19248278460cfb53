"""The documentation: its code runs, it names every public name, the site builds, the citation is sound."""

import configparser
import doctest
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = {"kgs": "kgs", "losses": "kgs.losses", "datasets": "kgs.datasets"}
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
GIVEN = """
import torch, kgs
from factories import random_scene
gaussians, cameras = random_scene(0, torch.float32, sh_degree=None)
means, quats, scales, colors = gaussians.means, gaussians.quats, gaussians.scales, gaussians.colors
opacities, logits, total = gaussians.opacities, gaussians.opacities.logit(), 3
viewmats, Ks, width, height = cameras.extrinsics, cameras.intrinsics[:, :3, :3], 56, 40
your_rasteriser = lambda *tensors: kgs.GaussianRenderer()(kgs.Gaussians(*tensors), cameras).image
"""  # what the README takes as the reader's own
API = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs" / "api").glob("*.md"))


def test_every_public_name_has_a_place_among_the_api_pages():
    shown = re.findall(r"^::: ([\w.]+)$", API, re.M)
    assert len(set(shown)) == len(shown)
    for module in ("kgs", "kgs.losses", "kgs.datasets", "kgs.fit", "kgs.reference"):
        assert module in shown or {f"{module}.{name}" for name in importlib.import_module(module).__all__} <= set(shown)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_its_python_runs(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(GIVEN, names)
    for block in re.findall(r"^```python\n(.*?)^```", path.read_text(encoding="utf-8"), re.M | re.S):
        exec(compile(block, path.name, "exec"), names)


WITH_EXAMPLES = [
    ".".join([PACKAGES[path.parts[0]], *path.with_suffix("").parts[1:]]).removesuffix(".__init__")
    for folder in PACKAGES
    for path in (file.relative_to(ROOT) for file in sorted((ROOT / folder).rglob("*.py")))
    if re.search(r">>> (?!.*\+SKIP)", (ROOT / path).read_text(encoding="utf-8"))
]


@pytest.mark.parametrize("module", WITH_EXAMPLES)
def test_the_examples_of_docstrings_do_what_they_say(module, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = doctest.testmod(importlib.import_module(module))
    assert found.attempted
    assert not found.failed


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings")
    pytest.importorskip("mkdocs_jupyter")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", tmp_path / "site"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    pages = {path.parent.name for path in (tmp_path / "site").rglob("index.html")}
    assert {path.stem for path in (ROOT / "notebooks").glob("*.ipynb")} <= pages


def test_the_citation_is_of_this_version():
    yaml = pytest.importorskip("yaml")
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg", encoding="utf-8")
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["cff-version"] == "1.2.0"
    assert citation["type"] == "software"
    assert citation["version"] == config["metadata"]["version"]
    assert citation["license"] == config["metadata"]["license"]
    assert {"message", "title", "authors", "abstract"} <= set(citation)
    assert all({"type", "title", "authors"} <= set(reference) for reference in citation["references"])

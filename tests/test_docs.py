"""The documentation: its code runs, it names every public name, the site builds, the citation is sound."""

import configparser
import doctest
import importlib
import json
import re
import shutil
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


# -- links -----------------------------------------------------------------------------------------------------------


def outside_of_code(text):
    return re.sub(r"`[^`\n]*`", "", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S))


def text_of(path):
    """The Markdown of a page or of a notebook's cells."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown"]
        text = "\n\n".join("".join(cell["source"]) for cell in cells)
    return text


def links(text):
    """Where links and images lead, but for other sites."""
    found = re.findall(r"\]\(([^)\s]+)\)", outside_of_code(text))
    found += re.findall(r"^\[[^\]]+\]: (\S+)", outside_of_code(text), re.M)
    found += re.findall(r"<(?:a|img)\b[^>]*?\b(?:href|src)=\"([^\"]+)\"", outside_of_code(text))
    return [link for link in found if not re.match(r"[a-z]+:", link)]


def anchors(path):
    """Names of the headings, as GitHub and the site make them; those of notebooks keep capitals."""
    headings = re.findall(r"^#+ (.+)$", re.sub(r"^```.*?^```", "", text_of(path), flags=re.M | re.S), re.M)
    if path.suffix == ".ipynb":
        return {heading.strip().replace(" ", "-") for heading in headings}
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


LINKING = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "notebooks").glob("*.ipynb")]


@pytest.mark.parametrize("path", LINKING, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_its_links_lead_somewhere(path):
    missing = []
    for link in links(text_of(path)):
        place, _, anchor = link.partition("#")
        target = path.parent / place if place else path
        inside = target.resolve().is_relative_to(ROOT) and target.exists()
        if not inside or (anchor and anchor not in anchors(target)):
            missing.append(link)
    assert not missing


def test_links_are_found():
    text = "![a](b.png) [c\nd](e.md#f) `[g](h)` [i](https://j.k) <img alt='' src=\"l.png\">\n\n```\n[m](n)\n```\n"
    assert links(text) == ["b.png", "e.md#f", "l.png"]
    assert "against-given-poses" in anchors(ROOT / "docs" / "photos.md")


@pytest.mark.skipif(shutil.which("sed") is None, reason="no sed")
def test_the_readme_of_a_published_package_links_to_the_repository(tmp_path):
    """As CONTRIBUTING.md has it, in its own words."""
    shutil.copy(ROOT / "README.md", tmp_path)
    (block,) = re.findall(r"^(REPOSITORY=.*?README\.md\n)", (ROOT / "CONTRIBUTING.md").read_text(), re.M | re.S)
    before = (ROOT / "README.md").read_text(encoding="utf-8")
    subprocess.run(["sh", "-ec", block], cwd=tmp_path, check=True)
    after = (tmp_path / "README.md").read_text(encoding="utf-8")
    assert not links(after)
    made = re.findall(r"https://github.com/OWNER/kgs/(raw|blob)/v[\d.]+/([^)#]+)", after)
    assert sorted(place for _, place in made) == sorted(link.partition("#")[0] for link in links(before))
    shown = {place for kind, place in made if kind == "raw"}  # what a browser has to show as it is
    assert shown == {place for _, place in made if place.endswith((".jpg", ".png", ".html"))} > {"docs/demo.png"}
    assert re.sub(r"https://github.com/OWNER/kgs/(raw|blob)/v[\d.]+/", "", after) == before


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

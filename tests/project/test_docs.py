"""The documentation: its code runs, it names every public name, the site builds, the citation is sound."""

import configparser
import doctest
import importlib
import json
import re
import shutil
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import lpips_package
import pytest
import torch
from tiny_scenes import narrow_lpips

import kgs
from kgs.metrics.lpips import Lpips

ROOT = Path(__file__).parents[2]
PACKAGES = {"kgs": "kgs", "losses": "kgs.losses", "datasets": "kgs.datasets"}
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SNIPPETS = sorted((ROOT / "docs" / "snippets").glob("*.py"))
API = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs" / "api").glob("*.md"))


def test_every_public_name_has_a_place_among_the_api_pages():
    shown = re.findall(r"^::: ([\w.]+)$", API, re.M)
    assert len(set(shown)) == len(shown)
    for module in ("kgs", "kgs.losses", "kgs.datasets", "kgs.fit", "kgs.reference"):
        assert module in shown or {f"{module}.{name}" for name in importlib.import_module(module).__all__} <= set(shown)


def python_of(path):
    """The Python that a page shows, in its blocks; `py` marks lines for the code of other projects."""
    return re.findall(r"^```python\n(.*?)^```", path.read_text(encoding="utf-8"), re.M | re.S)


def test_the_python_of_the_pages_is_that_of_the_snippets():
    shown = [block for path in PAGES for block in python_of(path)]
    assert set(shown) == {path.read_text(encoding="utf-8") for path in SNIPPETS}


@pytest.mark.parametrize("path", SNIPPETS, ids=lambda path: path.stem)
def test_a_snippet_runs_as_pasted(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "lpips", lpips_package)
    exec(compile(path.read_text(encoding="utf-8"), path.name, "exec"), {})


def test_the_recipe_of_the_weights_of_lpips_makes_files_that_are_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "lpips", lpips_package)
    (recipe,) = python_of(ROOT / "docs" / "command.md")
    names: dict[str, object] = {}
    with narrow_lpips():
        exec(recipe, names)
        read = Lpips.load("WEIGHTS").state_dict()
    for name, value in names["arrays"].items():
        if name.startswith("net."):
            assert torch.equal(torch.from_numpy(value), read[f"features.{name.partition('.')[2].partition('.')[2]}"])
        elif name.startswith("lin") and name[3].isdigit():
            assert torch.equal(torch.from_numpy(value).flatten(), read[name[:4]])


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


# -- pages ----------------------------------------------------------------------------------------------------------


def test_each_page_of_the_guide_leads_to_the_next():
    yaml = pytest.importorskip("yaml")
    site = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    (guide,) = [section["Guide"] for section in site["nav"] if "Guide" in section]
    entries = [entry for page in guide for entry in page.items()]
    assert [name.split()[0] for name, _ in entries] == sorted(name.split()[0] for name, _ in entries)
    for (name, page), (_, following) in pairwise(entries):
        text = (ROOT / "docs" / page).read_text(encoding="utf-8").rstrip()
        assert text.startswith(f"# {name.split()[0]}. "), page
        assert re.fullmatch(rf"Next: \[.+\]\({following}\)\.", text.splitlines()[-1]), page


def test_each_folder_of_results_says_what_made_it():
    results = ROOT / "docs" / "results"
    folders = {path.name for path in results.iterdir() if path.is_dir()}
    rows = re.findall(r"^\| (\[.+) \| (.+) \|$", (results / "README.md").read_text(encoding="utf-8"), re.M)
    assert {folder for names, _ in rows for folder in re.findall(r"\]\(([\w-]+)/", names)} == folders
    assert all("`" in command for _, command in rows)
    for script in re.findall(r"python (docs/results/\S+\.py)", " ".join(command for _, command in rows)):
        assert (ROOT / script).is_file()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("folder", "packages"),
    [("starts", ()), ("training", ("pandas", "distributed"))],
)
def test_the_script_of_a_table_of_results_runs(folder, packages, tmp_path):
    for package in packages:
        pytest.importorskip(package)
    script = ROOT / "docs" / "results" / folder / "measure.py"
    done = subprocess.run(
        [sys.executable, script, "--out", tmp_path, "--quick"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / f"{folder}.md").is_file()


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
        name, _, anchor = link.partition("#")
        target = path.parent / name if name else path
        inside = target.resolve().is_relative_to(ROOT) and target.exists()
        if not inside or (anchor and anchor not in anchors(target)):
            missing.append(link)
    assert not missing


@pytest.mark.parametrize("path", LINKING, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_its_lists_begin_below_an_empty_line(path):
    """Else the site runs their items together in one paragraph."""
    text = re.sub(r"^```.*?^```", "", text_of(path), flags=re.M | re.S)
    assert not re.findall(r"^(?![-*] |\d+\. |[ #|]).+\n(?:[-*]|\d+\.) .*$", text, re.M)


@pytest.mark.skipif(shutil.which("sed") is None, reason="no sed")
def test_the_readme_of_a_published_package_links_to_the_repository(tmp_path):
    """By the commands in CONTRIBUTING.md."""
    (block,) = re.findall(r"^(REPOSITORY=.*?README\.md\n)", (ROOT / "CONTRIBUTING.md").read_text(), re.M | re.S)
    shutil.copy(ROOT / "README.md", tmp_path)
    subprocess.run(["sh", "-ec", block], cwd=tmp_path, check=True)
    before, after = ((folder / "README.md").read_text(encoding="utf-8") for folder in (ROOT, tmp_path))
    address = r"https://github.com/OWNER/kgs/(raw|blob)/v[\d.]+/"
    assert not links(after)
    assert re.sub(address, "", after) == before
    made = {path: kind for kind, path in re.findall(address + r"([^)#]+)", after)}
    assert made.keys() == {link.partition("#")[0] for link in links(before)}
    for path, kind in made.items():  # raw: what a browser has to show as it is
        assert kind == ("raw" if path.endswith((".jpg", ".png", ".webp", ".html")) else "blob"), path


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
    assert citation["version"] == config["metadata"]["version"] == kgs.__version__
    assert citation["license"] == config["metadata"]["license"]
    assert {"message", "title", "authors", "abstract"} <= set(citation)
    assert all({"type", "title", "authors"} <= set(reference) for reference in citation["references"])

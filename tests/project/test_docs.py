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
from kgs.fit.config import DETAILS, DROP, PRESETS, FitConfig
from kgs.fit.haze import FRONT, HAZE, WINDOW
from kgs.fit.overlap import MAX_STEPS, STEPS_OF_A_PHOTO
from kgs.fit.plan import MANY as USUAL
from kgs.fit.plan import with_step_defaults
from kgs.init_points.dense import MAX_POINTS, MAX_POINTS_FEW_VIEWS, MIN_POINTS, PIXELS_OF_A_POINT
from kgs.metrics.lpips import Lpips

ROOT = Path(__file__).parents[2]
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
    monkeypatch.setitem(sys.modules, "lpips", lpips_package)
    names: dict[str, object] = {}
    exec(GIVEN, names)
    for block in re.findall(r"^```python\n(.*?)^```", path.read_text(encoding="utf-8"), re.M | re.S):
        exec(compile(block, path.name, "exec"), names)


def test_the_recipe_of_the_weights_of_lpips_makes_files_that_are_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "lpips", lpips_package)
    text = (ROOT / "docs" / "command.md").read_text(encoding="utf-8")
    (recipe,) = re.findall(r"^```python\n(.*?import lpips.*?)^```", text, re.M | re.S)
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


# -- numbers ---------------------------------------------------------------------------------------------------------

AUTO, PAPER, LOW, HIGH = FitConfig(), PRESETS["paper"], DETAILS["low"], DETAILS["high"]
FEW, MANY = with_step_defaults(AUTO, 3), with_step_defaults(AUTO, 4)  # the default for up to three views, and for more
STEPS_OF_BOTH = [FEW.steps, MAX_STEPS]
# A page, what it says with a # for each number, and these numbers.
NUMBERS = [
    ("README.md", "DropGaussian(p=#)", [PAPER.drop]),
    ("README.md", "whose rate grows to #, it gains", [DROP]),
    ("docs/layer.md", "The paper has p = #", [PAPER.drop]),
    ("docs/layer.md", "is p = #, with nothing dropped in the last #", [DROP, AUTO.no_drop_steps]),
    ("docs/comparison.md", "steps of a full run | # for up to three photos, up to # for more", STEPS_OF_BOTH),
    (
        "docs/comparison.md",
        "initial points, of which there are # to #, or #",
        [MIN_POINTS, MAX_POINTS, MAX_POINTS_FEW_VIEWS],
    ),
    ("docs/how-to-photograph.md", "A fit takes # steps for up to three photos and [up to # for more", STEPS_OF_BOTH),
    ("docs/measured.md", "three seeds): # steps from # of the same", [PAPER.steps, PAPER.init_points]),
    ("docs/command.md", "| low | # | # | #, the", [LOW.size, LOW.entries["init_points"], LOW.entries["steps"]]),
    ("docs/command.md", "# to #, one for every # pixels", [MIN_POINTS, MAX_POINTS, PIXELS_OF_A_POINT]),
    ("docs/command.md", "three photos to # | # for up to three photos, for", [MAX_POINTS_FEW_VIEWS, FEW.steps]),
    ("docs/command.md", "for more [# to #]", STEPS_OF_BOTH),
    ("docs/command.md", "| normal | # for unposed", [DETAILS["normal"].size]),
    ("docs/how-to-photograph.md", "and fitted at # on a CPU", [DETAILS["normal"].size]),
    ("docs/photos.md", "takes them at # pixels on a CPU", [DETAILS["normal"].size]),
    ("docs/command.md", "| high | #, also of photos with poses", [HIGH.size]),
    ("docs/command.md", "`normal` leaves at their own size | # |", [HIGH.entries["init_points"]]),
    ("docs/recipe.md", "times # (up to three", [FEW.recipe.opacity_decay]),
    ("docs/recipe.md", "or # after every step, from # % of", [MANY.recipe.opacity_decay, 100 * AUTO.recipe.decay_from]),
    ("docs/recipe.md", "| steps | #, here # | # for up", [PAPER.recipe.steps, PAPER.steps, FEW.steps]),
    ("docs/recipe.md", "for up to three photos; for more, up to #", [MAX_STEPS]),
    ("docs/recipe.md", "**Steps**: #, and # more for each", [FEW.steps, STEPS_OF_A_PHOTO]),
    ("docs/recipe.md", "have no patches: then there are # steps", [USUAL.steps]),
    ("docs/recipe.md", "by # in a window of #x7", [HAZE, WINDOW]),
    ("docs/recipe.md", "lie nearer than # times the median", [FRONT]),
    ("docs/recipe.md", "| initial points | # of", [PAPER.init_points]),
    (
        "docs/recipe.md",
        "every # pixels on whose depth two views agree, # to #",
        [PIXELS_OF_A_POINT, MIN_POINTS, MAX_POINTS],
    ),
    ("docs/recipe.md", "(up to three photos to #), each", [MAX_POINTS_FEW_VIEWS]),
    ("docs/recipe.md", "| scales #, quaternions # | scales", [PAPER.recipe.lr_scales, PAPER.recipe.lr_quats]),
    ("docs/recipe.md", "| scales #, quaternions # | in", [AUTO.recipe.lr_scales, AUTO.recipe.lr_quats]),
    ("docs/recipe.md", "L1 + # (1 - SSIM) | L1 + # (1", [PAPER.recipe.dssim_weight, AUTO.recipe.dssim_weight]),
    ("docs/recipe.md", "centre exceeds # |", [PAPER.recipe.grad_threshold]),
    ("docs/recipe.md", "(AbsGS) exceeds # |", [AUTO.recipe.grad_threshold]),
    ("docs/recipe.md", "opacities below # | opacities", [PAPER.recipe.prune_opacity]),
    ("docs/recipe.md", "| opacities below # | they fade", [AUTO.recipe.prune_opacity]),
    ("docs/recipe.md", "| # t/T to the end | # t/T, none", [PAPER.drop, DROP]),
    ("docs/recipe.md", "none in the last # steps", [AUTO.no_drop_steps]),
    ("notebooks/03_three_views.ipynb", "`kgs fit` takes # steps on larger photos", [FEW.steps]),
    ("notebooks/03_three_views.ipynb", "with a drop rate that grows to #", [DROP]),
    ("docs/departures.md", "| # x the 1st percentile", [PAPER.recipe.near_plane]),
]


@pytest.mark.parametrize(("page", "text", "numbers"), NUMBERS)
def test_numbers_of_the_settings_are_those_of_the_code(page, text, numbers):
    pattern = re.escape(text).replace(r"\#", r"(\d+(?: \d{3})*(?:\.\d+)?)").replace(r"\ ", r"\s+")
    found = re.search(pattern, (ROOT / page).read_text(encoding="utf-8"))
    assert found, "the page does not say so"
    assert [float(number.replace(" ", "")) for number in found.groups()] == pytest.approx(numbers)


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


def test_links_are_found():
    text = "![a](b.png) [c\nd](e.md#f) `[g](h)` [i](https://j.k) <img alt='' src=\"l.png\">\n\n```\n[m](n)\n```\n"
    assert links(text) == ["b.png", "e.md#f", "l.png"]
    assert "against-given-poses" in anchors(ROOT / "docs" / "results" / "cameras" / "photos.md")


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
    assert sorted(path for _, path in made) == sorted(link.partition("#")[0] for link in links(before))
    shown = {path for kind, path in made if kind == "raw"}  # what a browser has to show as it is
    assert shown == {path for _, path in made if path.endswith((".jpg", ".png", ".html"))} > {"docs/demo.html"}
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
    assert citation["version"] == config["metadata"]["version"] == kgs.__version__
    assert citation["license"] == config["metadata"]["license"]
    assert {"message", "title", "authors", "abstract"} <= set(citation)
    assert all({"type", "title", "authors"} <= set(reference) for reference in citation["references"])

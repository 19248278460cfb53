"""Makes pages of what lives outside docs/ (README, CHANGELOG, CONTRIBUTING, notebooks) and shows mkdocstrings the code.

mkdocstrings reads sources without importing them, so it does not know that `losses/` is installed as `kgs.losses`:
it gets a copy of the sources laid out as they are installed, without the roles of Sphinx, which it would show as text.
"""

import re
import shutil
import tempfile
from pathlib import Path

from mkdocs.plugins import event_priority
from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
PAGES = {"README.md": "index.md", "CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
PACKAGES = {"kgs": "kgs", "losses": "kgs/losses", "datasets": "kgs/datasets"}
FRAME = '<iframe src="demo.html" title="The page of a fit" loading="lazy"></iframe>'
_installed = tempfile.TemporaryDirectory()


@event_priority(100)  # before mkdocstrings makes its handlers
def on_config(config):
    """Copies the sources to where mkdocstrings looks."""
    for folder, target in PACKAGES.items():
        shutil.copytree(ROOT / folder, Path(_installed.name, target), dirs_exist_ok=True)
    for path in Path(_installed.name).rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        path.write_text(re.sub(r":(?:attr|class|func|meth|mod):(?=`)", "", text), encoding="utf-8")
    config.plugins["mkdocstrings"].config.handlers["python"]["paths"] = [_installed.name]
    return config


def moved(text):
    """The text with its links as they are seen from docs/."""
    for name, page in PAGES.items():
        text = text.replace(f"]({name}", f"]({page}")
    return re.sub(r"\]\(docs/", "](", text)


@event_priority(100)  # before mkdocs-jupyter looks for notebooks
def on_files(files, config):
    """Adds the pages and the notebooks."""
    for name, page in PAGES.items():
        text = moved((ROOT / name).read_text(encoding="utf-8"))
        files.append(File.generated(config, page, content=f"---\nhide: [navigation]\n---\n\n{text}"))
    for path in [ROOT / "CITATION.cff", *sorted((ROOT / "notebooks").glob("*.ipynb"))]:
        name = path.relative_to(ROOT).as_posix()
        files.append(File(name, str(ROOT), config.site_dir, config.use_directory_urls))
    return files


def on_page_markdown(markdown, page, config, files):
    """Gives wide tables of results the whole width and links to notebooks their place; the first page has a viewer."""
    if page.file.src_uri == "index.md":
        markdown = re.sub(r"!\[the film of the demo\]\(pictures/film\.webp\)", FRAME, markdown)
    if page.file.src_uri.startswith("results/"):
        page.meta["hide"] = ["toc"]
    return markdown.replace("](../notebooks/", "](notebooks/").replace("](../README.md", "](index.md")

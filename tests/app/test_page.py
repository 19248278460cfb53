"""The HTML of a page: whole, small, without a path of a disk, and honest about what was not measured."""

from __future__ import annotations

import base64
import hashlib
import re
import time
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from factories import batch, random_camera, random_gaussians

import kgs
from kgs.app.files.plot import psnr_plot
from kgs.app.page import PageContent, PagePhotos, PageSplat, PageText, Picture, write_page
from kgs.app.page.figures import facts, measure_table, verdict, without_folders
from kgs.app.page.write import MAX_BYTES

SIZE = (24, 32)
GAUSSIANS = random_gaussians(1000, 0, torch.float32, sh_degree=1)
CAMERAS = batch(*(random_camera(*SIZE, seed, torch.float32) for seed in range(3)))
NAMES = ["a.jpg", "<b>&amp;.jpg", "c.jpg"]


def views(*values: float) -> dict[str, Any]:
    rows = [{"name": NAMES[i], "psnr": value, "ssim": 0.5, "lpips_vgg": None} for i, value in enumerate(values)]
    return {"psnr": sum(values) / len(values), "ssim": 0.5, "lpips_vgg": None, "views": rows}


def content(pictures: list[Picture] | None = None, **words: Any) -> PageContent:
    """A page of three photos, of which the last one was held out; `words` are entries of its text."""
    return PageContent(
        PageSplat(GAUSSIANS, background=torch.zeros(3)),
        PagePhotos(CAMERAS, NAMES, ["training", "training", "test"], pictures or []),
        PageText(**{"title": "a title", **words}),
    )


def write(path: Path, max_bytes: int = MAX_BYTES, **parts: Any) -> str:
    write_page(path, content(**parts), max_bytes)
    return path.read_text(encoding="utf-8")


class Links(HTMLParser):
    """All that a page loads."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.loaded += [str(given[name]) for name in ("src", "srcset", "data", "poster") if name in given]
        self.loaded += [str(given["href"])] if tag == "link" and "href" in given else []


def test_a_page_loads_nothing_and_names_no_path_on_a_disk(tmp_path: Path) -> None:
    settings = {"scene": "/photos/mine/fern", "init_file": "C:\\photos\\mine\\points.ply", "steps": 3}
    report = {"note": "made from /photos/mine/a.jpg and others", "focal": 1.25, "inside": {"left out": ["b.jpg"]}}
    pictures = [Picture(NAMES[1], torch.rand(3, *SIZE), {"": torch.rand(3, *SIZE)})]
    text = write(tmp_path / "index.html", settings=settings, report=report, pictures=pictures, notes=["/photos/x/y"])
    assert all(source.startswith("data:image/jpeg;base64,") for source in Links(text).loaded)
    assert len(Links(text).loaded) == 3
    assert not re.search(r"url\(|@import|https?://(?!www\.w3\.org/2000/svg)", text)
    assert "mine" not in text
    assert "points.ply" in text
    assert "&lt;b&gt;&amp;amp;.jpg" in text
    assert "<b>" not in text
    assert str(tmp_path) not in text


def test_the_policy_names_the_one_script_and_the_one_style_by_their_sha256(tmp_path: Path) -> None:
    pictures = [Picture(NAMES[1], torch.rand(3, *SIZE), {})]
    text = write(tmp_path / "index.html", pictures=pictures)
    hashes = []
    for kind in ("style", "script"):
        (code,) = re.findall(rf"<{kind}>(.*?)</{kind}>", text, re.S)
        hashes.append(base64.b64encode(hashlib.sha256(code.encode()).digest()).decode())
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy"\s+content="(.*?)"', text)
    assert policy == "default-src 'none'; img-src data:; style-src 'sha256-{}'; script-src 'sha256-{}'".format(*hashes)
    tags = re.sub(r"<(style|script)\b.*?</\1>", "", text, flags=re.S)
    assert not re.search(r"<[^>]+\s(style|on\w+)=", tags)  # a hash covers no attribute


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ("training training training", "Three photos."),
        ("training training test", "Two photos, one more held out."),
        ("training test test", "One photo, two more held out."),
        ("test test test", "Three photos."),
    ],
)
def test_it_begins_with_the_photos_of_the_fit(tmp_path: Path, parts: str, words: str) -> None:
    page = replace(content(), photos=PagePhotos(CAMERAS, NAMES, parts.split()))
    write_page(tmp_path / "a.html", page)
    assert f"<p>{words} Drag to look around.<" in (tmp_path / "a.html").read_text(encoding="utf-8")


def test_no_line_ends_inside_an_option(tmp_path: Path) -> None:
    """In any sentence, and with the rest of it escaped."""
    parts = {"notes": ["a --hold-out <b>"], "remarks": ["see --measure"], "left_out": "by --sh-degree 0"}
    text = write(tmp_path / "a.html", runs={"": {"train": views(33.0)}}, **parts)
    whole = re.findall(r'<span class="option">(.*?)</span>', text)
    assert sorted(whole) == ["--hold-out", "--hold-out", "--measure", "--measure", "--sh-degree"]
    assert "</span> &lt;b&gt;</p>" in text
    assert ".option { white-space: nowrap }" in text


def strip_of(text: str) -> list[tuple[str, str]]:
    """The camera and the label of each button of the strip."""
    strip = text[text.index('class="strip"') : text.index('class="tools"')]
    return re.findall(r'data-camera="(\d+)".*?aria-label="(.*?)"', strip)


@pytest.mark.parametrize("count", [3, 40])
def test_the_strip_has_thumbnails_of_few_bytes(tmp_path: Path, count: int) -> None:
    """Also of noise, which compresses worst; in the order of names, from the first to the last."""
    names = [f"{(7 * i) % count:02d}.jpg" for i in range(count)]
    cameras = batch(*(random_camera(*SIZE, seed, torch.float32) for seed in range(count)))
    photos = {name: torch.rand(3, 120, 180) for name in names}
    parts = ["test" if name < "02.jpg" else "training" for name in names]
    page = replace(content(), photos=PagePhotos(cameras, names, parts, thumbnails=photos))
    write_page(tmp_path / "a.html", page)
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    loaded = Links(text).loaded
    shown = strip_of(text)
    assert len(loaded) == len(shown) == min(count, 24)
    assert sum(map(len, loaded)) <= 100_000
    numbers = [int(label.split()[1]) for _, label in shown]
    assert [names[int(camera)] for camera, _ in shown] == [f"{number - 1:02d}.jpg" for number in numbers]
    assert (numbers[0], numbers[-1]) == (1, count)
    assert max(numbers[i + 1] - numbers[i] for i in range(len(numbers) - 1)) <= 2
    assert [label.endswith(", held out") for _, label in shown] == [number <= 2 for number in numbers]
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(loaded[0].partition(",")[2]), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] / picture.shape[0] == pytest.approx(1.5, abs=0.03)
    assert "Exif" in text


def test_without_thumbnails_the_strip_has_numbers(tmp_path: Path) -> None:
    text = write(tmp_path / "index.html")
    assert Links(text).loaded == []
    shown = strip_of(text)
    assert [label for _, label in shown] == ["photo 1 of 3", "photo 2 of 3", "photo 3 of 3, held out"]
    assert [NAMES[int(camera)] for camera, _ in shown] == sorted(NAMES)


def test_a_title_is_no_path_and_names_that_are_no_utf8_are_shown_with_escapes(tmp_path: Path) -> None:
    assert "<title>~1900 house, front/back</title>" in write(tmp_path / "a.html", title="~1900 house, front/back")
    page = content(title="\udce9t\udce9")
    page = replace(page, photos=replace(page.photos, names=["\udcff.jpg", "b", "c"]))
    write_page(tmp_path / "a.html", page)
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "<title>\\udce9t\\udce9</title>" in text
    assert "\\udcff.jpg" in text


def test_a_page_says_its_size_and_keeps_to_its_limit(tmp_path: Path) -> None:
    path = tmp_path / "index.html"
    text = write(path)
    assert f"This page has {len(path.read_bytes()) / 1e6:.2f} MB" in text
    smaller = len(path.read_bytes()) - 10_000
    text = write(path, max_bytes=smaller)
    assert len(path.read_bytes()) <= smaller
    assert "This page shows 8-bit numbers" in text
    with pytest.raises(ValueError, match="expected room for a Gaussian"):
        write(path, max_bytes=10_000)


def test_a_photo_without_a_render_has_words_on_exif_and_no_slider(tmp_path: Path) -> None:
    words = "its photos contain no Exif data"
    assert words not in write(tmp_path / "index.html")
    text = write(tmp_path / "index.html", pictures=[Picture(NAMES[0], torch.rand(3, *SIZE))])
    assert words in text
    assert 'class="over"' in text
    assert 'type="range"' not in text  # no slider without a render


def test_the_citation_names_kgs_and_not_the_scene(tmp_path: Path) -> None:
    cited = re.findall(r"@software\{kgs,(.*?)\n\}", write(tmp_path / "index.html"), re.DOTALL)
    assert len(cited) == 1
    assert "a title" not in cited[0]
    assert re.findall(r"(\w+) +=", cited[0]) == ["title", "author", "version"]
    assert "\n\n" not in cited[0]
    assert cited[0].endswith(f"version = {{{kgs.__version__}}}")


def test_it_opens_where_the_shown_run_is_best(tmp_path: Path) -> None:
    cameras = batch(*(random_camera(*SIZE, 0, torch.float32) for _ in range(6)))  # all are in the middle
    names = list("abcdef")
    rows = [{"name": name, "psnr": 20.0 + (name == "b"), "ssim": None, "lpips_vgg": None} for name in names]
    runs = {"": {"train": {"psnr": 20.2, "ssim": None, "lpips_vgg": None, "views": rows}, "test": None}}
    path = tmp_path / "index.html"
    write_page(path, replace(content(runs=runs), photos=PagePhotos(cameras, names, ["training"] * 6)))
    assert '"first":1,' in path.read_text(encoding="utf-8")


def test_measures_have_their_spread(tmp_path: Path) -> None:
    runs = {"off": {"test": views(20.0, 24.0), "train": views(30.0)}, "on": {"test": views(21.0, 24.5), "train": None}}
    head, rows = measure_table(runs)
    assert head == ["", "held out (2), off", "training (1), off", "held out (2), on"]
    assert rows[0] == ["PSNR [dB]", "22.00 (20.00 to 24.00)", "30.00", "22.75 (21.00 to 24.50)"]
    assert [row[0] for row in rows] == ["PSNR [dB]", "SSIM"]  # none of what nobody measured


@pytest.mark.parametrize(
    ("runs", "expected"),
    [
        ({"": {"test": views(20.0, 24.0)}}, "PSNR on 2 photos held out of the training: 22.0 dB"),
        ({"off": {"test": views(20.0)}, "on": {"test": views(30.0)}}, "1 photo held out of the training: 20.0 dB off"),
        ({"": {"train": views(33.0)}}, "was not measured (kgs fit with --measure or --hold-out does)"),
        ({"": {"train": views(4.9)}}, "PSNR on the 1 photo it was trained on: 4.9 dB. That says little"),
        ({"": {"test": None, "held_out": views(27.0), "train": views(33.0)}}, "27.0 dB, that is close to the photos"),
        ({"": {"test": views(4.9)}}, "4.9 dB, that is not the scene of the photos."),
        ({"": {"views": views(27.0)}}, "PSNR on 1 photo: 27.0 dB."),
        ({"": {"test": views(23.7), "color_corrected": views(34.45)}}, ": 34.5 dB, that is hard to tell from the"),
        ({"": {"test": views(23.7), "color_corrected": views(34.45)}}, "differ in brightness"),
        ({"": {"test": {"psnr": None, "views": [{"name": "a", "psnr": None}]}}}, "not measured."),
    ],
)
def test_one_sentence_says_how_good_it_is(runs: Any, expected: str) -> None:
    assert expected in verdict(runs)
    assert verdict({}) == verdict({"": {"test": None}}) == ""


def test_a_curve_has_what_was_measured() -> None:
    curve = [{"seconds": 9.0 * i, "test_psnr": None if i == 1 else 20 - i, "train_psnr": 25.0 + i} for i in range(4)]
    drawn = psnr_plot({"": {"curve": curve}})
    assert drawn is not None
    points = [[tuple(map(float, p.split(","))) for p in line["points"].split()] for line in drawn["lines"]]
    assert [len(line) for line in points] == [3, 4]
    assert points[0][0][1] < points[0][-1][1]  # it falls
    assert psnr_plot({"": {"curve": curve[:1]}}) is None


@pytest.mark.parametrize(
    ("first", "last"),
    [(0.05, 0.09), (3.0, 43.0 - 1e-14), (1e-3, 1e3), (7.0, 7.0), (7.0, 7.0 + 1e-15), (7.0, 7.0 + 1e-9)],
)
def test_any_two_moments_can_be_drawn(first: float, last: float) -> None:
    """Also where the quarter of a span is a last bit below a power of ten: 0.09 - 0.05 is."""
    for seconds, psnr in (((first, last), (20.0, 21.0)), ((0.0, 9.0), (first, last))):
        moments = zip(seconds, psnr, strict=True)
        drawn = psnr_plot({"": {"curve": [{"seconds": s, "test_psnr": None, "train_psnr": p} for s, p in moments]}})
        assert drawn is not None
        marks = [float(text) for _, text in drawn["x_ticks"]]
        assert marks[0] <= seconds[0]
        assert seconds[1] <= marks[-1] + 1e-6
        for x, y in (map(float, p.split(",")) for p in drawn["lines"][0]["points"].split()):
            assert drawn["left"] <= x <= drawn["right"]
            assert drawn["top"] <= y <= drawn["bottom"]


PATHS = {
    "/photos/my fern": "my fern",
    "D:\\photos\\fern": "fern",
    "../../somebody/points.ply": "points.ply",
    "~/photos/points.ply": "points.ply",
    "/home/jane doe/x": "x",
    "C:\\Users\\Jane Doe\\My Photos\\a.jpg": "a.jpg",
    "\\\\server\\my share\\a.jpg": "a.jpg",
    "/home/jane/Jane's photos/x y": "x y",
}
SENTENCES = {
    "~20 minutes, or ~20/30": "~20 minutes, or ~20/30",
    "see /photos/mine/a.jpg.": "see a.jpg.",
    "PSNR/SSIM of a/b.png, and/or [dB]/c": "PSNR/SSIM of a/b.png, and/or [dB]/c",
    "http://www.w3.org/2000/svg, 3 / 4 / 5 at f/2.8": "http://www.w3.org/2000/svg, 3 / 4 / 5 at f/2.8",
    "/home/jane doe/My pictures/x.jpg: blurred and/or dark": "x.jpg: blurred and/or dark",
    "C:\\Users\\Jane Doe\\a.jpg is one with C:/Users/Jane Doe/b.jpg": "a.jpg is one with b.jpg",
    "no space left: '/home/jane doe/x.ply', nor in '../../jane doe/y'": "no space left: 'x.ply', nor in 'y'",
    "/home/jane doe/out keeps its fit; this is in /home/jane doe/out/new, as": "out keeps its fit; this is in new, as",
    "not /jane doe/a.jpg and images/b.jpg (~/jane doe/c)": "not a.jpg and images/b.jpg (c)",
    "in /home/jane doe/ there": "in jane doe/ there",
}


def test_of_paths_outside_the_last_name_is_shown_whatever_blanks_their_folders_have() -> None:
    for text, expected in {**PATHS, **SENTENCES}.items():
        assert without_folders(text) == expected
    assert facts({"a": [*PATHS, "/home/jane, doe/x"]}) == {"a": ", ".join([*PATHS.values(), "x"])}
    begin = time.monotonic()
    for part in ("/a b", "/", "a ", "\\x", "/a b.c", "../"):
        without_folders("/" + part * 50_000)
    assert time.monotonic() - begin < 5  # no text takes long


def test_facts_are_simple_values_in_words() -> None:
    given = {"a_name": 1.23456789, "yes": True, "none": None, "deep": {"list": [1, 2]}, "rows": [{"x": 1}]}
    assert facts(given) == {"a name": "1.23457", "yes": "yes", "none": "none", "deep: list": "1, 2"}

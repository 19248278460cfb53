"""The page in a real Chromium: it needs nothing else, draws what kgs draws, and is readable on a phone."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from browser import Browser
from factories import batch, random_camera, random_gaussians, with_camera

import kgs
from kgs import Gaussians
from kgs.app.page import PageContent, PagePhotos, PageSplat, PageText, Picture, write_page
from kgs.datasets.scene import Views
from kgs.geometry.types import RasterOptions

SIZE = (150, 200)  # height, width
BACKGROUND = torch.tensor([0.2, 0.5, 0.1])
PARTS = ["training", "training", "training", "test"]
CENTRAL = 1  # the training camera nearest the mean pose
READY = "document.querySelector('.viewer').dataset.state === 'ready'"
CURRENT = "document.querySelector('.strip [aria-current=true]')?.dataset.camera ?? null"
SHOW = """(index, width, height) => {
  const canvas = document.querySelector("canvas");
  Object.assign(canvas.style, { width: `${width}px`, height: `${height}px` });
  if (index !== null) viewer.jumpTo(index);
  viewer.draw();
  return canvas.toDataURL();
}"""


@pytest.fixture(scope="module")
def scene() -> Any:
    """Anisotropic Gaussians with harmonics of degree 3, some faint, some beside the frame; off-centre cameras."""
    gaussians = random_gaussians(400, 0, torch.float32, sh_degree=3, image_size=max(SIZE), opacities=(0.001, 0.999))
    beside = random_gaussians(20, 1, torch.float32, sh_degree=3)
    beside.means[:, 0] = torch.linspace(0.7, 1.3, 20) * beside.means[:, 2]  # the frame ends at about 0.5
    beside.scales[:] = torch.tensor([0.05, 0.05, 1.5])
    beside.quats[:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    gaussians = Gaussians(*map(torch.cat, zip(vars(gaussians).values(), vars(beside).values(), strict=True)))
    first, last, test = (random_camera(*SIZE, seed, torch.float32) for seed in range(3))
    between = first.extrinsics.clone()
    between[:, :3, 3] = (first.extrinsics + last.extrinsics)[:, :3, 3] / 2
    return gaussians, batch(first, with_camera(first, extrinsics=between), last, test)


@pytest.fixture(scope="module")
def renders(scene: Any) -> Any:
    gaussians, cameras = scene
    with torch.no_grad():
        return kgs.GaussianRenderer(backend="torch").eval()(gaussians, cameras, background=BACKGROUND).image.clamp(0, 1)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: Any) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("chromium")) as browser:
        yield browser


@pytest.fixture(scope="module")
def page(scene: Any, renders: Any, tmp_path_factory: Any) -> Path:
    gaussians, cameras = scene
    path: Path = tmp_path_factory.mktemp("page") / "index.html"
    names = [f"a photo with a rather long name that someone gave it {i}.jpg" for i in range(4)]
    pictures = [Picture(names[3], 1 - renders[3], {"": renders[3]})]
    views = [{"name": names[3], "psnr": 20.0, "ssim": 0.5, "ssim_zero_padded": 0.5, "lpips_vgg": 0.25}]
    curve = [{"step": i, "seconds": 1.0 * i, "test_psnr": 20 + i / 9, "train_psnr": 25.0 + i} for i in range(4)]
    metrics = {"test": {**views[0], "views": views}, "train": None, "curve": curve, "seconds": 3.0, "steps": 3}
    settings = {"init_file": "/photos/someone/points.ply", "a_setting_with_a_long_name": "x" * 60}
    write_page(
        path,
        PageContent(
            PageSplat(gaussians, BACKGROUND),
            PagePhotos(cameras, names, PARTS, pictures, thumbnails=dict(zip(names, renders, strict=True))),
            PageText("A test", {"": metrics}, settings=settings),
        ),
    )
    return path


@pytest.fixture
def opened(browser: Browser, page: Path) -> Browser:
    """The page, just loaded, on a screen of 1000 x 800 pixels."""
    browser.size(1000, 800)
    browser.open(page, READY)
    return browser


def bare_page(gaussians: Gaussians, cameras: Any, **options: Any) -> PageContent:
    """A page of four photos without pictures; `options` are those of the renderer."""
    splat = PageSplat(gaussians, BACKGROUND, RasterOptions(**options))
    return PageContent(splat, PagePhotos(cameras, list("abcd"), PARTS), PageText("a"))


def test_it_loads_from_a_file_without_the_network_or_an_error(opened: Browser, page: Path) -> None:
    assert [url for url in opened.requests if not url.startswith("data:")] == [page.as_uri()]
    assert opened.problems == []


def box(browser: Browser, selector: str = ".viewer canvas") -> Any:
    """Left, top, width and height of what a selector finds."""
    rectangle = f"document.querySelector('{selector}').getBoundingClientRect()"
    return browser.run(f"(({{ x, y, width, height }}) => [x, y, width, height])({rectangle})")


def middle(browser: Browser) -> tuple[float, float]:
    """Of the canvas."""
    left, top, width, height = box(browser)
    return left + width / 2, top + height / 2


def stage_size(browser: Browser) -> Any:
    """Width and height within the border of the stage."""
    return browser.run(
        "(({ clientWidth, clientHeight }) => [clientWidth, clientHeight])(document.querySelector('.stage'))"
    )


def press(browser: Browser, key: str, **more: Any) -> None:
    browser.call("Input.dispatchKeyEvent", type="keyDown", key=key, **more)


def mouse(browser: Browser, kind: str, x: float, y: float, **more: Any) -> None:
    """An event of the mouse: "Pressed", "Moved", "Released" or "Wheel"."""
    browser.call("Input.dispatchMouseEvent", type=f"mouse{kind}", x=x, y=y, button="left", **more)


def show(browser: Browser, index: int | None, width: int = SIZE[1], height: int = SIZE[0]) -> Any:
    """The canvas in some size of pixels, at a camera of the page or, without index, where the eye is now."""
    words = ", ".join(json.dumps(value) for value in (index, width, height))
    return browser.picture(browser.run(f"({SHOW})({words})"))


def array(image: torch.Tensor) -> np.ndarray[Any, Any]:
    """`(H, W, 3)` of `(3, H, W)`."""
    return image.permute(1, 2, 0).double().numpy()


def psnr(shown: np.ndarray[Any, Any], expected: np.ndarray[Any, Any]) -> float:
    assert shown.shape == expected.shape
    error = np.mean((shown - expected) ** 2)
    return -10 * math.log10(error) if error else math.inf


def test_the_canvas_shows_what_kgs_renders(opened: Browser, renders: Any) -> None:
    for index, render in enumerate(renders):
        shown, expected = show(opened, index), array(render)
        assert psnr(shown, expected) >= 38, PARTS[index]
        assert np.abs(shown - expected).max() < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(16, 9), (4, 3), (9, 16)])
def test_what_the_photos_frame_shows_does_not_depend_on_the_canvas(
    browser: Browser, page: Path, scene: Any, shape: tuple[int, int]
) -> None:
    """In orbits around the middle of the scene, on canvases that hold the frame of a photo in its own pixels."""
    gaussians, cameras = scene
    browser.size(1000, 800)
    browser.open(page, READY)
    height, width = SIZE
    wide, tall = round(height * shape[0] / shape[1] / 2), round(width * shape[1] / shape[0] / 2)
    canvas = max(width, 2 * wide), max(height, 2 * tall)  # even: the frame lies on whole pixels
    left, top = (canvas[0] - width) // 2, (canvas[1] - height) // 2
    browser.run("viewer.isRoaming = true")
    for yaw, pitch in ((0, 0), (12, 0), (25, 0), (-25, 0), (0, 20)):
        browser.run(f"viewer.jumpTo(viewer.scene.first); viewer.turn({math.radians(yaw)}, {math.radians(pitch)})")
        lens = Views(cameras, torch.zeros(4, 3, *SIZE), tuple("abcd")).camera(CENTRAL)
        camera = camera_of(browser, lens)
        with torch.no_grad():
            render = kgs.GaussianRenderer(backend="torch").eval()(gaussians, camera, background=BACKGROUND).image
        shown = show(browser, None, *canvas)[top : top + height, left : left + width]
        assert psnr(shown, array(render[0].clamp(0, 1))) >= 38, (yaw, pitch)


def test_an_antialiased_splat_is_drawn_as_such(browser: Browser, scene: Any, tmp_path: Path) -> None:
    """Of many Gaussians that are smaller than a pixel."""
    gaussians, cameras = scene
    small = replace(gaussians, scales=gaussians.scales * torch.linspace(0.02, 0.2, len(gaussians))[:, None])
    with torch.no_grad():
        plain, fine = (
            kgs.GaussianRenderer(antialiased=antialiased, backend="torch").eval()(small, cameras, BACKGROUND).image
            for antialiased in (False, True)
        )
    write_page(tmp_path / "index.html", bare_page(small, cameras, antialiased=True))
    browser.size(1000, 800)
    browser.open(tmp_path / "index.html", READY)
    for index in range(4):
        shown = show(browser, index)
        level = psnr(shown, array(fine[index].clamp(0, 1)))
        assert level >= 38
        assert level > psnr(shown, array(plain[index].clamp(0, 1))) + 6


def camera_of(browser: Browser, lens: Any) -> Any:
    """The camera of the eye, with the intrinsics of `lens`."""
    rotation, position = (torch.tensor(browser.run(f"viewer.eye.{name}")) for name in ("rotation", "position"))
    pose = torch.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ position
    return with_camera(lens, extrinsics=pose[None])


def test_roaming_ends_where_the_splat_leaves_the_stage(opened: Browser) -> None:
    """A third of the stage, measured on what the canvas shows before two grounds."""

    def covered() -> float:
        shown = []
        for ground in ("[0, 0, 0]", "[1, 1, 1]"):
            opened.run(f"viewer.renderer.settings.background = {ground}")
            shown.append(show(opened, None))
        return float(1 - (shown[1] - shown[0]).mean())

    for sign in (1, -1):
        opened.run("viewer.jumpTo(viewer.scene.first); viewer.isRoaming = true")
        minimum = min(1 / 3, covered() / 2)
        opened.run(f"for (let i = 0; i < 40; i++) viewer.turn({0.1 * sign}, 0)")
        assert covered() >= minimum - 0.01
        at_once = opened.run("viewer.eye.position")
        opened.run(f"viewer.jumpTo(viewer.scene.first); viewer.turn({4.0 * sign}, 0)")  # one long drag ends there, too
        assert opened.run("viewer.eye.position") == pytest.approx(at_once, abs=1e-6)
        opened.run("viewer.jumpTo(viewer.scene.first); viewer.zoom(2.5); window.start = viewer.eye.position")
        opened.run(f"viewer.turn({0.3 * sign}, 0)")  # from farther away it turns as well
        assert opened.run("viewer.eye.position !== start")


def test_dragging_keys_and_pyramids_move_the_eye(opened: Browser) -> None:
    eye = "JSON.stringify([viewer.eye.position, viewer.eye.rotation])"
    views = [opened.run(eye)]
    left, top = box(opened)[:2]
    at = left + 300, top + 200

    def drag() -> None:
        mouse(opened, "Pressed", *at, clickCount=1, buttons=1)
        mouse(opened, "Moved", at[0] + 40, at[1], buttons=1)
        mouse(opened, "Released", at[0] + 40, at[1], clickCount=1)
        views.append(opened.run(eye))

    shown = "getComputedStyle(viewer.overlay).display !== 'none'"
    assert not opened.run(shown)
    opened.run("document.querySelector('.pyramids').click()")
    assert opened.run(shown)
    drag()
    opened.run("viewer.canvas.focus()")
    for key in ("ArrowUp", "+"):
        press(opened, key)
        views.append(opened.run(eye))
    assert len(set(views)) == 4
    press(opened, "+", modifiers=2)  # with Ctrl: the browser's zoom
    assert opened.run(eye) == views[-1]
    square = "M{0} {2}L{1} {2}L{1} {3}L{0} {3}Z".format(*(x + d for x in (300, 200) for d in (-50, 50)))
    opened.run("viewer.drawPyramids = () => {}")  # a large one stays below the pointer
    opened.run(f"viewer.pyramids[1].setAttribute('d', '{square}')")
    drag()  # on a pyramid: no click
    mouse(opened, "Wheel", *at, deltaX=0, deltaY=100)
    views.append(opened.run(eye))
    assert len(set(views)) == 6
    mouse(opened, "Pressed", *at, clickCount=1, buttons=1)
    mouse(opened, "Released", *at, clickCount=1)
    there = "JSON.stringify([viewer.scene.cameras[1].position, viewer.scene.cameras[1].rotation])"
    opened.wait(f"{eye} === {there}")


@pytest.mark.slow
def test_a_key_turns_the_pictures_by_a_quarter(opened: Browser, renders: Any) -> None:
    start = show(opened, CENTRAL)
    opened.run("viewer.canvas.removeAttribute('style'); viewer.canvas.focus()")
    press(opened, "r")
    stage = stage_size(opened)
    assert stage[0] == pytest.approx(stage[1] * SIZE[0] / SIZE[1], abs=2)
    turned = show(opened, None, *SIZE)
    assert psnr(turned, np.rot90(array(renders[CENTRAL]), -1)) >= 38
    assert psnr(show(opened, 0, *SIZE), np.rot90(array(renders[0]), -1)) >= 38  # other cameras, too
    up = opened.run("viewer.scene.up")
    down = opened.run("viewer.scene.cameras[1].rotation[1]")
    assert np.dot(up, down) < -0.9
    for _ in range(3):
        opened.run("viewer.rollQuarter()")
    assert np.array_equal(show(opened, CENTRAL), start)


@pytest.mark.slow
def test_graphics_that_the_browser_took_back_come_again(opened: Browser) -> None:
    before = show(opened, 0)
    opened.run("window.loss = viewer.renderer.gl.getExtension('WEBGL_lose_context'); loss.loseContext()")
    opened.wait("document.querySelector('.viewer').dataset.state === 'lost'")
    assert "graphics" in opened.run("document.querySelector('.failure').textContent")
    opened.run("loss.restoreContext()")
    opened.wait(READY)
    assert opened.run("document.querySelector('.failure').textContent") == ""
    assert np.array_equal(show(opened, 0), before)


def test_the_slider_lays_the_render_over_the_photo(opened: Browser) -> None:
    over = "document.querySelector('.over')"
    assert opened.run(f"{over}.src === document.querySelector('img.render').src")
    clips = [opened.run(f"{over}.style.clipPath")]
    opened.run("document.querySelector('.wipe input').focus()")
    for _ in range(30):
        press(opened, "ArrowLeft", windowsVirtualKeyCode=37)
    clips.append(opened.run(f"{over}.style.clipPath"))
    assert clips == ["inset(0px 0px 0px 50%)", "inset(0px 0px 0px 20%)"]
    opened.run("document.querySelector('.pair').scrollIntoView()")
    left, top, width, _ = box(opened, ".pair")
    mouse(opened, "Moved", left + 0.75 * width, top + 20)
    assert opened.run("Number(document.querySelector('.wipe input').value)") == pytest.approx(75, abs=1)


TURNED = """(() => {
  const { up, arc } = viewer.scene, back = viewer.eye.rotation[2].map((value) => -value);
  return [Math.atan2(dot(up, cross(arc.origin, back)), dot(arc.origin, back)), Math.asin(dot(up, back))];
})()"""


@pytest.mark.slow
def test_a_drag_ends_with_the_arc_unless_it_roams(opened: Browser) -> None:
    opened.run("viewer.flyTo(3)")
    opened.run("document.querySelector('.start').click()")
    assert opened.run(CURRENT) == str(CENTRAL)
    arc = opened.run("viewer.scene.arc")
    width = opened.run("viewer.turnPerPixel() * viewer.canvas.clientWidth")
    assert width == pytest.approx(arc["yaw"][1] - arc["yaw"][0])  # a drag across the stage
    for sign in (1, -1):
        for axis, name in enumerate(("yaw", "pitch")):
            opened.run("viewer.jumpTo(viewer.scene.first)")
            # a drag to the right is a turn to the left
            step = [0.0, 0.0]
            step[axis] = sign * (-0.02 if axis == 0 else 0.02)
            opened.run(f"for (let i = 0; i < 400; i++) viewer.turn({step[0]}, {step[1]})")
            low, high = arc[name]
            end = high if sign > 0 else low
            left = sign * (end - opened.run(TURNED)[axis]) / (high - low)
            assert -1e-6 <= left < 0.02, (sign, name)
    opened.run("viewer.jumpTo(viewer.scene.first)")
    opened.run("viewer.turn(-1e3 * viewer.turnPerPixel(), 0)")  # one long drag stops there, too
    assert opened.run(TURNED)[0] == pytest.approx(arc["yaw"][1])
    opened.run("viewer.jumpTo(viewer.scene.first); document.querySelector('.roam').click()")
    assert opened.run("document.querySelector('.roam').getAttribute('aria-pressed')") == "true"
    opened.run("viewer.turn(-2.5, 0)")
    assert opened.run(TURNED)[0] == pytest.approx(2.5, abs=0.02)


@pytest.mark.parametrize(("surface", "nearest"), [("0.5", 0.5 + 0.5 / 4), ("2", 1 / 4), ("null", 1 / 4)])
def test_zooming_in_ends_at_a_quarter_of_the_distance_to_what_is_ahead(
    opened: Browser, surface: str, nearest: float
) -> None:
    """In shares of the distance that the eye turns around: before that point, behind it, and nowhere."""
    start = opened.run("viewer.eye.distance")
    ahead = f"{surface} && {surface} * {start}"
    opened.run(f"viewer.renderer.medianDepth = (eye, view, pixel) => pixel === view.centre ? {ahead} : NaN")
    for factor, limit in ((1.3, 3), (0.7, nearest), (1.3, 3)):
        opened.run(f"for (let i = 0; i < 40; i++) viewer.zoom({factor})")
        assert opened.run("viewer.eye.distance") == pytest.approx(limit * start)


def test_the_surface_where_zooming_ends_is_drawn(browser: Browser, tmp_path: Path) -> None:
    """A white wall before the median depth, which most Gaussians behind it decide."""
    wall = random_gaussians(400, 0, torch.float32)
    across = torch.linspace(-1, 1, 10)
    wall.means[:100] = torch.cartesian_prod(across, across, torch.tensor([2.0]))
    wall.means[100:, 2] = 9.0
    wall.scales[:] = 0.2
    wall.opacities[:] = 0.99
    wall = replace(wall, colors=torch.ones(400, 3))
    camera = random_camera(*SIZE, 0, torch.float32)
    cameras = batch(*[with_camera(camera, extrinsics=torch.eye(4)[None])] * 4)
    write_page(tmp_path / "index.html", bare_page(wall, cameras))
    browser.size(1000, 800)
    browser.open(tmp_path / "index.html", READY)
    browser.run("for (let i = 0; i < 40; i++) viewer.zoom(0.7)")
    assert browser.run("viewer.eye.position")[2] == pytest.approx(0.75 * 2, abs=0.02)
    assert show(browser, None).mean() > 0.98


@pytest.mark.parametrize("change", ["viewer.turn(0.1, 0)", "viewer.zoom(0.9)"])
def test_a_flight_arrives_whatever_turns_or_moves_the_eye_meanwhile(browser: Browser, page: Path, change: str) -> None:
    browser.size(1000, 800, motion="no-preference")
    browser.open(page, READY)
    start = browser.run(f"viewer.endTour(); viewer.flyTo(3); {change}; target(viewer.drawn)")
    browser.wait("viewer.flight === null")
    browser.run("viewer.draw()")
    end, goal = browser.run("[target(viewer.drawn), target(viewer.scene.cameras[3])]")
    assert end == pytest.approx(goal, abs=1e-6)
    assert np.linalg.norm(np.subtract(start, goal)) > 0.1


@pytest.mark.slow
def test_the_page_scrolls_past_a_stage_that_was_not_clicked(browser: Browser, page: Path) -> None:
    browser.size(1000, 500)
    browser.open(page, READY)
    assert browser.run("getComputedStyle(viewer.canvas).touchAction") == "pan-y"
    browser.run("document.querySelector('.stage').scrollIntoView()")
    x, y = middle(browser)
    distance, before = browser.run("viewer.eye.distance"), browser.run("scrollY")
    mouse(browser, "Wheel", x, y, deltaX=0, deltaY=100)
    browser.wait(f"scrollY > {before}")
    assert browser.run("viewer.eye.distance") == distance
    x, y = middle(browser)
    for kind in ("Pressed", "Released"):
        mouse(browser, kind, x, y, clickCount=1)
    before = browser.run("scrollY")
    mouse(browser, "Wheel", x, y, deltaX=0, deltaY=100)
    browser.wait(f"viewer.eye.distance > {distance}")
    assert browser.run("scrollY") == before


POSITION = "JSON.stringify(viewer.eye.position)"
TOUCHES = {
    "a press": "document.querySelector('.stage').dispatchEvent(new PointerEvent('pointerdown', {bubbles: true}))",
    "a key": "viewer.canvas.dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowLeft'}))",
    "a zoom": "viewer.zoom(1.1)",
    "Start": "document.querySelector('.start').click()",
    "a photo": "document.querySelector('.strip button').click()",
}


def is_pressed(browser: Browser) -> bool:
    return bool(browser.run("document.querySelector('.play').getAttribute('aria-pressed') === 'true'"))


def is_at_rest(browser: Browser) -> bool:
    """Whether the eye stands still, once a flight to a photo had its time."""
    wait = "new Promise((done) => setTimeout(done, 1000))"
    before = browser.run(f"{wait}.then(() => {POSITION})")
    browser.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return bool(browser.run(POSITION) == before)


CLOCK = """(() => {
  window.steps = [];
  window.requestAnimationFrame = (step) => steps.push(step);
  window.now = 0;
  window.pass = (seconds) => {
    for (const end = now + 1000 * seconds; now < end - 1; now += 50) steps.splice(0).forEach((step) => step(now));
    return [viewer.eye.position, viewer.eye.rotation];
  };
})()"""


def test_play_flies_the_tour_in_its_time_and_around_again(browser: Browser, page: Path) -> None:
    """By the clock that a browser gives to frames: each second has a sixth of the poses, up to those of the film."""
    browser.size(1000, 800)
    browser.open(page, READY)
    assert not is_pressed(browser)
    browser.run(CLOCK)
    browser.run("window.matchMedia = () => ({ matches: false }); viewer.draw = () => {}")
    browser.run("viewer.jumpTo(3)")  # not one of the tour
    browser.run("document.querySelector('.play').click()")
    assert is_pressed(browser)
    browser.run("pass(0.05)")
    poses = browser.run("viewer.scene.tour.poses")
    assert len(poses) == 144
    eye = np.array(browser.run("viewer.eye.position"))
    start = int(np.argmin([np.linalg.norm(np.array(pose["position"]) - eye) for pose in poses]))
    passed = 0
    for seconds in (3, 1, 2, 6, 5):  # more than two rounds
        position, rotation = browser.run(f"pass({seconds})")
        passed += seconds
        expected = poses[(start + 24 * passed) % 144]
        np.testing.assert_allclose(position, expected["position"], atol=1e-6)
        np.testing.assert_allclose(rotation, expected["rotation"], atol=1e-5)
    browser.run("document.querySelector('.play').click()")
    assert not is_pressed(browser)
    before = browser.run(POSITION)
    browser.run("pass(1)")
    assert browser.run(POSITION) == before


@pytest.mark.slow
@pytest.mark.parametrize("touch", TOUCHES.values(), ids=TOUCHES)
def test_the_tour_ends_with_any_touch(browser: Browser, page: Path, touch: str) -> None:
    """The slow one that the page begins with, and the one that was asked for."""
    browser.size(400, 800, motion="no-preference")
    browser.open(page, READY)
    for has_asked in (False, True):
        if has_asked:
            browser.run("document.querySelector('.play').click()")
        assert is_pressed(browser) == has_asked
        start = browser.run(POSITION)
        browser.wait(f"{POSITION} !== {start!r}")
        browser.run(touch)
        assert not is_pressed(browser)
        assert is_at_rest(browser)


def test_where_less_motion_is_wanted_play_shows_pictures(opened: Browser) -> None:
    opened.run(CLOCK)
    opened.run("new Promise((done) => setTimeout(done, 100))")  # for a frame that was asked for before
    before = opened.run(POSITION)
    opened.run("pass(20)")
    assert opened.run(POSITION) == before
    opened.run("viewer.draw = () => seen.add(JSON.stringify(viewer.eye)); window.seen = new Set()")
    opened.run("document.querySelector('.play').focus()")
    press(opened, "Enter", code="Enter", text="\r")  # the button takes the keyboard
    opened.run("pass(5)")
    assert is_pressed(opened)
    poses = opened.run("viewer.scene.tour.poses.map((pose) => JSON.stringify(pose.position))")
    shown = opened.run("[...seen].map((eye) => JSON.stringify(JSON.parse(eye).position))")
    indices = [poses.index(position) for position in shown]
    assert (indices[1] - indices[0]) % 144 == 36


def test_a_thumbnail_flies_to_its_camera(opened: Browser) -> None:
    there = "JSON.stringify([viewer.scene.cameras[{0}].position, viewer.scene.cameras[{0}].rotation])"
    eye = "JSON.stringify([viewer.eye.position, viewer.eye.rotation])"
    assert opened.run(CURRENT) == str(CENTRAL)
    left, top, width, height = box(opened, ".strip button:last-child")
    for kind in ("Pressed", "Released"):
        mouse(opened, kind, left + width / 2, top + height / 2, clickCount=1)
    opened.wait(f"{eye} === {there.format(3)}")
    assert opened.run(CURRENT) == "3"
    assert opened.run("document.querySelector('.strip [aria-current]').getAttribute('aria-label')") == (
        "photo 4 of 4, held out"
    )
    opened.run("viewer.turn(0.1, 0)")
    assert opened.run(CURRENT) is None  # the eye is at none


def test_the_strip_is_one_stop_of_tab_and_arrows_lead_through_it(opened: Browser) -> None:
    stops = "[...document.querySelectorAll('.strip button')].filter((one) => one.tabIndex === 0).length"
    focused = "document.activeElement.dataset.camera"
    opened.run("viewer.canvas.focus()")
    tab = {"key": "Tab", "code": "Tab", "windowsVirtualKeyCode": 9}
    press(opened, **tab)
    assert opened.run(focused) == str(CENTRAL)
    steps = (("ArrowRight", 2), ("ArrowDown", 3), ("ArrowRight", 3), ("Home", 0), ("ArrowLeft", 0), ("End", 3))
    for key, expected in steps:
        press(opened, key)
        assert opened.run(f"[{focused}, {CURRENT}]") == [str(expected)] * 2, key
        assert opened.run(stops) == 1
    position = opened.run("viewer.scene.cameras[3].position")
    opened.wait(f"JSON.stringify(viewer.eye.position) === JSON.stringify({position})")
    press(opened, **tab)
    assert opened.run("document.activeElement.className") == "play"


def test_thumbnails_turn_with_the_pictures(opened: Browser) -> None:
    one = ".strip button"
    width, height = box(opened, one)[2:]
    assert width == pytest.approx(height * SIZE[1] / SIZE[0], abs=1)
    opened.run("document.querySelector('.unfold').click()")
    opened.run("document.querySelector('.quarter').click()")
    width, height = box(opened, one)[2:]
    assert width == pytest.approx(height * SIZE[0] / SIZE[1], abs=1)
    assert box(opened, f"{one} img") == pytest.approx(box(opened, one), abs=1)
    opened.run("for (let i = 0; i < 3; i++) viewer.rollQuarter()")
    assert box(opened, f"{one} img")[2:] == pytest.approx([height * SIZE[1] / SIZE[0], height], abs=1)


WINDOWS = [(360, 740), (390, 844), (700, 800), (844, 390), (820, 1180), (1366, 768), (1920, 1080)]


@pytest.mark.parametrize("shape", ["200 / 150", "150 / 200", "200 / 60"])
def test_the_stage_is_as_large_as_the_window_allows(opened: Browser, shape: str) -> None:
    """Below the title, with the panel beside or below it, and without a horizontal bar; the strip is in the window."""
    opened.run(f"document.documentElement.style.setProperty('--aspect', '{shape}')")
    for width, height in WINDOWS:
        opened.size(width, height)
        assert opened.run("document.documentElement.scrollWidth") <= width
        assert box(opened)[2:] == pytest.approx(stage_size(opened), abs=1)
        left, top, stage_width, stage_height = box(opened, ".stage")
        panel = box(opened, ".panel")
        is_beside = panel[0] >= left + stage_width
        assert is_beside or panel[1] >= top + stage_height
        assert top + stage_height <= height + 1
        assert left >= 0
        assert left + stage_width <= width
        is_wide = stage_width >= width - 33
        is_tall = top + stage_height >= height - (50 if is_beside else 215)
        has_narrowest_panel = is_beside and panel[2] <= 18.2 * 16
        assert is_wide or is_tall or has_narrowest_panel, (width, height)
        strip = box(opened, ".strip")
        assert strip[1] + 48 <= height
        if width > height and shape == "150 / 200":
            assert is_beside


def touch(browser: Browser, is_phone: bool) -> None:
    browser.call("Emulation.setTouchEmulationEnabled", enabled=is_phone)


def test_a_phone_has_one_row_of_buttons_for_fingers_and_words_for_them(opened: Browser) -> None:
    tops = "[...document.querySelectorAll('.panel > .tools button')].map((one) => one.getBoundingClientRect().top)"
    words = "['.mouse', '.touch'].map((name) => getComputedStyle(document.querySelector(name)).display !== 'none')"
    assert opened.run(words) == [True, False]
    try:
        touch(opened, True)
        for width in (360, 390):
            opened.size(width, 740)
            assert len(set(opened.run(tops))) == 1
            opened.run("document.querySelector('.more').hidden = false")
            small = """[...document.querySelectorAll("main button")].map((one) => one.getBoundingClientRect())
              .filter(({ width, height }) => width < 40 || height < 40).length"""
            assert opened.run(small) == 0
        assert opened.run(words) == [False, True]
        assert "Pinch to zoom" in opened.run("document.querySelector('header').innerText")
        assert "Click" not in opened.run("document.querySelector('.viewer').innerText")
        assert "Keys" not in opened.run("document.querySelector('.viewer').innerText")
    finally:
        touch(opened, False)


def test_a_browser_without_full_screen_shows_no_button_for_it(browser: Browser, page: Path) -> None:
    """As on an iPhone."""
    script = "Object.defineProperty(document, 'fullscreenEnabled', { value: undefined })"
    number = browser.call("Page.addScriptToEvaluateOnNewDocument", source=script)["identifier"]
    try:
        browser.open(page, READY)
        assert browser.run("document.querySelector('.full').getBoundingClientRect().width") == 0
    finally:
        browser.call("Page.removeScriptToEvaluateOnNewDocument", identifier=number)
    browser.open(page, READY)
    assert browser.run("document.querySelector('.full').getBoundingClientRect().width") > 0


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_a_phone_in_both_schemes(browser: Browser, page: Path, scheme: str) -> None:
    browser.size(400, 800, scheme)
    browser.open(page, READY)
    assert browser.run("document.documentElement.scrollWidth") <= 400
    cut = """[...document.querySelectorAll("body *")].filter((one) => !one.closest(".scroll, .strip, pre, svg, details")
      && one.getBoundingClientRect().right > innerWidth + 0.5).map((one) => one.outerHTML.slice(0, 99))"""
    assert browser.run(cut) == []
    browser.run("document.querySelector('details').open = true")
    assert browser.run("document.documentElement.scrollWidth") <= 400
    channels = browser.run("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)")
    assert (max(channels) < 64) if scheme == "dark" else (min(channels) > 240)


def test_the_depth_at_a_pixel_is_that_of_the_renderer(browser: Browser, scene: Any, tmp_path: Path) -> None:
    """The median depth within 1 %, from the cameras of all photos, and antialiased from two."""
    gaussians, cameras = scene
    browser.size(1000, 800)
    for antialiased, indices in ((False, (0, 1, 2, 3)), (True, (0, 3))):
        write_page(tmp_path / "index.html", bare_page(gaussians, cameras, antialiased=antialiased))
        browser.open(tmp_path / "index.html", READY)
        with torch.no_grad():
            renderer = kgs.GaussianRenderer(antialiased=antialiased, backend="torch").eval()
            depth = renderer(gaussians, cameras, outputs=("median_depth",)).median_depth[:, 0].numpy()
        rows, columns = (axis.ravel() for axis in np.mgrid[3 : SIZE[0] : 7, 4 : SIZE[1] : 9])
        pixels = np.stack([columns, rows], 1).tolist()
        for index in indices:
            show(browser, index)
            found = browser.run(
                f"(({{ renderer, view, eye }}) => {pixels}.map((pixel) => "
                "renderer.medianDepth(viewer.withNearPlane(eye), view, pixel)))(viewer)"
            )
            expected = depth[index, rows, columns]
            differences = np.abs(np.array([value or 0.0 for value in found]) - expected)
            assert (expected > 0).sum() > 25
            # A pixel where the transmittance is just about one half can take the next Gaussian.
            assert (differences > 0.01 * expected).sum() <= 1, (antialiased, index)


def test_two_clicked_points_have_a_distance(opened: Browser) -> None:
    """On a wall of Gaussians at a known depth, the points and their distance are known as well."""
    opened.run("document.querySelector('.unfold').click(); document.querySelector('.measure').click()")
    text = "document.querySelector('.measured').innerText"
    assert opened.run(text).startswith("Choose two points in")
    opened.run("viewer.renderer.medianDepth = () => 2; viewer.scene.offset = [1000, 0, -3]; viewer.draw()")
    left, top, width, height = box(opened)
    clicked = [(0.3, 0.4), (0.6, 0.7)]
    for x, y in clicked:
        for kind in ("Pressed", "Released"):
            mouse(opened, kind, left + x * width, top + y * height, clickCount=1)
    camera = opened.run("viewer.scene.cameras[viewer.chosen]")
    size, focal, centre = (np.array(camera[name]) for name in ("size", "focal", "centre"))
    points = [
        np.array(camera["position"])
        + 2 * np.array([*((np.array(at) * size - 0.5 - centre) / focal), 1]) @ np.array(camera["rotation"])
        for at in clicked
    ]
    said = opened.run(text)
    distance = np.linalg.norm(points[1] - points[0])
    assert said.split()[0] == f"{distance:.2g}"
    words = opened.run("document.querySelector('.measured code').textContent").split()
    assert words[:4] == ["kgs", "scale", "OUT", "--by"]
    unbroken = "getComputedStyle(document.querySelector('.measured .option')).whiteSpace"
    assert opened.run(unbroken) == "nowrap"
    shown = [np.array([float(value) for value in word.split(",")]) for word in words[4:6]]
    for one, expected in zip(shown, points, strict=True):
        np.testing.assert_allclose(one, expected + np.array([1000, 0, -3]), atol=5e-3 * distance)
    assert np.linalg.norm(shown[1] - shown[0]) == pytest.approx(distance, rel=5e-3)  # a click is at a whole pixel
    marks = (
        "[...document.querySelectorAll('.ruler circle')].map((one) => ['cx', 'cy'].map((n) => +one.getAttribute(n)))"
    )
    for mark, (x, y) in zip(opened.run(marks), clicked, strict=True):
        assert mark == pytest.approx([x * width, y * height], abs=1.5)
    opened.run("document.querySelector('.measure').click()")
    assert opened.run(text) == ""
    assert opened.run("getComputedStyle(document.querySelector('.ruler circle')).display") == "none"

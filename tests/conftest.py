"""Fixtures for all tests, their order, and settings."""

import functools
import gc
import json
import os
import signal
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import settings
from init_point_scenes import painted_planes
from optional_packages import pytest_pycollect_makemodule  # noqa: F401
from tables import pytest_addoption, pytest_configure, pytest_terminal_summary  # noqa: F401  # --tables
from targets import ALL_KERNELS, CARD, CPU, Target, skip_unless_there, speed_up_interpreter
from yard import on_arc, yard_views

from kgs import backends
from kgs.app.files import film
from kgs.datasets import synthetic, synthetic_scene
from kgs.init_points import InitialPoints

if not torch.cuda.is_available():  # before kernels are imported
    os.environ.setdefault("TRITON_INTERPRET", "1")
if "PYTEST_XDIST_WORKER" in os.environ:  # a core for each worker, and for the processes that its tests start
    torch.set_num_threads(int(os.environ.setdefault("OMP_NUM_THREADS", "1")))

settings.register_profile("kgs", deadline=None)  # another program may take the core
settings.load_profile("kgs")

# The files that `pytest -n` hands out first: one that compiles the kernels, beside it those that use none, then long
# ones, so that no worker ends long before the other.
_FIRST = [
    "test_resume",
    *("test_kernels_projection", "test_synthetic", "test_house", "test_api", "test_wheel"),
    *("test_kernels_loss", "test_load", "test_transforms", "test_colmap", "test_page_browser", "test_trainer"),
    *("test_cli", "test_fit_folder", "test_init_points_dense", "test_kernels_compositing", "test_not_finite"),
    *("test_gpu_fit", "test_bits", "test_extreme_cases", "test_cli_process", "test_run", "test_sfm_folders"),
]


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Without the garbage collector, which finds nothing: all modules and tests that are collected stay to the end."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()  # nor looks among them again during the tests
        gc.enable()


def pytest_unconfigure() -> None:
    """Let the end find what it would find without that: Triton tells what it takes for a leak."""
    gc.unfreeze()


def pytest_collection_modifyitems(items: list[pytest.Function]) -> None:
    """Skip the numba variant of tests that only torch can run; under `pytest -n`, put the files of `_FIRST` first."""
    items[:] = [item for item in items if not _runs_on_torch_again(item)]
    if "PYTEST_XDIST_WORKER" in os.environ:
        items.sort(key=lambda item: _FIRST.index(item.path.stem) if item.path.stem in _FIRST else len(_FIRST))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes(config: pytest.Config) -> None:
    """Hand files out in this order, not by their number of tests: a long one at the end would run alone."""
    config.option.loadscopereorder = False


def _runs_on_torch_again(item: pytest.Function) -> bool:
    """Whether this is the numba variant of a test in float64, of a GPU, or of torch alone."""
    values = getattr(getattr(item, "callspec", None), "params", {})
    if "numba" not in (values.get("each_backend"), values.get("each_device")):
        return False
    double = any(
        value in ("float64", torch.float64) for value in values.values() if isinstance(value, str | torch.dtype)
    )
    return double or item.get_closest_marker("cuda") is not None or "torch_alone" in item.fixturenames


@pytest.fixture(scope="module", params=sorted({"torch", backends.get_backend("auto", torch.device("cpu")).name}))
def each_backend(request: pytest.FixtureRequest) -> Iterator[str]:
    """Run a test twice: "auto" means torch, then numba. Their bits differ."""
    available = {name: x for name, x in backends.BACKENDS.items() if name in ("torch", request.param)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(backends, "BACKENDS", available)
        yield request.param


@pytest.fixture(scope="module", params=["torch", "numba", pytest.param("cuda", marks=CARD)])
def each_device(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    """Run a test as `each_backend` does, and on a card: the device."""
    if request.param == "cuda":
        yield torch.device("cuda")
        return
    skip_unless_there(Target(request.param))
    with pytest.MonkeyPatch.context() as patch:
        available = {name: x for name, x in backends.BACKENDS.items() if name in ("torch", request.param)}
        patch.setattr(backends, "BACKENDS", available)
        yield CPU


@pytest.fixture(scope="session")
def _fast_interpreter() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        speed_up_interpreter(patch)
        yield


@pytest.fixture(params=ALL_KERNELS)
def kernels(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Target:
    """Each backend of kernels where it runs, for tests that compare it with torch in float64."""
    skip_unless_there(request.param)
    if request.param.backend == "triton":
        request.getfixturevalue("_fast_interpreter")
    else:  # small pictures in as many pieces as large ones are
        monkeypatch.setattr("kgs.backends.cpu.binning.MIN_ENTRIES", 1)
        monkeypatch.setattr("kgs.backends.cpu.loss.MIN_PIXELS", 1)
    return request.param


@pytest.fixture
def torch_alone() -> None:
    """For a test that calls no kernel (errors, files): it runs once."""


@pytest.fixture
def exactly(each_backend: str) -> tuple[torch.dtype, float]:
    """The dtype in which a backend is most exact, and the largest error of its images."""
    return (torch.float32, 3e-6) if each_backend == "numba" else (torch.float64, 1e-12)


@pytest.fixture(autouse=True)
def _reproducible() -> None:
    """Start every test with the same global random stream."""
    torch.manual_seed(0)


@pytest.fixture(scope="session", autouse=True)
def _signals_arrive() -> None:
    """Handle signals that nohup, or a shell in the background, had set to be ignored."""
    defaults = {"SIGINT": signal.default_int_handler, "SIGTERM": signal.SIG_DFL, "SIGHUP": signal.SIG_DFL}
    for number, handler in ((getattr(signal, name, None), handler) for name, handler in defaults.items()):
        if number is not None and signal.getsignal(number) == signal.SIG_IGN:
            signal.signal(number, handler)


@pytest.fixture(scope="session", autouse=True)
def _nothing_waits_for_the_disk() -> Iterator[None]:
    """Leave files to the system, which writes them when it likes: no test takes the power from its machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def _short_films() -> Iterator[None]:
    """Make films of two frames, unless a test sets more: each fit makes one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(film, "FRAMES", 2)
        yield


@pytest.fixture(scope="session", autouse=True)
def _synthetic_worlds_are_made_once() -> Iterator[None]:
    """Keep all of them, not the last two: each takes a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "_make_world", functools.cache(synthetic._make_world.__wrapped__))
        yield


@pytest.fixture
def set_threads() -> Iterator[Callable[[int], None]]:
    """Sets the number of torch's threads for the test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture
def matmul_precision() -> Iterator[Callable[[str], None]]:
    """Sets the precision of torch's float32 products for the test."""

    def reset(precision: str = "highest") -> None:
        if hasattr(torch.backends, "fp32_precision"):
            torch.backends.fp32_precision = "none"
        torch.set_float32_matmul_precision(precision)

    yield reset
    reset()


@pytest.fixture
def kgs_data() -> Path:
    """The folder of real scenes; the test is skipped where there is none."""
    if "KGS_DATA" not in os.environ:
        pytest.skip("KGS_DATA is not set: no real scenes")
    return Path(os.environ["KGS_DATA"])


@pytest.fixture(scope="session")
def scene():
    """Three tiny pictures to train on, two to test."""
    return synthetic_scene(train_views=3, test_views=2, size=(32, 40), seed=1)


@pytest.fixture(scope="session")
def points():
    """150 random points before its cameras."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(150, 3, generator=generator) * torch.tensor([4.0, 3.0, 4.0]) + torch.tensor([-2.0, -1.5, 3.0])
    return InitialPoints(points, torch.rand(150, 3, generator=generator), "random")


@pytest.fixture(scope="session")
def planes():
    """Two painted planes of known depth in three views."""
    return painted_planes()


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Four views around the boxes of a yard, and two between them, as a Blender folder."""
    root = tmp_path_factory.mktemp("scene")
    around = {"train": np.radians([0.0, 90.0, 180.0, 270.0]), "test": np.radians([40.0, 220.0])}
    for split, angles in around.items():
        views = yard_views(on_arc(angles, np.full(len(angles), 0.35)), (36, 40))
        (root / split).mkdir()
        frames = []
        for i, image in enumerate(views.images):
            pixels = (image * 255).round().byte().permute(1, 2, 0).numpy()
            rgba = np.dstack([pixels[:, :, ::-1], np.full(pixels.shape[:2], 255, np.uint8)])
            cv2.imwrite(str(root / split / f"r_{i}.png"), rgba)
            pose = (
                torch.linalg.inv(views.cameras.extrinsics[i].double())
                @ torch.diag(torch.tensor([1.0, -1, -1, 1])).double()
            )
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()})
        width, focal = views.images.shape[-1], float(views.cameras.fx[0])
        content = {"camera_angle_x": 2 * float(np.arctan(width / 2 / focal)), "frames": frames}
        (root / f"transforms_{split}.json").write_text(json.dumps(content))
    return root

"""LPIPS: the authors' figures where the weights are at hand, hand-made networks everywhere else."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from refusals import refused
from tiny_scenes import narrow_lpips, write_lpips

from kgs import ArgumentError
from kgs._support.errors import DataError
from kgs.metrics.lpips import Lpips

VGG16 = {0: (64, 3), 2: (64, 64), 5: (128, 64), 7: (128, 128), 10: (256, 128), 12: (256, 256), 14: (256, 256)}
VGG16 |= {17: (512, 256), 19: (512, 512), 21: (512, 512), 24: (512, 512), 26: (512, 512), 28: (512, 512)}
HEADS = (64, 128, 256, 512, 512)
SHIFT = np.array([-0.030, -0.088, -0.188])
SCALE = np.array([0.458, 0.448, 0.450])
FEATURES_FILE, HEADS_FILE = "vgg16_features.npz", "lpips_lin_vgg16.npz"


@pytest.fixture
def narrow():
    with narrow_lpips():
        yield


@pytest.fixture
def files(narrow, tmp_path):
    """A folder with whole files of a narrow network."""
    write_lpips(tmp_path)
    return tmp_path


def change_arrays(path, change):
    with np.load(path) as archive:
        arrays = dict(archive)
    change(arrays)
    np.savez(path, **arrays)


def flat(color, size=64):
    return torch.tensor(color).view(1, 3, 1, 1).expand(1, 3, size, size)


@pytest.fixture
def weights():
    root = os.environ.get("KGS_DATA")
    folder = Path(root or "", "weights")
    if not root or not folder.is_dir():
        pytest.skip("KGS_DATA is not set to a folder with weights/")
    return folder


@pytest.mark.parametrize(("image", "expected"), [("ex_p0", 0.5686), ("ex_p1", 0.4217)])
def test_published_figures(weights, image, expected):
    def read(name):
        pixels = cv2.imread(str(weights / "reference_images" / f"{name}.png"))
        return torch.from_numpy(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)).permute(2, 0, 1)[None] / 255

    distance = Lpips.load(weights)(read("ex_ref"), read(image))
    assert distance.item() == pytest.approx(expected, abs=1e-4)


def test_the_network_is_vgg16():
    with torch.device("meta"):
        found = {name: tuple(value.shape) for name, value in Lpips().state_dict().items()}
    expected = {f"features.{layer}.weight": (*shape, 3, 3) for layer, shape in VGG16.items()}
    expected |= {f"features.{layer}.bias": (shape[0],) for layer, shape in VGG16.items()}
    assert found == expected | {f"lin{i}": (width,) for i, width in enumerate(HEADS)}


def test_first_block_by_hand_averaged_over_the_image(files):
    """Its two layers copy red and green; all other features are 0."""

    def copy(arrays):
        for array in arrays.values():
            array[...] = 0
        for layer in (0, 2):
            arrays[f"features.{layer}.weight"][[0, 1], [0, 1], 1, 1] = 1

    change_arrays(files / FEATURES_FILE, copy)
    change_arrays(files / HEADS_FILE, lambda heads: heads.update(lin0=np.array([0.5, 2.0, 0.0, 0.0])))
    lpips = Lpips.load(files)
    x, y = (0.9, 0.6, 0.1), (0.7, 0.95, 0.4)

    def direction(color, rescale):
        values = np.array(color) * 2 - 1 if rescale else np.array(color)
        values = np.maximum(((values - SHIFT) / SCALE)[:2], 0)
        return values / np.linalg.norm(values)

    for rescale in (True, False):
        expected = np.array([0.5, 2.0]) @ (direction(x, rescale) - direction(y, rescale)) ** 2
        assert lpips(flat(x), flat(y), rescale=rescale).item() == pytest.approx(expected, rel=1e-5)
        half = flat(x).clone()
        half[..., :16] = flat(y)[..., :16]  # a quarter of the columns
        assert lpips(flat(x), half, rescale=rescale).item() == pytest.approx(expected / 4, rel=1e-5)


@pytest.mark.usefixtures("narrow")
def test_a_random_network_gives_a_distance_whose_gradient_reaches_the_image_alone():
    lpips = Lpips()
    x, y = torch.rand(2, 2, 3, 16, 19)
    assert torch.equal(lpips(x, x), torch.zeros(2))
    assert (lpips(x, y) > 0).all()
    torch.testing.assert_close(lpips(x, y), lpips(y, x))
    torch.testing.assert_close(lpips(x, y)[1:], lpips(x[1:], y[1:]))
    lpips(x.requires_grad_(), y).sum().backward()
    assert x.grad.abs().max() > 0
    assert not any(parameter.requires_grad for parameter in lpips.parameters())


def test_loading_draws_no_random_numbers(files):
    state = torch.get_rng_state()
    Lpips.load(files)
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.usefixtures("narrow")
@pytest.mark.parametrize(
    ("argument", "image", "target"),
    [("image", (1, 3, 15, 40), (1, 3, 15, 40)), ("target", (1, 3, 40, 40), (2, 3, 40, 40))],
)
def test_wrong_shapes_are_named(argument, image, target):
    with refused(ArgumentError, name=argument):
        Lpips()(torch.rand(image), torch.rand(target))


def test_missing_files_are_data_errors(files):
    with refused(DataError, path=files / "nowhere", key=""):
        Lpips.load(files / "nowhere")
    for name in (HEADS_FILE, FEATURES_FILE):
        (files / name).unlink()
        with refused(DataError, path=files / name, key=""):
            Lpips.load(files)


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (None, "an array"),
        (np.zeros(7, np.float32), "floats of shape"),
        (np.zeros((1, 8, 1, 1), np.float32), "floats of shape"),
        (np.zeros(8, np.int64), "floats"),
        (np.full(8, np.nan), "finite"),
        (np.full(8, 1e300), "finite"),
        (np.array([object()] * 8), "floats"),
    ],
)
def test_broken_arrays_are_data_errors(files, value, said):
    def damage(heads):
        del heads["lin2"]
        if value is not None:
            heads["lin2"] = value

    change_arrays(files / HEADS_FILE, damage)
    with refused(DataError, path=files / HEADS_FILE, key="lin2") as error:
        Lpips.load(files)
    assert error.value.expected.startswith(said)

"""LPIPS: the authors' figures where the weights are at hand, hand-made networks everywhere else."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from kgs._support.errors import DataError
from kgs.metrics.lpips import Lpips

VGG16 = {0: (64, 3), 2: (64, 64), 5: (128, 64), 7: (128, 128), 10: (256, 128), 12: (256, 256), 14: (256, 256)}
VGG16 |= {17: (512, 256), 19: (512, 512), 21: (512, 512), 24: (512, 512), 26: (512, 512), 28: (512, 512)}
HEADS = (64, 128, 256, 512, 512)
SHIFT = np.array([-0.030, -0.088, -0.188])
SCALE = np.array([0.458, 0.448, 0.450])


def zero_arrays():
    """Zeros in the layout of the files: all features are 0, and so is the distance."""
    features = {}
    for index, shape in VGG16.items():
        features[f"features.{index}.weight"] = np.zeros((*shape, 3, 3), np.float16)
        features[f"features.{index}.bias"] = np.zeros(shape[0], np.float16)
    heads = {f"lin{i}": np.zeros(width, np.float32) for i, width in enumerate(HEADS)}
    return features, heads


def write(folder, features, heads):
    np.savez(folder / "vgg16_features.npz", **features)
    np.savez(folder / "lpips_lin_vgg16.npz", **heads)
    return folder


@pytest.fixture(scope="module")
def zeros(tmp_path_factory):
    """A folder with whole files."""
    return write(tmp_path_factory.mktemp("zeros"), *zero_arrays())


@pytest.fixture
def copied(zeros, tmp_path):
    """A copy whose heads a test may damage."""
    shutil.copy(zeros / "lpips_lin_vgg16.npz", tmp_path)
    (tmp_path / "vgg16_features.npz").symlink_to(zeros / "vgg16_features.npz")
    return tmp_path


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


def test_first_block_by_hand_averaged_over_the_image(tmp_path):
    """Its two layers copy red and green."""
    features, heads = zero_arrays()
    for layer in (0, 2):
        features[f"features.{layer}.weight"][0, 0, 1, 1] = 1
        features[f"features.{layer}.weight"][1, 1, 1, 1] = 1
    heads["lin0"][:2] = 0.5, 2.0
    lpips = Lpips.load(write(tmp_path, features, heads))
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


def test_a_random_network_gives_a_distance():
    torch.manual_seed(0)
    lpips = Lpips()
    x, y = torch.rand(2, 2, 3, 16, 19)
    assert torch.equal(lpips(x, x), torch.zeros(2))
    assert (lpips(x, y) > 0).all()
    torch.testing.assert_close(lpips(x, y), lpips(y, x))
    torch.testing.assert_close(lpips(x, y)[1:], lpips(x[1:], y[1:]))


def test_gradient_reaches_the_image_and_not_the_weights():
    torch.manual_seed(0)
    lpips = Lpips()
    image = torch.rand(1, 3, 16, 16, requires_grad=True)
    lpips(image, torch.rand(1, 3, 16, 16)).backward()
    assert image.grad.abs().max() > 0
    assert not any(parameter.requires_grad for parameter in lpips.parameters())


def test_loading_draws_no_random_numbers(zeros):
    state = torch.get_rng_state()
    Lpips.load(zeros)
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize(
    ("argument", "image", "target"),
    [("image", (1, 3, 15, 40), (1, 3, 15, 40)), ("target", (1, 3, 40, 40), (2, 3, 40, 40))],
)
def test_wrong_shapes_are_named(argument, image, target):
    with pytest.raises(ValueError, match=f"^{argument}: "):
        Lpips()(torch.rand(image), torch.rand(target))


def test_missing_files_are_data_errors(tmp_path, copied):
    with pytest.raises(DataError, match="nowhere: expected a folder"):
        Lpips.load(tmp_path / "nowhere")
    for name in ("lpips_lin_vgg16.npz", "vgg16_features.npz"):
        (copied / name).unlink()
        with pytest.raises(DataError) as error:
            Lpips.load(copied)
        assert error.value.path == copied / name


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda heads: heads.pop("lin2"), "lin2: expected an array"),
        (lambda heads: heads.update(lin2=np.zeros(255, np.float32)), "lin2: expected floats of shape"),
        (lambda heads: heads.update(lin2=np.zeros((1, 256, 1, 1), np.float32)), "lin2: expected floats of shape"),
        (lambda heads: heads.update(lin2=np.zeros(256, np.int64)), "lin2: expected floats"),
        (lambda heads: heads.update(lin2=np.full(256, np.nan)), "lin2: expected finite"),
        (lambda heads: heads.update(lin2=np.full(256, 1e300)), "lin2: expected finite"),
        (lambda heads: heads.update(lin2=np.array([object()] * 256)), "lin2: expected floats"),
    ],
)
def test_broken_arrays_are_data_errors(copied, change, message):
    _, heads = zero_arrays()
    change(heads)
    path = copied / "lpips_lin_vgg16.npz"
    np.savez(path, **heads)
    with pytest.raises(DataError, match=message) as caught:
        Lpips.load(copied)
    assert caught.value.path == path

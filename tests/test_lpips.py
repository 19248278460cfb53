"""LPIPS: the authors' figures where the weights are at hand, hand-made networks everywhere else."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from kgs.errors import DataError
from kgs.metrics.lpips import Lpips

ALEXNET = {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3), 10: (256, 256, 3)}
SHIFT = np.array([-0.030, -0.088, -0.188])
SCALE = np.array([0.458, 0.448, 0.450])


def alexnet_arrays():
    """Zeros in the layout of the files: all features are 0, and so is the distance."""
    features = {}
    for index, (out, channels, size) in ALEXNET.items():
        features[f"features.{index}.weight"] = np.zeros((out, channels, size, size), np.float16)
        features[f"features.{index}.bias"] = np.zeros(out, np.float16)
    heads = {f"lin{i}": np.zeros(out, np.float32) for i, (out, _, _) in enumerate(ALEXNET.values())}
    return features, heads


def write(folder, features, heads):
    np.savez(folder / "alexnet_features.npz", **features)
    np.savez(folder / "lpips_lin_alexnet.npz", **heads)
    return folder


def flat(color, size=64):
    return torch.tensor(color).view(1, 3, 1, 1).expand(1, 3, size, size)


@pytest.fixture
def weights():
    root = os.environ.get("KGS_DATA")
    folder = Path(root or "", "weights")
    if not root or not folder.is_dir():
        pytest.skip("KGS_DATA is not set to a folder with weights/")
    return folder


@pytest.mark.parametrize(
    ("net", "image", "expected"),
    [
        ("alexnet", "ex_p0", 0.7219),
        ("alexnet", "ex_p1", 0.1376),
        ("vgg16", "ex_p0", 0.5686),
        ("vgg16", "ex_p1", 0.4217),
    ],
)
def test_published_figures(weights, net, image, expected):
    def read(name):
        pixels = cv2.imread(str(weights / "reference_images" / f"{name}.png"))
        return torch.from_numpy(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)).permute(2, 0, 1)[None] / 255

    distance = Lpips.load(weights, net)(read("ex_ref"), read(image))
    assert distance.item() == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("rescale", [True, False])
def test_first_layer_by_hand(tmp_path, rescale):
    # Channel 0 and 1 of the first layer copy red and green (2 px inside, so that no window's centre meets padding).
    features, heads = alexnet_arrays()
    features["features.0.weight"][0, 0, 5, 5] = 1
    features["features.0.weight"][1, 1, 5, 5] = 1
    heads["lin0"][:2] = 0.5, 2.0
    lpips = Lpips.load(write(tmp_path, features, heads), "alexnet")

    def direction(color):
        values = np.array(color) * 2 - 1 if rescale else np.array(color)
        values = np.maximum(((values - SHIFT) / SCALE)[:2], 0)
        return values / np.linalg.norm(values)

    x, y = (0.9, 0.6, 0.1), (0.7, 0.95, 0.4)
    expected = np.array([0.5, 2.0]) @ (direction(x) - direction(y)) ** 2
    assert lpips(flat(x), flat(y), rescale=rescale).item() == pytest.approx(expected, rel=1e-5)


def test_distance_is_averaged_over_the_image(tmp_path):
    features, heads = alexnet_arrays()
    features["features.0.weight"][0, 0, 5, 5] = 1
    features["features.0.weight"][1, 1, 5, 5] = 1
    heads["lin0"][:2] = 1.0
    lpips = Lpips.load(write(tmp_path, features, heads), "alexnet")
    x, y = flat((0.9, 0.6, 0.1), 67), flat((0.7, 0.95, 0.4), 67)
    half = x.clone()
    # 16 output columns look at pixels 3, 7, ..., 63: the first 8 lie left of column 33.
    half[..., :33] = y[..., :33]
    assert lpips(x, half).item() == pytest.approx(lpips(x, y).item() / 2, rel=1e-5)


@pytest.mark.parametrize(("net", "size"), [("alexnet", 31), ("vgg16", 16)])
def test_random_networks_give_a_distance(net, size):
    torch.manual_seed(0)
    lpips = Lpips(net)
    x, y = torch.rand(2, 2, 3, size, size + 3)
    assert torch.equal(lpips(x, x), torch.zeros(2))
    assert (lpips(x, y) > 0).all()
    torch.testing.assert_close(lpips(x, y), lpips(y, x))
    torch.testing.assert_close(lpips(x, y)[1:], lpips(x[1:], y[1:]))


def test_gradient_reaches_the_image_and_not_the_weights():
    torch.manual_seed(0)
    lpips = Lpips("alexnet")
    image = torch.rand(1, 3, 40, 40, requires_grad=True)
    lpips(image, torch.rand(1, 3, 40, 40)).backward()
    assert image.grad.abs().max() > 0
    assert not any(parameter.requires_grad for parameter in lpips.parameters())


def test_loading_draws_no_random_numbers(tmp_path):
    write(tmp_path, *alexnet_arrays())
    state = torch.get_rng_state()
    Lpips.load(tmp_path, "alexnet")
    assert torch.equal(torch.get_rng_state(), state)


def test_wrong_arguments_are_named(tmp_path):
    with pytest.raises(ValueError, match="net: expected one of"):
        Lpips("resnet")
    with pytest.raises(ValueError, match="net: expected one of"):
        Lpips.load(tmp_path, "resnet")
    lpips = Lpips("alexnet")
    with pytest.raises(ValueError, match=r"image: expected shape \(B, 3, H, W\) with H, W >= 31"):
        lpips(torch.rand(1, 3, 30, 40), torch.rand(1, 3, 30, 40))
    with pytest.raises(ValueError, match="target: expected shape"):
        lpips(torch.rand(1, 3, 40, 40), torch.rand(2, 3, 40, 40))


def test_missing_files_are_data_errors(tmp_path):
    with pytest.raises(DataError, match="expected a folder"):
        Lpips.load(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"vgg16_features.npz: expected an npz file of LPIPS weights, got none"):
        Lpips.load(tmp_path)
    write(tmp_path, *alexnet_arrays())
    (tmp_path / "lpips_lin_alexnet.npz").unlink()
    with pytest.raises(DataError, match=r"lpips_lin_alexnet.npz: expected an npz file"):
        Lpips.load(tmp_path, "alexnet")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda heads: heads.pop("lin2"), "lin2: expected an array"),
        (lambda heads: heads.update(lin2=np.zeros(383, np.float32)), "lin2: expected floats of shape"),
        (lambda heads: heads.update(lin2=np.zeros((1, 384, 1, 1), np.float32)), "lin2: expected floats of shape"),
        (lambda heads: heads.update(lin2=np.zeros(384, np.int64)), "lin2: expected floats"),
        (lambda heads: heads.update(lin2=np.full(384, np.nan)), "lin2: expected finite"),
        (lambda heads: heads.update(lin2=np.full(384, 1e300)), "lin2: expected finite"),
        (lambda heads: heads.update(lin2=np.array([object()] * 384)), "lin2: expected floats"),
    ],
)
def test_broken_arrays_are_data_errors(tmp_path, change, message):
    features, heads = alexnet_arrays()
    change(heads)
    write(tmp_path, features, heads)
    with pytest.raises(DataError, match=message) as caught:
        Lpips.load(tmp_path, "alexnet")
    assert caught.value.path == tmp_path / "lpips_lin_alexnet.npz"


def test_broken_bytes_are_data_errors(tmp_path):
    write(tmp_path, *alexnet_arrays())
    path = tmp_path / "lpips_lin_alexnet.npz"
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[200] ^= 255
    for content in (b"", b"not an archive", whole[: len(whole) // 2], bytes(flipped)):
        path.write_bytes(content)
        with pytest.raises(DataError):
            Lpips.load(tmp_path, "alexnet")
    np.save(path.with_suffix(".npy"), np.zeros(64))
    path.with_suffix(".npy").rename(path)
    with pytest.raises(DataError, match="expected an npz file"):
        Lpips.load(tmp_path, "alexnet")

"""Masks of photos: read, resized with the photo; what they leave out is ignored, or empty."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from init_point_scenes import painted_planes
from tiny_scenes import update_json, write_colmap, write_llff, write_nerfstudio

from kgs._support.errors import DataError
from kgs.datasets import load_scene
from kgs.datasets.scene import Views
from kgs.fit.targets import targets
from kgs.metrics.evaluate import evaluate, mean_psnr

LEFT = np.zeros((12, 16), np.uint8)
LEFT[:, 8:] = 255  # black on the left: only the right half is kept


def write_mask(path: Path, mask: np.ndarray = LEFT) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), mask)
    return path


def in_the_file(root: Path) -> None:
    write_nerfstudio(root)
    update_json(root / "transforms.json", 0, mask_path="elsewhere/a.png")
    write_mask(root / "elsewhere" / "a.png")


def in_folders_of_the_photos_names(root: Path) -> None:
    write_nerfstudio(root)
    for k in range(3):
        (root / f"images/cam{k}").mkdir()
        (root / f"images/{k}.png").rename(root / f"images/cam{k}/a.png")
        update_json(root / "transforms.json", k, file_path=f"images/cam{k}/a.png")
    write_mask(root / "masks" / "cam0" / "a.png")


def larger_and_coloured(root: Path) -> None:
    write_llff(root)
    mask = cv2.resize(LEFT, (64, 48), interpolation=cv2.INTER_NEAREST)
    write_mask(root / "masks" / "0.jpg", np.repeat(mask[..., None], 3, 2))


@pytest.mark.parametrize(
    "write",
    [
        *("masks/0.png", "masks/0.PNG.png", "images/masks/0.png"),
        in_the_file,
        in_folders_of_the_photos_names,
        larger_and_coloured,
    ],
    ids=lambda write: write if isinstance(write, str) else write.__name__,
)
def test_black_is_looked_away_from(tmp_path: Path, write: str | Callable[[Path], None]) -> None:
    """Of a mask of this name, or as a function writes it."""
    if isinstance(write, str):
        write_colmap(tmp_path)
        write_mask(tmp_path / write)
    else:
        write(tmp_path)
    scene = load_scene(tmp_path, hold_out=0)
    valid = scene.train.valid_mask
    assert valid is not None
    assert bool(valid[1:].all())  # photos without a mask count
    kept = torch.nonzero(valid[0])
    assert 7 <= int(kept[:, 1].min()) <= 9
    assert 0.4 < float(valid[0].float().mean()) < 0.6
    assert any("masks of 1 of 3 photos" in note for note in scene.notes)
    assert scene.train.alphas is None


def test_a_photo_that_a_scene_names_may_look_like_a_mask(tmp_path: Path) -> None:
    write_nerfstudio(tmp_path)
    (tmp_path / "images" / "1.png").rename(tmp_path / "images" / "0_mask.png")
    update_json(tmp_path / "transforms.json", 1, file_path="images/0_mask.png")
    scene = load_scene(tmp_path, hold_out=0)
    assert "images/0_mask.png" in scene.train.names
    assert scene.train.valid_mask is None


@pytest.mark.parametrize(("kind", "white"), [(np.uint8, 255), (np.uint8, 1), (np.uint16, 255), (np.uint16, 65535)])
def test_white_is_the_largest_value_of_a_mask(tmp_path: Path, kind: type[np.uint8], white: int) -> None:
    write_llff(tmp_path)
    write_mask(tmp_path / "masks" / "0.png", (LEFT // 255).astype(kind) * kind(white))
    write_mask(tmp_path / "masks" / "1.png", np.full((12, 16), np.iinfo(kind).max, kind))
    valid = load_scene(tmp_path, hold_out=0).train.valid_mask
    assert valid is not None
    assert [float(kept.float().mean()) for kept in valid] == [0.5, 1, 1]


def test_black_is_not_there(tmp_path: Path) -> None:
    write_llff(tmp_path)
    write_mask(tmp_path / "others" / "0.png")
    scene = load_scene(tmp_path, hold_out=0, masks=tmp_path / "others", mask_mode="transparent", background="white")
    assert scene.train.valid_mask is None
    assert scene.train.alphas is not None
    assert scene.train.alphas.mean((1, 2, 3)).tolist() == pytest.approx([0.5, 1.0, 1.0])
    assert bool((scene.train.images[0, :, :, :8] == 1).all())  # the background
    plain = load_scene(tmp_path, hold_out=0)
    assert plain.train.valid_mask is None
    assert torch.equal(plain.train.images[0, :, :, 8:], scene.train.images[0, :, :, 8:])


def test_a_mask_is_reduced_with_its_photo(tmp_path: Path) -> None:
    write_llff(tmp_path)
    mask = np.full((12, 16), 255, np.uint8)
    mask[5, 7] = 0
    write_mask(tmp_path / "masks" / "1.png", mask)
    views = load_scene(tmp_path, hold_out=0, downscale=2).train
    assert views.valid_mask is not None
    assert (~views.valid_mask).nonzero().tolist() == [[1, 2, 3]]  # a pixel that a mask covers in part does not count
    again = load_scene(tmp_path, hold_out=0).train
    halved = again.downsample(2)
    assert halved.valid_mask is not None
    assert torch.equal(halved.valid_mask, views.valid_mask)
    chosen = again.select([1])
    assert chosen.valid_mask is not None
    assert int((~chosen.valid_mask).sum()) == 1
    assert [int((~view["valid_mask"]).sum()) for view in again] == [0, 1, 0]


def test_photos_that_are_missing_are_named_beside_masks_too(tmp_path: Path) -> None:
    in_the_file(tmp_path)
    update_json(tmp_path / "transforms.json", 0, file_path="gone/0.png", mask_path="")
    write_mask(tmp_path / "masks" / "1.png")
    with pytest.raises(DataError, match="there is no"):
        load_scene(tmp_path, hold_out=0)


@pytest.fixture
def half() -> Views:
    """Three views of which the left half does not count."""
    views = painted_planes()
    valid = torch.ones(views.images[:, 0].shape, dtype=torch.bool)
    valid[:, :, : valid.shape[2] // 2] = False
    return Views(views.cameras, views.images, views.names, valid_mask=valid)


def test_the_loss_has_no_gradient_where_no_pixel_counts(half: Views) -> None:
    for view, target in enumerate(targets(half, torch.zeros(3), torch.device("cpu"))):
        render = torch.full_like(target.image, 0.4).requires_grad_()
        (gradient,) = torch.autograd.grad((target.as_photographed(render) - target.image).square().sum(), render)
        assert half.valid_mask is not None
        assert torch.equal(gradient[0].any(0), half.valid_mask[view])


def test_only_pixels_that_count_are_measured(half: Views) -> None:
    assert half.valid_mask is not None
    renders = iter(torch.where(half.valid_mask[:, None], half.images + 0.01, 0.5).clamp(0, 1)[:, None])
    plain = Views(half.cameras, half.images, half.names)
    shown = evaluate(lambda _: next(renders), half)
    renders = iter((half.images + 0.01).clamp(0, 1)[:, None])
    whole = evaluate(lambda _: next(renders), plain)
    assert shown["psnr"] == pytest.approx(40.0, abs=0.1)
    assert shown["psnr"] == pytest.approx(whole["psnr"], abs=0.1)
    assert shown["valid"] == 0.5
    assert "valid" not in whole
    renders = iter(torch.where(half.valid_mask[:, None], half.images + 0.01, 0.5).clamp(0, 1)[:, None])
    assert mean_psnr(lambda _: next(renders), half) == pytest.approx(shown["psnr"], abs=1e-3)


def test_a_colour_that_a_mask_leaves_out_does_not_show_beside_it(tmp_path: Path) -> None:
    """Undistorted and reduced: a pixel that counts has the colour of what the mask keeps, whatever it leaves out."""
    write_nerfstudio(tmp_path)
    paths = sorted((tmp_path / "images").iterdir())
    height, width = cv2.imread(str(paths[0])).shape[:2]
    scale = 40
    kept = np.full((height * scale, width * scale), 255, np.uint8)
    cv2.circle(kept, (width * scale // 2, height * scale // 2), 4 * scale + 7, 0, -1)
    for path in paths:
        cv2.imwrite(str(path), np.where(kept[..., None] > 0, np.uint8([30, 60, 200]), np.uint8([255, 255, 255])))
        write_mask(tmp_path / "masks" / path.with_suffix(".png").name, kept)
    views = load_scene(tmp_path, hold_out=0, downscale=scale / 3).train
    assert views.valid_mask is not None
    assert 0.3 < float(views.valid_mask.float().mean()) < 0.95
    seen = views.images.permute(0, 2, 3, 1)[views.valid_mask]
    torch.testing.assert_close(seen, torch.tensor([200.0, 60.0, 30.0]).expand_as(seen) / 255, atol=1e-5, rtol=0)

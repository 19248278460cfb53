"""Masks of photos: found, read, resized with the photo; what they leave out is ignored, or empty."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
import torch
from init_point_scenes import painted_planes
from tiny_scenes import update_json, write_colmap, write_llff, write_nerfstudio

from kgs._support.errors import DataError
from kgs.datasets import load_scene
from kgs.datasets.folders import list_images
from kgs.datasets.mask_files import find_mask_files
from kgs.datasets.scene import Views
from kgs.fit.config import FitConfig
from kgs.fit.measures import measure
from kgs.fit.run import fit_scene
from kgs.fit.targets import targets
from kgs.init_points.tracks import detect
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


def beside_the_photo(root: Path) -> None:
    write_nerfstudio(root)
    write_mask(root / "images" / "dynamic_mask_0.png", 255 - LEFT)


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
    write_mask(root / "mask" / "0.jpg", np.repeat(mask[..., None], 3, 2))


@pytest.mark.parametrize(
    "write",
    [
        *("masks/0.png", "masks/0.PNG.png", "images/masks/0.png"),
        *("Masks/0.png", "MASK/0.PNG.png", "masks/0_mask.png", "masks/0.mask.png", "masks/mask_0.jpg"),
        *("masks/0.PNG_mask.png", "images/0_mask.png", "images/0-MASK.PNG", "images/0.mask.png"),
        *("images/mask_0.png", "images/0.PNG.png", "images/Masks/0.png"),
        in_the_file,
        beside_the_photo,
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


@pytest.mark.parametrize("name", ["0_mask.png", "0.png.png", "dynamic_mask_0.png"])
def test_masks_among_photos_are_not_counted_as_photos(tmp_path: Path, name: str) -> None:
    """A layout that takes all photos of a folder."""
    write_llff(tmp_path)
    write_mask(tmp_path / "images" / name)
    scene = load_scene(tmp_path, hold_out=0)
    assert len(scene.train) == 3
    assert scene.train.valid_mask is not None


@pytest.mark.parametrize(
    ("photo", "other"),
    [
        *(("a.webp", "a.webp.jpg"), ("a.heic", "a.HEIC.jpg"), ("a.jpg", "a.jpg.jpg"), ("a.png", "a.png.jpg")),
        *(("a.cr2", "a.CR2.png"), ("a.png", "a.png.png"), ("a.jpg", "a_mask.png"), ("a.jpg", "mask_a.jpg")),
    ],
)
@pytest.mark.parametrize(
    "kind", ["colours", "grey", "grey with noise", "grey in three channels", "palette", "black and white"]
)
def test_a_picture_beside_a_photo_is_a_mask_only_without_colours(
    tmp_path: Path, photo: str, other: str, kind: str
) -> None:
    """Converters and makers of thumbnails add an ending, too: unless its name says mask, a mask ends in .png."""
    (tmp_path / photo).write_bytes(b"any")
    picture = PIL.Image.fromarray(LEFT)
    if kind == "colours":
        picture = PIL.Image.fromarray(np.dstack([LEFT, LEFT, 0 * LEFT]))
    elif kind == "grey with noise":  # of a compression with loss
        picture = PIL.Image.fromarray(np.dstack([LEFT, LEFT, LEFT // 2 * 2]))
    elif kind != "grey":
        mode = {"grey in three channels": "RGB", "palette": "P", "black and white": "1"}[kind]
        picture = picture.convert(mode if other.endswith(".png") else "RGB")
    picture.save(tmp_path / other)
    is_named_so = "mask" in other or other.endswith(".png")
    readable = {other, photo} - {"a.heic", "a.cr2"}
    photos = {path.name for path in list_images(tmp_path)}
    assert photos == (readable - {other} if is_named_so and kind != "colours" else readable)


def test_a_photo_of_llff_may_be_called_like_another_one_with_an_ending(tmp_path: Path) -> None:
    write_llff(tmp_path)
    photos = sorted((tmp_path / "images").iterdir())
    photos[1].rename(photos[0].with_name(f"{photos[0].name}.jpg"))
    scene = load_scene(tmp_path, hold_out=0)
    assert len(scene.train) == 3
    assert scene.train.valid_mask is None


def test_photos_whose_names_only_look_like_masks_stay_photos(tmp_path: Path) -> None:
    """As of a carnival mask; and a model may name what looks like a mask of another photo."""
    write_llff(tmp_path)
    for path in sorted((tmp_path / "images").iterdir()):
        path.rename(path.with_name(f"mask_{path.name}"))
    assert load_scene(tmp_path, hold_out=0).train.valid_mask is None
    write_nerfstudio(tmp_path / "named")
    (tmp_path / "named" / "images" / "1.png").rename(tmp_path / "named" / "images" / "0_mask.png")
    update_json(tmp_path / "named" / "transforms.json", 1, file_path="images/0_mask.png")
    assert load_scene(tmp_path / "named", hold_out=0).train.valid_mask is None


def test_a_picture_beside_photos_that_is_called_like_a_mask_is_named(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    write_mask(tmp_path / "images" / "0_seg.png")
    (note,) = load_scene(tmp_path, hold_out=0).notes
    assert "0_seg.png" in note


@pytest.mark.parametrize("name", ["segmentation", "Person_Masks"])
def test_a_folder_that_is_called_like_masks_is_named(tmp_path: Path, name: str) -> None:
    write_llff(tmp_path)
    write_mask(tmp_path / name / "0.png")
    (note,) = load_scene(tmp_path, hold_out=0).notes
    assert name in note
    assert "--masks" in note
    write_mask(tmp_path / "masks" / "0.png")
    assert name not in " ".join(load_scene(tmp_path, hold_out=0).notes)


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


def test_metrics_say_which_pixels_were_compared(tmp_path: Path) -> None:
    write_llff(tmp_path)
    config = FitConfig(steps=1, evaluations=1, init="random", init_points=20)
    fit = fit_scene(load_scene(tmp_path, hold_out=0), config)
    assert "all pixels" in measure(fit)["protocol"]["psnr"]
    write_mask(tmp_path / "masks" / "0.png")
    masked = replace(fit, scene=load_scene(tmp_path, hold_out=0))
    assert "the pixels that count" in measure(masked)["protocol"]["psnr"]


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


def test_masks_that_cannot_be_found(tmp_path: Path) -> None:
    write_llff(tmp_path)
    with pytest.raises(DataError, match="nowhere: "):
        load_scene(tmp_path, masks=tmp_path / "nowhere")
    with pytest.raises(ValueError, match="mask_mode"):
        load_scene(tmp_path, mask_mode="gone")


def test_photos_that_are_missing_are_named_beside_masks_too(tmp_path: Path) -> None:
    in_the_file(tmp_path)
    update_json(tmp_path / "transforms.json", 0, file_path="gone/0.png", mask_path="")
    write_mask(tmp_path / "masks" / "1.png")
    with pytest.raises(DataError, match="there is no"):
        load_scene(tmp_path, hold_out=0)


def test_a_mask_of_a_photo_that_is_not_in_the_model_is_no_error(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    cv2.imwrite(str(tmp_path / "images" / "not registered.png"), LEFT)
    write_mask(tmp_path / "masks" / "not registered.png")
    write_mask(tmp_path / "masks" / "0.png")
    assert load_scene(tmp_path, hold_out=0).train.valid_mask is not None


def test_the_folder_of_photos_is_listed_as_often_for_many_masks_as_for_few(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A model may have registered few of the photos whose masks are there."""
    seen: list[int] = []
    for count in (3, 30):
        root = tmp_path / str(count)
        for k in range(count):
            write_mask(root / "images" / f"{k}.png")
            write_mask(root / "masks" / f"{k}.png")
        scans: list[object] = []
        real = os.scandir
        monkeypatch.setattr(os, "scandir", lambda path, scans=scans, real=real: scans.append(path) or real(path))
        assert len(find_mask_files([root / "images" / "0.png"], root).keeping) == 1
        monkeypatch.undo()
        seen.append(len(scans))
    assert seen[0] == seen[1] > 0


@pytest.fixture
def half() -> Views:
    """Three views of which the left half does not count."""
    views = painted_planes()
    valid = torch.ones(views.images[:, 0].shape, dtype=torch.bool)
    valid[:, :, : valid.shape[2] // 2] = False
    return Views(views.cameras, views.images, views.names, valid_mask=valid)


def test_no_keypoint_lies_where_no_pixel_counts(half: Views) -> None:
    pixels, _ = detect(half, 0, 1000)
    assert len(pixels) > 50
    assert float(pixels[:, 0].min()) >= half.images.shape[-1] // 2 - 1


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


def test_a_folder_of_masks_without_pictures_is_passed_over_unless_it_is_named(tmp_path: Path) -> None:
    write_llff(tmp_path)
    write_mask(tmp_path / "masks" / "of_another_kind.txt.d" / "0.png")
    assert load_scene(tmp_path, hold_out=0).train.valid_mask is None
    with pytest.raises(DataError, match="masks: "):
        load_scene(tmp_path, hold_out=0, masks=tmp_path / "masks")


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

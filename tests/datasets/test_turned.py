"""Upright and lying photos in one scene: the rarer kind is turned, with its camera, and shown as it was taken."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from init_point_scenes import painted_planes
from kornia.geometry.camera import PinholeCamera
from tiny_scenes import write_transforms

from kgs import GaussianModel, GaussianRenderer
from kgs.app.cli.page import in_frame_of
from kgs.app.files.cameras import as_taken, shown
from kgs.datasets import load_scene
from kgs.datasets.scene import Views

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
BACK = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])  # a picture turned counterclockwise
NAMES = ("0.png", "1.png", "2.png")


def write(root: Path, turned: tuple[int, ...], mask: int | None = None) -> Path:
    """The painted planes as nerfstudio has them; photos in `turned` as an upright camera would have taken them."""
    views = painted_planes()
    (root / "images").mkdir(parents=True)
    (root / "depths").mkdir()
    frames = {}
    for i, name in enumerate(NAMES):
        image = (views.images[i].permute(1, 2, 0).numpy()[..., ::-1] * 255).round().astype(np.uint8)
        height, width = image.shape[:2]
        matrix = views.cameras.intrinsics[i].double().numpy()
        fx, fy, cx, cy = matrix[0, 0], matrix[1, 1] * 1.1, matrix[0, 2] + 3.5, matrix[1, 2] - 1.5
        pose = np.linalg.inv(views.cameras.extrinsics[i].double().numpy())
        kept = np.full((height, width), 255, np.uint8)
        kept[: height // 3] = 0
        depths = np.arange(1.0, height * width + 1).reshape(height, width)
        if i in turned:  # x' = y, y' = W - x
            image, kept, depths = np.rot90(image), np.rot90(kept), np.rot90(depths)
            fx, fy, cx, cy = fy, fx, cy, width - cx
            height, width = width, height
            pose = pose @ BACK
        cv2.imwrite(str(root / "images" / name), image)
        lens = {"w": width, "h": height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
        frames[f"images/{name}"] = {"transform_matrix": (pose @ OPENGL).tolist(), **lens}
        np.save(root / "depths" / f"{i}.npy", depths)
        if i == mask:
            (root / "masks").mkdir()
            cv2.imwrite(str(root / "masks" / name), kept)
    write_transforms(root / "transforms.json", {}, frames)
    return root


def close(one: PinholeCamera, other: PinholeCamera) -> bool:
    names = ("intrinsics", "extrinsics", "height", "width")
    return all(torch.allclose(getattr(one, name), getattr(other, name), atol=1e-5) for name in names)


@pytest.mark.parametrize(("turned", "downscale"), [(0, None), (1, None), (2, 1.5)])
def test_the_rarer_kind_is_turned_with_its_camera(tmp_path: Path, turned: int, downscale: float | None):
    folders = write(tmp_path / "mixed", (turned,), mask=turned), write(tmp_path / "plain", (), mask=turned)
    mixed, plain = (load_scene(root, None, downscale, hold_out=0, depths=root / "depths").train for root in folders)
    assert mixed.turned == tuple(i == turned for i in range(3))
    assert plain.turned is None
    assert close(mixed.cameras, plain.cameras)
    assert torch.equal(mixed.images, plain.images)
    assert mixed.valid_mask is not None
    assert plain.valid_mask is not None
    assert torch.equal(mixed.valid_mask, plain.valid_mask)
    assert mixed.depths is not None
    assert plain.depths is not None
    assert torch.equal(mixed.depths, plain.depths)
    taken = shown(mixed)[turned]
    assert taken.depths is not None
    assert torch.equal(taken.depths[0], plain.depths[turned].rot90())


def test_where_most_photos_are_upright_the_lying_ones_are_turned(tmp_path: Path):
    mixed = load_scene(write(tmp_path / "mixed", (1, 2)), hold_out=0).train
    assert mixed.turned == (True, False, False)
    assert tuple(mixed.images.shape[-2:]) == (240, 180)
    plain = load_scene(write(tmp_path / "plain", ()), hold_out=0).train
    lying = shown(mixed)[0]
    assert close(lying.cameras, plain.select([0]).cameras)
    assert torch.equal(lying.images, plain.images[:1])


def test_a_turned_photo_is_shown_as_it_was_taken(tmp_path: Path):
    views = load_scene(write(tmp_path, (1,)), hold_out=0).train
    parts = shown(views)
    assert [tuple(part.images.shape[-2:]) for part in parts] == [(180, 240), (240, 180), (180, 240)]
    photo = cv2.imread(str(tmp_path / "images" / "1.png"))[..., ::-1] / np.float32(255)
    assert torch.allclose(parts[1].images[0].permute(1, 2, 0), torch.from_numpy(photo), atol=1e-6)
    assert torch.equal(as_taken(views.images[1], views, 1), parts[1].images[0])
    assert torch.equal(as_taken(views.images[0], views, 0), views.images[0])
    again = shown(views, 90.0)
    assert [tuple(part.images.shape[-2:]) for part in again] == [(240, 180), (180, 240), (240, 180)]
    assert shown(Views(views.cameras, views.images, views.names)) != []


def test_photos_of_a_page_are_in_the_frame_of_all_though_most_of_them_are_of_the_rarer_kind(tmp_path: Path):
    """Renders at the same camera, once turned and once as it was taken."""
    root = write(tmp_path / "mixed", (0,))
    scene = load_scene(root, hold_out=0, photos=False)
    alone = load_scene(root, 1, hold_out=0)  # the first photo, which stands
    assert scene.train.turned == (True, False, False)
    assert alone.train.turned is None
    moved = in_frame_of(scene, alone)
    torch.manual_seed(0)
    model = GaussianModel.from_points(
        scene.train.cameras.extrinsics.new_tensor([[0.0, 0, 2]]) + torch.rand(50, 3), torch.rand(50, 3)
    )
    renderer = GaussianRenderer()
    with torch.no_grad():
        turned, taken = (renderer(model(), views.camera(0)).image[0] for views in (scene.train, moved))
    assert float(taken.amax()) > 0.1
    torch.testing.assert_close(torch.rot90(turned, 1, (1, 2)), taken, atol=1e-4, rtol=0)

"""Views: a data set of dicts; halved pictures keep showing the same rays; cameras without photos; float32."""

import numpy as np
import pytest
import torch
from kornia.geometry.camera import PinholeCamera
from tiny_scenes import write_blender, write_colmap, write_llff, write_nerfstudio
from torch.utils.data import DataLoader

from kgs.datasets import load_scene, synthetic_scene
from kgs.datasets.scene import Views


def views(height, width):
    intrinsics = torch.eye(4).repeat(2, 1, 1)
    intrinsics[:, 0, 0], intrinsics[:, 1, 1] = 30.0, 31.0
    intrinsics[:, 0, 2], intrinsics[:, 1, 2] = 9.3, 7.1
    extrinsics = torch.eye(4).repeat(2, 1, 1)
    extrinsics[:, 2, 3] = 1.0
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    images = torch.stack([rows, columns, rows + columns]).float().expand(2, 3, height, width) / 100
    sizes = (torch.full((2,), float(size)) for size in (height, width))
    return Views(PinholeCamera(intrinsics, extrinsics, *sizes), images, ("a", "b"), torch.ones(2, 1, height, width))


@pytest.mark.parametrize("size", [(16, 20), (15, 21)])
def test_a_point_projects_to_the_same_position_in_a_halved_picture(size):
    full = views(*size)
    half = full.downsample(2)
    assert half.images.shape == (2, 3, size[0] // 2, size[1] // 2)
    assert half.alphas.shape == (2, 1, size[0] // 2, size[1] // 2)
    points = torch.tensor([[[0.1, -0.2, 3.0]], [[-0.3, 0.1, 2.0]]])
    on_full, on_half = full.cameras.project(points), half.cameras.project(points)
    # pixel k of the halved picture covers pixels 2k and 2k + 1, whose middle is 2k + 1/2
    assert torch.allclose(on_full, 2 * on_half + 0.5, atol=1e-5)
    # the picture is a ramp in its own coordinates, and so is the halved one
    assert torch.allclose(half.images[0, 1, 0, 3], torch.tensor(6.5 / 100))


def test_views_are_a_data_set_of_dicts():
    given = views(6, 8)
    assert len(given) == len(list(given)) == 2
    for i, view in enumerate(given):
        assert torch.equal(view["image"], given.images[i])
        assert torch.equal(view["extrinsics"], given.cameras.extrinsics[i])
        assert torch.equal(view["intrinsics"], given.cameras.intrinsics[i, :3, :3])
        assert torch.equal(view["alpha"], given.alphas[i])
        assert (view["index"], view["name"]) == (i, "ab"[i])
    assert given[-1]["name"] == given[np.int64(1)]["name"] == "b"
    for index in (2, -3):
        with pytest.raises(IndexError, match=f"below 2, the number of views, got {index}"):
            given[index]
    with pytest.raises(TypeError):
        given["a"]
    assert "alpha" not in synthetic_scene(train_views=1, test_views=0, size=(6, 8)).train[0]


@pytest.mark.parametrize("workers", [0, 1])
def test_torchs_loader_makes_batches_of_views(workers):
    given = synthetic_scene(train_views=5, test_views=1, size=(6, 8)).train
    loader = DataLoader(given, batch_size=2, shuffle=True, num_workers=workers)
    seen = []
    for batch in loader:
        count = len(batch["name"])
        assert batch["image"].shape == (count, 3, 6, 8)
        assert batch["extrinsics"].shape == (count, 4, 4)
        assert batch["intrinsics"].shape == (count, 3, 3)
        assert torch.equal(batch["image"], given.images[batch["index"]])
        seen += batch["index"].tolist()
    assert sorted(seen) == [0, 1, 2, 3, 4]


WRITERS = pytest.mark.parametrize("write", [write_llff, write_colmap, write_blender, write_nerfstudio])


@WRITERS
@pytest.mark.parametrize("downscale", [None, 1.5])
def test_cameras_without_decoding_photos(tmp_path, monkeypatch, write, downscale):
    write(tmp_path)
    whole = load_scene(tmp_path, downscale=downscale)
    monkeypatch.setattr("kgs.datasets.image_file._decode", None)  # any decoding fails
    bare = load_scene(tmp_path, downscale=downscale, photos=False)
    for full, part in ((whole.train, bare.train), (whole.test, bare.test)):
        assert part.names == full.names
        for name in ("intrinsics", "extrinsics", "height", "width"):
            assert torch.equal(getattr(part.cameras, name), getattr(full.cameras, name))
        assert part.images.shape == full.images.shape
        assert part.images.is_meta
        assert part[0]["name"] == full.names[0]
        last = part.select([len(part) - 1])
        assert last.names == full.names[-1:]
        assert torch.equal(last.cameras.extrinsics, full.cameras.extrinsics[-1:])
    assert torch.equal(bare.offset, whole.offset)
    assert bare.train_full_size is None

"""Views: a data set of dicts; halved pictures keep showing the same rays; cameras without photos; float32."""

import numpy as np
import pytest
import torch
from factories import other_defaults
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


def test_comparing_does_not_raise():
    scene, again = (synthetic_scene(train_views=1, test_views=1, size=(6, 8)) for _ in range(2))
    assert scene == scene  # what is tested
    assert scene != again
    assert scene.train != again.train
    assert len({scene, again, scene}) == 2


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


@pytest.mark.parametrize(
    ("index", "rows"),
    [
        *[(one, [1]) for one in (1, -1, np.int64(1), np.uint8(1), torch.tensor(1), [np.int32(1)], (1,))],
        *[(several, [1, 0]) for several in ([1, 0], np.array([1, 0]), torch.tensor([1, 0]))],
    ],
)
def test_cameras_by_any_kind_of_integers(index, rows):
    given = views(6, 8)
    given.cameras.extrinsics[1, 0, 3] = 7.0
    chosen = given.camera(index)
    assert torch.equal(chosen.extrinsics, given.cameras.extrinsics[rows])
    assert chosen.batch_size == len(rows)


@pytest.mark.parametrize(
    ("index", "error"),
    [(other, TypeError) for other in (0.0, np.float32(1), [0.5], True, torch.tensor([True, False]))]
    + [(outside, IndexError) for outside in (2, -3, [0, 5])],
)
def test_cameras_by_other_things_and_those_that_are_not_there(index, error):
    with pytest.raises(error, match="index"):
        views(6, 8).camera(index)


WRITERS = pytest.mark.parametrize("write", [write_llff, write_colmap, write_blender, write_nerfstudio])


@WRITERS
def test_scenes_are_float32_on_the_cpu_whatever_the_defaults(tmp_path, write):
    write(tmp_path)
    with other_defaults():
        check_float32(load_scene(tmp_path, downscale=2))


def test_synthetic_scenes_are_float32_on_the_cpu_whatever_the_defaults():
    with other_defaults():
        check_float32(synthetic_scene(train_views=1, test_views=1, size=(6, 8)))


def check_float32(scene):
    for part in (
        scene.train,
        scene.test,
        scene.train.downsample(2),
        *([scene.train_full_size] if scene.train_full_size else []),
    ):
        tensors = [part.images, part.cameras.intrinsics, part.cameras.extrinsics, part.cameras.fx]
        tensors += [] if part.alphas is None else [part.alphas]
        assert part.cameras.height.device.type == part.camera([0]).width.device.type == "cpu"
        assert {(tensor.dtype, tensor.device.type) for tensor in tensors} == {(torch.float32, "cpu")}
        assert part.select([0]).images.device.type == "cpu"
    assert {t.dtype for t in (scene.points, scene.point_colors, scene.background)} == {torch.float32}
    assert scene.offset.dtype == torch.float64
    assert scene.points.device.type == scene.offset.device.type == "cpu"


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

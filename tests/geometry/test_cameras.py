"""Functions of cameras: their conventions by OpenCV, COLMAP and Kornia, and what they refuse."""

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from factories import batch, pinhole, random_camera

import kgs
from kgs import ArgumentError
from kgs.cameras import joined, pinhole_cameras, posed, project, resized, select, to, turned
from kgs.geometry.cameras import image_size
from kgs.geometry.multiview import inside_images, relative_projection, unproject

HEIGHT, WIDTH = 30, 40
PARTS = ("intrinsics", "extrinsics", "height", "width")


def three(dtype=torch.float64):
    """Cameras of one size whose intrinsics have a skew."""
    cameras = batch(*(random_camera(HEIGHT, WIDTH, seed, dtype) for seed in range(3)))
    cameras.intrinsics[:, 0, 1] = 0.7
    return cameras


def points(count=40):
    """In front of all of the cameras."""
    values = torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return values * torch.tensor([2.0, 2.0, 3.0]) + torch.tensor([-1.0, -1.0, 2.0])


def same(first, second):
    return all(torch.equal(getattr(first, name), getattr(second, name)) for name in PARTS)


# -- conventions ---------------------------------------------------------------------------------------------------


def test_convention_project_is_opencvs_and_kornias():
    cameras = three()
    pixels, depths = project(cameras, points())
    torch.testing.assert_close(pixels, cameras.project(points()[None].expand(3, -1, -1)).transpose(0, 1))
    for i, (k, pose) in enumerate(zip(cameras.intrinsics, cameras.extrinsics, strict=True)):
        local = points().numpy() @ pose[:3, :3].numpy().T + pose[:3, 3].numpy()
        zeros = np.zeros(3)
        without_skew = k[:3, :3].numpy().copy()
        without_skew[0, 1] = 0.0  # which OpenCV ignores
        expected = cv2.projectPoints(local, zeros, zeros, without_skew, None)[0][:, 0]
        expected[:, 0] += 0.7 * local[:, 1] / local[:, 2]
        np.testing.assert_allclose(pixels[:, i].numpy(), expected, atol=1e-9)
        np.testing.assert_allclose(depths[:, i].numpy(), local[:, 2], atol=1e-12)


@pytest.mark.parametrize("size", [(15, 20), (60, 80), (10, 40)])
def test_convention_resized_is_opencvs_resize_and_colmaps_rescale(size):
    height, width = size
    cameras = three()
    scaled = resized(cameras, (width / WIDTH, height / HEIGHT), size)
    assert image_size(scaled) == size
    before, after = project(cameras, points())[0], project(scaled, points())[0]
    for axis, (old, new) in enumerate(((WIDTH, width), (HEIGHT, height))):
        ramp = np.arange(old, dtype=np.float64)[None].repeat(2, 0)  # the value of a pixel is where it was
        where = cv2.resize(ramp, (new, 2), interpolation=cv2.INTER_AREA if new <= old else cv2.INTER_LINEAR)[0]
        inner = (after[..., axis] > 1) & (after[..., axis] < new - 2)
        found = np.interp(after[..., axis][inner].numpy(), np.arange(new), where)
        np.testing.assert_allclose(found, before[..., axis][inner].numpy(), atol=1e-9)
    k = cameras.intrinsics[0]
    params = [k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5]  # COLMAP's first pixel has its centre at (0.5, 0.5)
    camera = pycolmap.Camera(model="PINHOLE", width=WIDTH, height=HEIGHT, params=[float(x) for x in params])
    camera.rescale(width, height)
    k = scaled.intrinsics[0]
    np.testing.assert_allclose([k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5], camera.params, atol=1e-9)


@pytest.mark.parametrize("quarters", [-1, 0, 1, 2, 3, 4])
def test_convention_turned_is_opencvs_rotate(quarters):
    """A pixel is where OpenCV puts it, and the camera still has its centre and looks where it looked."""
    cameras = three()
    after = turned(cameras, quarters)
    image = np.arange(HEIGHT * WIDTH, dtype=np.int32).reshape(HEIGHT, WIDTH)
    for _ in range(quarters % 4):
        image = cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE)
    assert image_size(after) == image.shape
    at = project(cameras, points())[0]
    x, y = at[:, 0].T.round()
    inside = (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)
    rows, columns = np.unravel_index([int(np.flatnonzero(image == v)[0]) for v in (y * WIDTH + x)[inside]], image.shape)
    moved = project(after, points())[0][inside, 0].round()
    assert np.array_equal(moved.numpy(), np.stack([columns, rows], 1))
    axes_and_centres = [torch.linalg.inv(each.extrinsics)[:, :3, 2:] for each in (after, cameras)]
    torch.testing.assert_close(*axes_and_centres)
    assert same(turned(after, -quarters), cameras)


def test_convention_half_pixel_centres_are_colmaps():
    k = torch.tensor([[50.0, 0.0, 20.5], [0.0, 55.0, 15.25], [0.0, 0.0, 1.0]], dtype=torch.float64)
    cameras = pinhole_cameras(torch.eye(4).double(), k, WIDTH, HEIGHT, pixel_centers="half")
    camera = pycolmap.Camera(model="PINHOLE", width=WIDTH, height=HEIGHT, params=[50.0, 55.0, 20.5, 15.25])
    expected = camera.img_from_cam(points().numpy()) - 0.5
    np.testing.assert_allclose(project(cameras, points())[0][:, 0].numpy(), expected, atol=1e-9)


# -- closed forms --------------------------------------------------------------------------------------------------


def test_points_project_to_pixels_and_back():
    cameras = three()
    pixels, depths = project(cameras, points())
    of_float32 = project(to(cameras, dtype=torch.float32), points().float())
    assert all(values.dtype == torch.float64 for values in of_float32)
    torch.testing.assert_close(of_float32[0], pixels, rtol=0, atol=1e-4)
    for view in range(3):
        back = unproject(cameras, pixels[:, view], depths[:, view], torch.full((40,), view))
        torch.testing.assert_close(back, points())
        turn, shift = relative_projection(cameras, 0, view)
        rays = torch.cat([pixels[:, 0], torch.ones(40, 1)], 1) * depths[:, :1]
        there = rays @ turn.mT + shift
        torch.testing.assert_close(there[:, :2] / there[:, 2:], pixels[:, view], rtol=0, atol=1e-9)
        torch.testing.assert_close(there[:, 2], depths[:, view])
    expected = (pixels > -0.5).all(-1) & (pixels[..., 0] < WIDTH - 0.5) & (pixels[..., 1] < HEIGHT - 0.5)
    assert torch.equal(inside_images(cameras, pixels, depths), expected)
    assert 0 < int(expected.sum()) < expected.numel()


def test_a_cut_begins_at_its_corner():
    cut = resized(three(), 2.0, (20, 30), corner=(7.0, 3.5))
    whole = project(resized(three(), 2.0, (60, 80)), points())[0]
    torch.testing.assert_close(project(cut, points())[0], whole - torch.tensor([7.0, 3.5]))
    assert image_size(cut) == (20, 30)


@pytest.mark.parametrize(
    "index",
    [
        *(1, -1, np.int64(1), np.uint8(1), torch.tensor(1), [np.int32(1)], (0,), slice(1, None)),
        *([2, 0], np.array([2, 0]), torch.tensor([2, 0]), []),
    ],
)
def test_selected_cameras_are_those_of_the_tensors(index):
    cameras = batch(pinhole(3, 4, 5.0), pinhole(6, 7, 8.0), pinhole(9, 10, 11.0))
    rows = torch.arange(3)[index if isinstance(index, slice) else torch.as_tensor(index, dtype=torch.int64)].reshape(-1)
    found = select(cameras, index)
    assert [int(side) for side in found.height] == [3 * int(row) + 3 for row in rows]
    assert torch.equal(found.intrinsics, cameras.intrinsics[rows])
    assert same(joined(*(select(found, i) for i in range(len(rows)))), found) if len(rows) else True


@pytest.mark.parametrize(
    ("index", "error"),
    [(other, TypeError) for other in (1.0, np.float32(1), [0.5], True, [True, False], torch.tensor([True]), "one")]
    + [(outside, IndexError) for outside in (3, -4, [0, -4])],
)
def test_cameras_that_do_not_exist_cannot_be_selected(index, error):
    with pytest.raises(error):
        select(three(), index)


def test_cameras_change_their_dtype_device_and_poses_and_keep_their_size():
    cameras = three()
    single = to(cameras, dtype=torch.float32)
    assert single.intrinsics.dtype == single.extrinsics.dtype == torch.float32
    assert image_size(single) == (HEIGHT, WIDTH)
    assert all(getattr(to(cameras, "meta"), name).is_meta for name in PARTS)
    assert same(to(cameras), cameras)
    moved = posed(cameras, torch.eye(4).double().expand(3, 4, 4))
    assert same(posed(moved, cameras.extrinsics), cameras)
    assert torch.equal(moved.intrinsics, cameras.intrinsics)


def test_gradients_reach_the_tensors_that_cameras_were_made_of():
    k = pinhole(HEIGHT, WIDTH, 50.0).intrinsics.clone().requires_grad_()
    pose = torch.eye(4).double()[None].requires_grad_()
    cameras = turned(resized(select(pinhole_cameras(pose, k, WIDTH, HEIGHT), [0, 0]), 0.5, (15, 20)))
    pixels, depths = project(cameras, points())
    for gradient in torch.autograd.grad(pixels.sum() + depths.sum(), (k, pose)):
        assert gradient.abs().sum() > 0


# -- no cameras ----------------------------------------------------------------------------------------------------


def test_no_cameras_can_be_made_and_not_rendered(each_backend):
    none = pinhole_cameras(torch.eye(4)[None][:0], torch.eye(3)[None][:0], WIDTH, HEIGHT)
    assert none.batch_size == 0
    renderer = kgs.GaussianRenderer(backend=each_backend)
    cloud = kgs.Gaussians(torch.ones(1, 3), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1), torch.ones(1, 3))
    with pytest.raises(ArgumentError) as caught:
        renderer(cloud, none)
    assert (caught.value.name, caught.value.got) == ("cameras", "none")

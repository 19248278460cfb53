"""Tracks and points from them: blobs at known pixels, closed forms, OpenCV."""

import cv2
import numpy as np
import pytest
import torch
from init_point_scenes import HEIGHT, WIDTH, as_views, cameras, exact_tracks, focal_length, texture
from kornia.geometry.camera import PinholeCamera

from kgs.geometry.cameras import to
from kgs.init_points.tracks import Tracks, find_tracks
from kgs.init_points.triangulate import triangulate, triangulate_certain


def test_masks_leave_out_keypoints(planes):
    masks = torch.ones(3, 1, HEIGHT, WIDTH)
    masks[..., : WIDTH // 2] = 0
    tracks = find_tracks(as_views(planes.cameras, planes.images, masks))
    assert len(tracks.visible) > 30
    assert float(tracks.pixels[tracks.visible][:, 0].min()) > WIDTH // 2 - 1


def blobs(pixels, scales, size):
    """Gaussian blobs at known pixels as two cameras see them, the second moved along x by 8 pixels of disparity."""
    width, height = size
    ys, xs = np.mgrid[:height, :width]
    image = 0.1 + 0.3 * xs / width + 0.2 * ys / height  # the ramp gives the round blobs an orientation
    for (x, y), scale in zip(pixels, scales, strict=True):
        image += 0.3 * np.exp(-((xs - x) ** 2 + (ys - y) ** 2) / (2 * scale**2))
    images = torch.from_numpy(np.stack([image, np.roll(image, -8, axis=1)])).float()
    centers = np.array([[0.0, 0, 0], [8.0 / focal_length(width), 0, 0]])
    return as_views(cameras(centers, turn=0.0, size=size), images[:, None].repeat(1, 3, 1, 1))


@pytest.mark.parametrize("size", [(320, 240), (520, 400)], ids=["doubled", "as it is"])
def test_keypoints_have_integer_pixel_centres(size):
    pixels = np.array([[70.0, 60.0], [131.25, 77.5], [200.0, 101.0], [90.6, 150.3], [180.0, 170.0]])
    tracks = find_tracks(blobs(pixels, np.array([3.0, 4.0, 5.0, 3.5, 6.0]), size))
    for view, offset in ((0, 0.0), (1, 8.0)):
        distances = torch.cdist(tracks.pixels[:, view] + torch.tensor([offset, 0.0]), torch.from_numpy(pixels))
        assert float(distances.amin(0).max()) < 0.08


def test_a_pattern_repeated_along_the_epipolar_lines_is_not_matched():
    pattern = texture(3, (1.0, 1.0, 1.0), size=320)[:240]
    posed = cameras(np.array([[0.0, 0, 0], [8.0 / focal_length(320), 0, 0]]), turn=0.0, size=(320, 240))
    counts = []
    for image in (pattern, np.tile(pattern[:, :64], (1, 5, 1))):
        pair = np.stack([image, np.roll(image, -8, axis=1)])
        tracks = find_tracks(as_views(posed, torch.from_numpy(pair).float().permute(0, 3, 1, 2)))
        counts.append(len(tracks.visible))
    assert counts[0] > 100
    assert counts[1] < 0.05 * counts[0]


def test_convention_triangulation_is_opencvs():
    posed, rng = cameras(), np.random.default_rng(0)
    pixels = rng.uniform(50, 200, (40, 3, 2))
    pixels[:, 2] = pixels[:, 0] + rng.uniform(-30, -10, (40, 1)) * [1, 0]
    visible = torch.tensor([True, False, True]).expand(40, 3)
    # OpenCV's equations in the same normalised coordinates: two rays that do not meet have no other common answer.
    inverse = np.linalg.inv(posed.intrinsics[0, :3, :3].double().numpy())
    rays = np.concatenate([pixels, np.ones((40, 3, 1))], -1) @ inverse.T
    projections = posed.extrinsics[:, :3].double().numpy()
    expected = cv2.triangulatePoints(projections[0], projections[2], rays[:, 0, :2].T, rays[:, 2, :2].T)
    expected = (expected[:3] / expected[3]).T
    points = triangulate(Tracks(torch.from_numpy(pixels), visible), to(posed, "cpu", torch.float64)).numpy()
    np.testing.assert_allclose(points, expected, rtol=0.02, atol=0.02)


def test_exact_tracks_give_exact_points_also_of_a_moved_and_scaled_world():
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(1)) * 2 + torch.tensor([-1.0, -1.0, 3.0])
    posed, shift = cameras(), torch.tensor([3.0, -2.0, 5.0])
    extrinsics = posed.extrinsics.double()
    extrinsics[:, :3, 3] = 100 * (extrinsics[:, :3, 3] - extrinsics[:, :3, :3] @ shift.double())
    moved = PinholeCamera(posed.intrinsics.double(), extrinsics, posed.height, posed.width)
    tracks = exact_tracks(points)
    expected = triangulate_certain(tracks, to(posed, "cpu", torch.float64))
    torch.testing.assert_close(expected.points.float(), points, rtol=1e-4, atol=1e-4)
    certain = triangulate_certain(tracks, to(moved, "cpu", torch.float64))
    assert bool(certain.tracks.visible.all())
    torch.testing.assert_close(certain.points / 100 - shift, expected.points, rtol=1e-9, atol=1e-9)


def test_uncertain_points_go():
    # Fine; far away (0.1 degrees); fine but for one observation 3 px off; 40 px off; behind the cameras.
    points = torch.tensor([[0.0, 0, 4], [0.0, 0, 400], [0.2, 0.1, 4], [0.1, 0.2, 4], [0.0, 0.1, -4]])
    tracks = exact_tracks(points)
    tracks.pixels[2, 1, 1] += 3.0
    tracks.pixels[3, 1, 1] += 40.0
    certain = triangulate_certain(tracks, to(cameras(), "cpu", torch.float64))
    torch.testing.assert_close(certain.points.float(), points[[0, 2]], rtol=1e-4, atol=1e-4)
    assert certain.tracks.visible.tolist() == [[True, True, True], [True, False, True]]

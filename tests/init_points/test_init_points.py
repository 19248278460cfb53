"""Initial points: planes of known depth, closed forms, and the real scenes."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from init_point_scenes import (
    BACK,
    BACK_TINT,
    FRONT,
    FRONT_TINT,
    HEIGHT,
    SMALL,
    WIDTH,
    as_views,
    cameras,
    exact_tracks,
    flat,
)
from kernel_checks import check_bits
from kornia.geometry.camera import PinholeCamera
from refusals import refused

from kgs import ArgumentError
from kgs.geometry.multiview import typical_depths
from kgs.init_points import initial_points


@pytest.fixture(scope="module")
def sift_points(planes):
    return initial_points(planes, "sift")


def depth_errors(points):
    """Relative distances along z to the nearer of the two planes, and whether that is the front one."""
    x, _, z = points.double().unbind(1)
    to_back, to_front = ((z / (depth + slope * x) - 1).abs() for depth, slope in (BACK, FRONT))
    return torch.minimum(to_back, to_front), to_front < to_back


def test_sift_points_lie_on_the_planes_and_have_their_colours(sift_points):
    errors, front = depth_errors(sift_points.points)
    assert sift_points.kind == "sift"
    assert sift_points.points.dtype == torch.float32
    assert sift_points.points.shape == sift_points.colors.shape
    assert min(int(front.sum()), int((~front).sum())) > 50
    assert float(errors.median()) < 0.005
    assert float((errors < 0.03).double().mean()) > 0.97
    x, _, z = sift_points.points.double().unbind(1)
    for depth, slope in (BACK, FRONT):  # without a bias
        ratio = z / (depth + slope * x)
        assert abs(float(ratio[(ratio - 1).abs() < 0.03].median()) - 1) < 0.002
    for chosen, tint in ((front, FRONT_TINT), (~front, BACK_TINT)):
        shades = sift_points.colors[chosen] / sift_points.colors[chosen].sum(1, keepdim=True)
        expected = torch.tensor(tint) / sum(tint)
        assert float((shades - expected).abs().median()) < 0.005
    assert float(sift_points.colors.std(0).min()) > 0.05


def test_sift_points_have_the_same_bits_on_any_number_of_threads_and_for_any_seed(planes):
    count = cv2.getNumThreads()
    small = planes.downsample(2)

    def again():
        threads = torch.get_num_threads()
        cv2.setNumThreads(threads)
        result = initial_points(small, "sift", seed=threads)
        assert result.kind == "sift"
        return result.points, result.colors

    try:
        check_bits(again, (1, 3))
    finally:
        cv2.setNumThreads(count)


def test_few_matches_fall_back_to_random_points_with_a_warning():
    with pytest.warns(UserWarning, match=r"SIFT found 0 in 3 training views.*500 random points"):
        result = initial_points(flat(), "sift", count=500)
    assert result.kind == "random"
    assert result.points.shape == (500, 3)
    assert torch.allclose(result.colors, torch.tensor([0.2, 0.4, 0.6]).expand(500, 3), atol=1e-6)


def seeing_views(posed, points):
    """How many cameras see each point, by Kornia's own projection."""
    pixels = posed.project(points[None].expand(posed.batch_size, -1, -1))
    depths = (points @ posed.rotation_matrix.mT + posed.translation_vector.mT)[..., 2]
    limits = torch.stack([posed.width[0], posed.height[0]]) - 0.5
    return ((pixels > -0.5 - 1e-3) & (pixels < limits + 1e-3)).all(-1).logical_and(depths > 0).sum(0)


def test_random_points_lie_in_two_views_at_the_depths_of_sift_points(planes, sift_points):
    result = initial_points(planes, "random", count=2000)
    assert result.kind == "random"
    assert result.points.shape == result.colors.shape == (2000, 3)
    assert int(seeing_views(planes.cameras, result.points).min()) >= 2
    assert 0 <= float(result.colors.min()) <= float(result.colors.max()) <= 1
    depths = result.points[:, 2]
    sift = sift_points.points[:, 2]
    assert 0.7 * float(sift.min()) < float(depths.min()) < float(depths.max()) < 1.6 * float(sift.max())


def test_random_points_have_the_colours_of_what_counts():
    views = flat()
    counted = torch.ones(views.images[:, 0].shape, dtype=torch.bool)
    counted[..., : counted.shape[-1] // 2] = False
    shown = replace(views, images=views.images * counted[:, None], valid_mask=counted)
    colors = initial_points(shown, "random", count=500).colors
    black = (colors == 0).all(1)  # seen where no pixel counts
    assert 0.05 < float(black.float().mean()) < 0.6
    # a point may lie between pixels that count and others
    assert float((colors[~black] - torch.tensor([0.2, 0.4, 0.6])).abs().amax(1).median()) < 1e-6
    assert float(colors[~black].amin(0)[0]) > 0.1


def test_random_points_depend_on_the_seed_alone():
    views = flat()
    first, again, other = (initial_points(views, "random", seed=seed, count=300) for seed in (4, 4, 5))
    assert torch.equal(first.points, again.points)
    assert not torch.equal(first.points, other.points)


def test_random_points_fill_the_common_frustum_evenly():
    # Oracle: rejection from a box. Parallel cameras at x = 0, 1, 2, so the depths are 2 to 40 (1 and 20 baselines).
    posed = cameras(np.array([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]]), turn=0.0, size=SMALL)
    points = initial_points(flat(posed), "random", count=20_000).points
    assert 2.0 <= float(points[:, 2].min()) < 5.0
    assert 39.0 < float(points[:, 2].max()) <= 40.0
    box = (torch.rand(400_000, 3, generator=torch.Generator().manual_seed(0)) - 0.5) * torch.tensor([60.0, 40.0, 38.0])
    box += torch.tensor([0.0, 0.0, 21.0])
    box = box[seeing_views(posed, box) >= 2]
    near, all_three = points[:, 2] < 20, seeing_views(posed, points) == 3
    assert float(near.double().mean()) == pytest.approx(float((box[:, 2] < 20).double().mean()), abs=0.01)
    expected = float((seeing_views(posed, box) == 3).double().mean())
    assert float(all_three.double().mean()) == pytest.approx(expected, abs=0.01)


def test_random_points_surround_the_point_where_orbiting_cameras_look():
    extrinsics = torch.eye(4).repeat(6, 1, 1)
    for i in range(6):
        extrinsics[i, :3, :3] = torch.from_numpy(cv2.Rodrigues(np.array([0.0, i * np.pi / 3, 0.0]))[0])
    target = torch.tensor([10.0, -3.0, 7.0])
    extrinsics[:, :3, 3] = torch.tensor([0.0, 0.0, 4.0]) - extrinsics[:, :3, :3] @ target
    sizes = torch.full((6,), SMALL[1]), torch.full((6,), SMALL[0])
    posed = PinholeCamera(cameras(size=SMALL).intrinsics[:1].repeat(6, 1, 1), extrinsics, *sizes)
    points = initial_points(flat(posed), "random", count=2000).points
    assert float((points.mean(0) - target).norm()) < 0.5
    assert int(seeing_views(posed, points).min()) >= 2


@pytest.mark.parametrize("count", [1, 2])
def test_random_points_where_no_two_views_see_the_same(count):
    posed = cameras(np.zeros((count, 3)), turn=np.pi, size=SMALL)  # two cameras back to back
    points = initial_points(flat(posed), "random", count=100).points
    assert points.shape == (100, 3)
    assert int(seeing_views(posed, points).min()) == 1


@pytest.mark.parametrize(
    ("name", "kind", "arguments"),
    [
        ("kind", "stereo", {}),
        ("count", "random", {"count": 0}),
        ("file", "file", {}),
        ("draw", "dense", {"draw": "even"}),
    ],
)
def test_wrong_arguments(name, kind, arguments):
    with refused(ArgumentError, name=name):
        initial_points(flat(), kind, **arguments)


def test_typical_depths_are_the_first_percentile_and_the_median():
    views = flat(cameras(np.zeros((1, 3)), turn=0.0, size=SMALL))
    points = torch.zeros(101, 3)
    points[:, 2] = torch.arange(2.0, 103.0)
    assert typical_depths(points[torch.randperm(101)], views.cameras) == pytest.approx((3.0, 52.0), rel=1e-6)
    behind_and_beside = torch.tensor([[0.0, 0.0, -5.0], [50.0, 0.0, 0.001]]).repeat(50, 1)
    assert typical_depths(torch.cat([points, behind_and_beside]), views.cameras) == pytest.approx((3.0, 52.0), rel=1e-6)
    for none_before_a_camera in (torch.zeros(0, 3), torch.tensor([[0.0, 0.0, -1.0]])):
        assert typical_depths(none_before_a_camera, views.cameras) == (1.0, 1.0)


def test_a_point_without_neighbours_goes(monkeypatch):
    wall = torch.rand(80, 3, generator=torch.Generator().manual_seed(1)) * 2 + torch.tensor([-1.0, -1.0, 5.0])
    alone = torch.tensor([[0.2, 0.1, 3.2]])
    monkeypatch.setattr("kgs.init_points.depth_limits.find_tracks", lambda *_: exact_tracks(torch.cat([wall, alone])))
    result = initial_points(as_views(cameras(), torch.rand(3, 3, HEIGHT, WIDTH)), "sift")
    assert result.kind == "sift"
    torch.testing.assert_close(result.points, wall, rtol=1e-4, atol=1e-4)


REAL = [
    ("llff/fern", 3, 391),
    ("llff/flower", 6, 2394),
    ("colmap/trex", 9, 2109),
    ("nerfstudio/fox", 12, 1957),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "train_views", "expected"), REAL)
def test_real_scene_gives_enough_points(kgs_data, name, train_views, expected):
    from kgs.datasets import load_scene

    views = load_scene(kgs_data / name, train_views=train_views).train
    assert len(initial_points(views, "sift").points) >= 0.9 * expected


@pytest.mark.slow
@pytest.mark.parametrize(("name", "bound"), [("llff/fern", 0.02), ("llff/flower", 0.04), ("colmap/trex", 0.02)])
def test_real_points_agree_with_the_full_model(kgs_data, name, bound):
    # Median relative difference in depth to the nearest projected point, within 2 px, of the model from all views.
    from kgs.datasets import load_scene

    scene = load_scene(kgs_data / name, train_views=3, points="model-points")
    differences = []
    for i in range(3):
        pixels, depths = [], []
        for points in (initial_points(scene.train, "sift").points, scene.points):
            camera = scene.train.camera(i)
            local = points @ camera.rotation_matrix[0].T + camera.translation_vector[0, :, 0]
            pixels.append(camera.project(points[local[:, 2] > 0][None])[0])
            depths.append(local[local[:, 2] > 0, 2])
        distances, nearest = torch.cdist(*pixels).min(1)
        differences.append((depths[0] / depths[1][nearest] - 1).abs()[distances < 2])
    assert float(torch.cat(differences).median()) < bound

"""Depth maps and dense initial points, against the true depths of the synthetic scene and of a plane."""

import math
from dataclasses import replace

import pytest
import torch
from kornia.geometry.camera import PinholeCamera
from refusals import refused
from yard import yard_depths, yard_from_above, yard_scene

from kgs import ArgumentError
from kgs.datasets.scene import Views
from kgs.geometry.cameras import project, to
from kgs.geometry.multiview import nearest_pixels
from kgs.geometry.rigs import camera_centers
from kgs.init_points import dense, initial_points
from kgs.init_points.dense import PER_SKY, SKY, _one_per_cell, dense_points, small_enough
from kgs.init_points.depth_limits import MIN_SIFT, sweep_range
from kgs.init_points.plane_sweep import FARTHEST, _neighbours, plane_count, planes_wanted, sweep_depths
from kgs.init_points.sweep_costs import _semi_global
from kgs.init_points.tracks import Tracks
from kgs.init_points.triangulate import TrackedPoints


@pytest.fixture(scope="module")
def yard():
    return yard_from_above((72, 96))


@pytest.fixture(scope="module")
def views(yard):
    return yard[0]


@pytest.fixture(scope="module")
def large():
    """The yard in as many pixels as the bounds of depth errors are for."""
    return yard_from_above((96, 128))


def span_of(truth):
    return 0.8 * float(truth.min()), 1.25 * float(truth.max())


@pytest.fixture(scope="module")
def span(yard):
    return span_of(yard[1])


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.slow
def test_depths_of_the_synthetic_scene(large):
    views, truth = large
    for view, depth_map in enumerate(sweep_depths(views, *span_of(truth))):
        accepted = depth_map.is_inner & (depth_map.scores > 0.6)
        errors = (depth_map.depths / truth[view] - 1).abs()
        assert float(accepted.double().mean()) > 0.6
        assert float(errors[accepted].median()) < 0.01
        assert float((errors[accepted] < 0.02).double().mean()) > 0.7


@pytest.mark.slow
def test_points_lie_on_the_surfaces(large):
    views, truth = large
    points, colors, *_ = dense_points(views, *span_of(truth), 10**6, generator())  # all of them, 89 % of which are near
    assert points.shape == colors.shape == (len(points), 3)
    assert len(points) > 25_000
    assert points.dtype == colors.dtype == torch.float32
    pixels, depths = project(views.cameras, points)
    x, y = (pixels[..., 0].round().long().clamp(0, 127), pixels[..., 1].round().long().clamp(0, 95))
    errors = torch.stack([(depths[:, v] / truth[v][y[:, v], x[:, v]] - 1).abs() for v in range(3)]).amin(0)
    assert float(errors.median()) < 0.01
    assert float((errors < 0.03).double().mean()) > 0.885
    seen = torch.stack([views.images[v][:, y[:, v], x[:, v]].mT for v in range(3)])
    assert float((seen - colors).abs().amax(-1).amin(0).median()) == 0.0  # the colour of the pixel it comes from


def test_points_lie_where_the_masks_are(views, span):
    masks = torch.zeros(3, 1, 72, 96)
    masks[..., 15:55, 20:80] = 1.0
    points, *_ = dense_points(replace(views, alphas=masks), *span, 2000, generator())
    pixels, _ = project(views.cameras, points)
    x, y = pixels.round().long().unbind(-1)
    inside = (x >= 20) & (x < 80) & (y >= 15) & (y < 55)
    assert len(points) > 300
    assert bool((inside.sum(1) >= 2).all())


def test_planes_out_of_range(views):
    for near, far in ((0.0, 1.0), (2.0, 1.0), (1.0, math.inf), (math.nan, 1.0)):
        with refused(ArgumentError, name="near, far"):
            sweep_depths(views, near, far)


@pytest.mark.parametrize(("shown", "count"), [("one view", 200), ("grey", 200), ("mirrors", 2000)])
def test_where_photos_agree_nowhere_random_points_take_over(views, shown, count):
    given = {
        "one view": views.select([0]),
        "grey": replace(views, images=torch.full_like(views.images, 0.5)),
        "mirrors": replace(views, images=torch.rand(views.images.shape, generator=generator(3))),  # each another thing
    }[shown]
    with pytest.warns(UserWarning, match="points only; SIFT points"), pytest.warns(UserWarning, match="random points"):
        assert initial_points(given, "dense", count=count).kind == "random"


def test_neighbours_stand_neither_too_near_nor_too_far(views):
    """Cameras along a line, at 0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4 and 2 times the depth."""
    centers = torch.tensor([0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 2.0]) * 3.0
    n = len(centers)
    extrinsics = torch.eye(4).repeat(n, 1, 1)
    extrinsics[:, 0, 3] = -centers
    first = views.camera(0)
    camera = PinholeCamera(first.intrinsics.repeat(n, 1, 1), extrinsics, first.height.repeat(n), first.width.repeat(n))
    line = to(camera, "cpu", torch.float64)
    assert sorted(_neighbours(line, 0, 3.0)) == [3, 4, 5, 6]
    assert _neighbours(line, 7, 3.0)[0] == 6


def test_points_that_no_view_has_do_not_stretch_the_planes(views):
    cameras = to(views.cameras, "cpu", torch.float64)
    near_camera = torch.linalg.inv(cameras.extrinsics[0]) @ torch.tensor([0.5, 0.0, 0.05, 1.0]).double()
    scene = torch.rand(MIN_SIFT, 3, generator=generator(), dtype=torch.float64) + torch.tensor([-0.5, -0.5, 4.0])

    def swept(points):
        pixels, depths = project(cameras, points)
        everywhere = torch.ones(depths.shape, dtype=torch.bool)
        return sweep_range(TrackedPoints(points, pixels, depths, Tracks(pixels, everywhere)), cameras)

    assert swept(torch.cat([scene, near_camera[None, :3]])) == swept(scene)


def test_views_from_one_place_have_no_depth(views):
    camera = views.camera(0)
    both = [torch.cat([x, x]) for x in (camera.intrinsics, camera.extrinsics, camera.height, camera.width)]
    twice = Views(PinholeCamera(*both), views.images[[0, 0]], ("a.png", "b.png"))
    assert all(not depth_map.is_inner.any() for depth_map in sweep_depths(twice, 1.0, 10.0))


def test_smoothing_keeps_edges_and_repairs_holes():
    """Two flat halves with an edge in the image between them; a third of the pixels say nothing."""
    planes, height, width = 32, 24, 40
    truth = torch.full((height, width), 8)
    truth[:, width // 2 :] = 20
    grey = (truth == 20).float()
    cost = (torch.arange(planes)[:, None, None] - truth).abs().clamp(max=5).float() / 5
    silent = torch.rand(height, width, generator=generator()) < 0.33
    cost = torch.where(silent, 0.5, cost)
    result = _semi_global(cost, grey).argmin(0)
    assert float((result == truth).double().mean()) > 0.99
    assert float((torch.where(silent, 0.5, cost).argmin(0) == truth).double().mean()) < 0.75


@pytest.mark.parametrize("tilt", [0.0, 0.1])
def test_smoothing_is_the_same_in_all_directions(tilt):
    """Turned and mirrored input, turned and mirrored output."""
    cost = torch.rand(9, 12, 12, generator=generator(3)) + tilt * torch.arange(12)
    grey = torch.rand(12, 12, generator=generator(4))
    plain = _semi_global(cost, grey)
    for move in (lambda x: x.flip(-1), lambda x: x.flip(-2), lambda x: x.mT):
        assert torch.allclose(move(_semi_global(move(cost), move(grey))), plain, rtol=1e-5)


def test_depths_do_not_depend_on_the_unit(views, span):
    views = views.downsample(2)
    small = views.cameras.extrinsics.clone()
    small[:, :3, 3] *= 1e-3
    cameras = PinholeCamera(views.cameras.intrinsics, small, views.cameras.height, views.cameras.width)
    (plain, *_), (scaled, *_) = (
        sweep_depths(views, *span),
        sweep_depths(Views(cameras, views.images, views.names), 1e-3 * span[0], 1e-3 * span[1]),
    )
    same = (scaled.depths / (1e-3 * plain.depths) - 1).abs() < 1e-3
    assert float(same.double().mean()) > 0.99
    assert math.isfinite(float(scaled.scores.sum()))


# -- how many planes, and which points ------------------------------------------------------------------------------


def test_as_many_planes_are_wanted_as_a_picture_moves_by_pixels():
    """Side by side, a point of depth z is f b / z pixels apart."""
    intrinsics, extrinsics = torch.eye(4).repeat(2, 1, 1), torch.eye(4).repeat(2, 1, 1)
    intrinsics[:, 0, 0] = intrinsics[:, 1, 1] = 500.0
    extrinsics[1, 0, 3] = -0.3
    side = torch.full((2,), 64.0)
    views = Views(PinholeCamera(intrinsics, extrinsics, side, side), torch.rand(2, 3, 64, 64), ("a", "b"))
    assert planes_wanted(views, 2.0, 10.0) * 127 / 128 == pytest.approx(500 * 0.3 * (1 / 2 - 1 / 10), rel=1e-6)
    assert planes_wanted(views.select([0]), 2.0, 10.0) == 0.0


@pytest.mark.slow
def test_a_spread_draw_has_one_point_in_each_cell_and_takes_all_where_there_are_fewer(views, span):
    def drawn(count, draw, seed=0):
        return dense_points(views.downsample(2), *span, count, generator(seed), draw=draw)[0]

    for count in (50, 200):
        spread = drawn(count, "spread")
        assert 0.9 * count <= len(spread) <= count
        assert len(drawn(count, "uniform")) <= count
    assert torch.equal(spread, drawn(200, "spread"))
    assert not torch.equal(spread, drawn(200, "spread", seed=1))
    every = [drawn(10**6, draw).sort(0).values for draw in ("spread", "uniform")]
    assert torch.equal(*every)


def test_a_spread_draw_follows_the_area_not_the_density():
    """Nine tenths of the pixels crowd in a tenth of the width."""
    crowd = torch.rand(9000, 2, generator=generator()) * torch.tensor([10, 100])
    others = torch.rand(1000, 2, generator=generator(1)) * torch.tensor([90, 100]) + torch.tensor([10, 0])
    view_pixels = torch.cat([torch.zeros(10_000, 1), torch.cat([crowd, others])], 1).long()
    drawn = view_pixels[_one_per_cell(view_pixels.numpy(), 100)]
    assert 80 <= len(drawn) <= 100
    assert float((drawn[:, 1] < 10).double().mean()) < 0.25


@pytest.fixture(scope="module")
def before_a_sky():
    """Views with a sky, and the range of depths of what stands near."""
    return yard_scene(4, 0).train, (1.3, 6.0)


def test_points_of_the_sky_are_as_good_as_infinitely_far_away(before_a_sky):
    sky, (near, far) = before_a_sky
    points, *_ = dense_points(sky, near, far, 2000, generator(), draw="spread")
    pixels, depths = project(sky.cameras, points)
    assert float(depths.max()) < 1.5 * FARTHEST * far  # in another camera a depth may be larger
    truth = yard_depths(sky)
    shares = []
    for view in range(len(sky)):
        x, y, inside = nearest_pixels(pixels[:, view], depths[:, view], 96, 72)
        true = truth[view, y, x]
        distant = inside & (true > 100)
        shares.append(float(distant.double().mean()))
        # what the point moves by between these cameras is what the true surface moves by, within half a pixel or so
        baseline = (camera_centers(sky.cameras.extrinsics) - camera_centers(sky.camera(view).extrinsics)).norm(dim=1)
        shift = float(baseline.median()) * float(sky.cameras.fx[0]) * (1 / depths[distant, view] - 1 / true[distant])
        assert float(shift.abs().median()) < 0.5
    assert 0.1 < sum(shares) / len(shares) < 0.5
    assert 0.2 < float((depths.amin(1) > SKY * far).double().mean()) <= 1 / (1 + PER_SKY)


@pytest.mark.slow
def test_where_there_is_no_sky_no_point_is_far_away(views, span):
    small = views.downsample(2)
    for found in sweep_depths(small, *span):
        assert float(found.depths.max()) <= 1.001 * FARTHEST * span[1]
        assert float(found.depths.min()) > 0
    points, *_ = dense_points(small, *span, 2000, generator())
    assert float((project(views.cameras, points)[1] > 1.5 * span[1]).double().mean()) < 0.005


def test_views_are_halved_until_planes_lie_close_together(views, monkeypatch):
    width = views.images.shape[-1]
    shift = planes_wanted(views, 2.0, 10.0)
    monkeypatch.setattr(dense, "SMALLEST", 8)
    for bound, halvings in ((1.01, 0), (0.99, 1), (0.49, 2)):
        monkeypatch.setattr(dense, "MAX_SHIFT", bound * shift)
        assert small_enough(views, 2.0, 10.0).images.shape[-1] == width // 2**halvings
    monkeypatch.setattr(dense, "MAX_SHIFT", math.inf)
    samples = views.images[:, 0].numel() * plane_count(shift)
    for maximum, halvings in ((samples, 0), (samples - 1, 1)):
        monkeypatch.setattr(dense, "MAX_SAMPLES", maximum)
        assert small_enough(views, 2.0, 10.0).images.shape[-1] == width // 2**halvings
    monkeypatch.setattr(dense, "MAX_PIXELS", views.images[0, 0].numel() // 2)
    assert small_enough(views, 2.0, 10.0).images.shape[-1] == width // 2

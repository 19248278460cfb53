"""Depth maps of any scale and shift: aligned with the depths that photos agree on, they fill what is between these."""

from dataclasses import replace

import pytest
import torch

from kgs.datasets.scene import Views
from kgs.datasets.synthetic import synthetic_depths, synthetic_scene
from kgs.geometry.cameras import project
from kgs.init_points import InitialPoints, initial_points
from kgs.init_points.depth_maps import fitted


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize("scale", [0.02, 3000.0, -5.0])
def test_scale_and_shift_are_recovered_beside_outliers(inverse: bool, scale: float) -> None:
    depths = 1.0 + 4.0 * torch.rand(60, 80, generator=generator(), dtype=torch.float64)
    values = scale * ((1 / depths if inverse else depths) + 0.3)
    values[torch.rand(60, 80, generator=generator()) < 0.3] = scale * 1.9
    pixels = torch.rand(60, 80, generator=torch.Generator().manual_seed(1)) < 0.5
    found, error, of_constant = fitted(values, depths[pixels], pixels)
    right = values != scale * 1.9
    assert float((found / depths - 1)[right].abs().max()) < 1e-3
    assert error < 1e-3 < 0.1 < of_constant
    again, *_ = fitted(values, depths[pixels], pixels)
    assert torch.equal(again, found)


def test_values_of_few_levels_and_one_value_are_no_special_case() -> None:
    depths = torch.linspace(1.0, 3.0, 4800, dtype=torch.float64).reshape(60, 80)
    levels, error, of_constant = fitted((depths * 3).round(), depths.flatten(), depths > 0)
    assert error < 0.1 < of_constant
    assert float((levels / depths - 1).abs().max()) < 0.2
    _, error, of_constant = fitted(torch.full_like(depths, 7.0), depths.flatten(), depths > 0)
    assert error == pytest.approx(of_constant)


@pytest.fixture(scope="module")
def room() -> tuple[Views, torch.Tensor]:
    """Three views of the room, and their true depths `(3, H, W)`."""
    views = synthetic_scene(train_views=3, size=(105, 140)).train
    return views, synthetic_depths(views.cameras)[:, 0].float()


@pytest.fixture(scope="module")
def plain(room: tuple[Views, torch.Tensor]) -> InitialPoints:
    return initial_points(room[0], count=None)


def points_of(views: Views, depths: torch.Tensor, **options: object) -> InitialPoints:
    return initial_points(replace(views, depths=depths), **{"count": None, **options})  # type: ignore[arg-type]


def of_view(views: Views, points: InitialPoints, first: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """View, nearest pixel `(P, 2)` and depth of the points from the first one on, in the view that each is from."""
    assert points.views is not None
    view = points.views[first:]
    rows = torch.arange(len(view))
    pixels, depths = project(views.cameras, points.points[first:])
    return view, pixels[rows, view].round().long(), depths[rows, view]


@pytest.mark.parametrize("kind", ["depth", "inverse"])
def test_points_where_no_two_views_agree_are_right(
    room: tuple[Views, torch.Tensor], plain: InitialPoints, kind: str
) -> None:
    views, truth = room
    depths = 3 * truth - 2 if kind == "depth" else 40 / truth + 5
    depths[:, :20] = 0  # unknown
    points = points_of(views, depths)
    agreed = len(plain.points)
    assert torch.equal(points.points[:agreed], plain.points)  # the others come behind
    assert len(points.points) > 1.05 * agreed
    view, pixels, found = of_view(views, points, agreed)
    x, y = pixels.unbind(1)
    assert float((found / truth[view, y, x] - 1).abs().max()) < 0.02
    assert int(y.min()) >= 20
    assert torch.equal(points.colors[agreed:], views.images[view, :, y, x])
    own = {tuple(row) for row in torch.cat([view[:, None], pixels], 1).tolist()}
    agreed_view, agreed_pixels, _ = of_view(views, plain, 0)
    assert own.isdisjoint(map(tuple, torch.cat([agreed_view[:, None], agreed_pixels], 1).tolist()))
    assert any(f"{len(points.points) - agreed}, from the maps of 3 of 3 photos" in note for note in points.notes)
    for name in ("patches", "reserve"):
        former = vars(getattr(plain, name))
        assert all(torch.equal(value, former[part]) for part, value in vars(getattr(points, name)).items())


@pytest.mark.parametrize("draw", ["uniform", "spread"])
def test_a_count_is_that_of_all_points(room: tuple[Views, torch.Tensor], draw: str) -> None:
    views, truth = room
    points = points_of(views, truth, count=2000, draw=draw)
    assert 1500 < len(points.points) <= 2000
    more = int(points.notes[0].split(":")[1].split(",")[0])
    assert 50 < more < 1000


def test_pixels_that_a_mask_leaves_out_give_no_points(
    room: tuple[Views, torch.Tensor],
) -> None:
    views, truth = room
    valid = torch.ones_like(truth, dtype=torch.bool)
    valid[:, :, 100:] = False
    points = points_of(replace(views, valid_mask=valid), truth)
    assert points.notes
    _, pixels, _ = of_view(views, points, 0)
    assert int(pixels[:, 0].max()) < 100


def test_a_wrong_map_warns_and_changes_nothing(room: tuple[Views, torch.Tensor], plain: InitialPoints) -> None:
    views, truth = room
    noise = torch.rand(truth.shape, generator=generator()) + 0.1
    few = torch.where(noise > 1.095, truth, 0.0)
    with pytest.warns(UserWarning, match="left out: train_00 .*off.*train_01 .*off.*train_02 .*agree on"):
        points = points_of(views, torch.stack([noise[0], torch.full_like(noise[1], 0.5), few[2]]))
    assert torch.equal(points.points, plain.points)
    assert torch.equal(points.colors, plain.colors)
    assert not points.notes


def test_photos_without_a_map_are_passed_over(room: tuple[Views, torch.Tensor], plain: InitialPoints) -> None:
    views, truth = room
    points = points_of(views, truth * torch.tensor([0, 1, 0])[:, None, None])
    view, *_ = of_view(views, points, len(plain.points))
    assert view.unique().tolist() == [1]

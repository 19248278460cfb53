"""A fit in another unit: the same pictures from scaled cameras, and depths that are multiplied."""

import pytest
import torch
from factories import as_model, random_gaussians, random_views
from refusals import refused

from kgs import ArgumentError
from kgs.datasets import Scene
from kgs.fit.fit import Fit
from kgs.fit.scale import scaled, scaled_model
from kgs.geometry.rigs import camera_centers
from kgs.geometry.types import RasterOptions

FACTORS = (0.01, 3.7, 1000.0)


@pytest.fixture
def fit(tmp_path):
    """Gaussians with harmonics before cameras of a scene whose origin is far away, some before the near plane."""
    gaussians = random_gaussians(300, 0, torch.float32, sh_degree=2)
    model = as_model(gaussians)
    views = random_views(3, 30, 40)
    offset = torch.tensor([10.0, -20.0, 5.0], dtype=torch.float64)
    scene = Scene(
        views, views.select([0]), torch.rand(5, 3), torch.rand(5, 3), "none", offset, torch.rand(3), tmp_path, views
    )
    near_plane = float(gaussians.means[:, 2].quantile(0.1))
    return Fit(scene, model, RasterOptions(near_plane=near_plane), "torch")


@pytest.mark.parametrize("factor", FACTORS)
def test_scaled_cameras_see_the_same_of_a_scaled_splat(fit, factor):
    large = scaled(fit, factor)
    for part in ("train", "test"):
        views = getattr(fit.scene, part)
        for i in range(len(views)):
            camera = getattr(large.scene, part).camera(i)
            before = fit.render(views.camera(i))
            assert before.std() > 0.05
            torch.testing.assert_close(large.render(camera), before, atol=1e-4, rtol=1e-4)
            depth = fit.render_with_depth(views.camera(i))[1]
            wrong = (large.render_with_depth(camera)[1] - factor * depth).abs() > 1e-4 * factor * depth
            assert wrong.float().mean() <= 0.001  # of pixels where the transmittance is just about one half
            assert (depth > 0).float().mean() > 0.1


def test_points_of_the_files_are_multiplied_with_the_splat(fit):
    """Centres, Gaussians and initial points, in the coordinates that files have."""
    large = scaled(fit, 3.0)
    for before, after in (
        (fit.model.means, large.model.means),
        (fit.scene.points, large.scene.points),
        (camera_centers(fit.scene.train.cameras.extrinsics), camera_centers(large.scene.train.cameras.extrinsics)),
    ):
        torch.testing.assert_close(after + large.scene.offset, 3 * (before + fit.scene.offset), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(large.scene.train_full_size.cameras.extrinsics, large.scene.train.cameras.extrinsics)
    assert fit.options.near_plane * 3 == large.options.near_plane


def test_a_flat_disc_stays_flat_and_the_rest_as_it_is(fit):
    model = fit.model
    model.log_scales.data[0, 1] = -torch.inf
    model.antialiased = True
    model.sh_degree = 1
    large = scaled_model(model, 2.0)
    torch.testing.assert_close(large().scales, 2 * model().scales)
    assert large.log_scales[0, 1] == -torch.inf
    assert (large.antialiased, large.sh_degree, large.max_sh_degree) == (True, 1, 2)
    for name in ("quats", "opacity_logits", "sh_dc", "sh_rest"):
        assert torch.equal(getattr(large, name), getattr(model, name))


@pytest.mark.parametrize("factor", [0.0, -1.0, float("nan"), float("inf")])
def test_a_factor_is_a_number_above_0(fit, factor):
    for function, value in ((scaled, fit), (scaled_model, fit.model)):
        with refused(ArgumentError, name="factor"):
            function(value, factor)

"""The measures against numpy, in loops and closed forms of their own."""

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from factories import random_views
from refusals import refused
from tiny_scenes import narrow_lpips

from kgs._support.errors import DataError
from kgs.datasets.scene import Scene
from kgs.fit.measures import measure_again
from kgs.fit.view_renders import ViewRenders
from kgs.metrics.evaluate import BEST, clipped_psnr, evaluate, mean_psnr
from kgs.metrics.lpips import Lpips

KEYS = {"psnr", "ssim", "ssim_zero_padded", "lpips_vgg", "lpips_vgg_unscaled", "views"}


@pytest.fixture
def lpips():
    """A narrow network of random weights."""
    with narrow_lpips():
        return Lpips()


def scene_of(views):
    none = torch.zeros(0, 3)
    return Scene(views, views, none, none, "none", torch.zeros(3), torch.zeros(3), Path("scene"))


def renderer_of(images):
    """A `render` that looks its image up by the camera's position."""
    return lambda camera: images[int(camera.extrinsics[0, 0, 3])][None]


def distort(images, amount=0.1, seed=1):
    return images + amount * torch.randn(images.shape, generator=torch.Generator().manual_seed(seed))


def numpy_ssim(image, target, mode):
    """Mean SSIM of two (H, W) float64 images by explicit 11 x 11 windows."""
    offsets = np.arange(-5, 6)
    weights = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    weights /= weights.sum()

    def windowed(values):
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, 5, mode=mode), (11, 11))
        return np.einsum("hwij,ij->hw", windows, weights)

    x, y = windowed(image), windowed(target)
    xx, yy = windowed(image**2) - x**2, windowed(target**2) - y**2
    xy = windowed(image * target) - x * y
    c1, c2 = 0.01**2, 0.03**2
    return np.mean((2 * x * y + c1) * (2 * xy + c2) / ((x**2 + y**2 + c1) * (xx + yy + c2)))


def saved(render, scene, metrics):
    """A fit that was read from its folder, with these renders of both parts."""
    renders = [ViewRenders(views, lambda camera, gains: (render(camera), None)) for views in (scene.train, scene.test)]
    return SimpleNamespace(
        scene=scene, metrics=metrics, render=render, train_renders=renders[0], test_renders=renders[1]
    )


def test_measures_are_numpys_for_each_view_and_their_mean_on_top():
    views = random_views()
    renders = distort(views.images)
    result = evaluate(renderer_of(renders), views)
    assert set(result) == KEYS
    for row, name, render, photo in zip(result["views"], views.names, renders, views.images, strict=True):
        image, target = render.clamp(0, 1).double().numpy(), photo.double().numpy()
        assert row["name"] == name
        assert row["psnr"] == pytest.approx(-10 * math.log10(np.mean((image - target) ** 2)), abs=1e-4)
        for key, mode in (("ssim", "reflect"), ("ssim_zero_padded", "constant")):
            expected = np.mean([numpy_ssim(image[c], target[c], mode) for c in range(3)])
            assert row[key] == pytest.approx(expected, abs=1e-5)
    assert abs(result["ssim"] - result["ssim_zero_padded"]) > 1e-3
    for key in ("psnr", "ssim", "ssim_zero_padded"):
        assert result[key] == pytest.approx(np.mean([row[key] for row in result["views"]]), abs=1e-12)


def test_renders_are_clamped_before_they_are_measured_and_record_no_gradient():
    views = random_views(count=1)
    rendered = distort(views.images, amount=0.5)
    recorded = []

    def render(camera):
        recorded.append(torch.is_grad_enabled())
        return rendered

    assert evaluate(render, views) == evaluate(renderer_of(rendered.clamp(0, 1)), views)
    assert recorded == [False]


def test_the_worst_psnr_does_not_count_as_the_best():
    """A black render of a white photo has 0 dB, a render that equals its photo an infinite PSNR, None."""
    views = random_views()
    white = replace(views, images=torch.ones_like(views.images))
    assert clipped_psnr(mean_psnr(renderer_of(torch.zeros_like(white.images)), white)) == 0.0
    assert clipped_psnr(mean_psnr(renderer_of(white.images), white)) == BEST


def test_result_can_go_to_json_and_an_infinite_psnr_is_none():
    views = random_views()
    renders = torch.stack([views.images[0], distort(views.images)[1]])
    result = json.loads(json.dumps(evaluate(renderer_of(renders), views), allow_nan=False))
    assert result["psnr"] is None
    assert result["views"][0]["psnr"] is None
    assert result["views"][0]["ssim"] == pytest.approx(1.0, abs=1e-6)
    assert result["views"][1]["psnr"] > 15
    assert result["lpips_vgg"] is None
    assert result["views"][1]["lpips_vgg_unscaled"] is None


def test_no_views_give_no_numbers():
    empty = random_views(count=0)
    assert evaluate(renderer_of(empty.images), empty) == {**dict.fromkeys(KEYS), "views": []}


def test_lpips_is_measured_in_both_scalings(lpips):
    views = random_views(count=1)
    render = distort(views.images).clamp(0, 1)
    result = evaluate(renderer_of(render), views, lpips)
    assert result["lpips_vgg"] == pytest.approx(lpips(render, views.images).item())
    assert result["lpips_vgg_unscaled"] == pytest.approx(lpips(render, views.images, rescale=False).item())
    assert result["lpips_vgg"] != pytest.approx(result["lpips_vgg_unscaled"])


def test_lpips_that_is_not_measured_again_is_kept(lpips):
    views = random_views()
    render = renderer_of(distort(views.images).clamp(0, 1))
    measured = [evaluate(render, views, lpips, correct_color=correct_color) for correct_color in (False, True)]
    metrics = {"test": measured[0], "train": measured[0], "color_corrected": measured[1], "steps": 3}
    assert measure_again(saved(render, scene_of(views), metrics), Path("metrics.json")) == metrics
    wrong = {**metrics, "color_corrected": {"views": []}}
    with refused(DataError, key="color_corrected"):
        measure_again(saved(render, scene_of(views), wrong), Path("metrics.json"))


def test_masked_views_without_gains_are_recoloured_for_a_render_that_takes_a_camera_only():
    views = random_views()
    masked = replace(views, alphas=torch.full_like(views.images[:, :1], 0.5))
    render = renderer_of(distort(views.images))
    plain, recolored = (evaluate(render, masked, correct_color=correct_color) for correct_color in (False, True))
    assert recolored == evaluate(render, views, correct_color=True)
    metrics = {"test": plain, "train": plain, "color_corrected": recolored}
    assert measure_again(saved(render, scene_of(masked), metrics), Path("metrics.json")) == metrics


def test_float64_renders_are_measured():
    views = random_views(count=1)
    render = distort(views.images)
    result, double = evaluate(renderer_of(render), views), evaluate(renderer_of(render.double()), views)
    assert result["psnr"] == pytest.approx(double["psnr"], abs=1e-4)


def test_wrong_renders_are_named():
    views = random_views(count=1)
    with pytest.raises(ValueError, match=r"render: expected shape \(1, 3, 18, 23\) for 0.png"):
        evaluate(lambda camera: views.images[0], views)
    for bad in (math.nan, math.inf):
        broken = views.images.clone()
        broken[0, 1, 2, 3] = bad
        with pytest.raises(ValueError, match=r"render: expected finite values for 0.png"):
            evaluate(renderer_of(broken), views)

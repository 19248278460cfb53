"""What a cell of the study measures of a finished fit: co-adaptation, and Gaussians over the threshold."""

import math
from dataclasses import replace

import pytest
import torch

from kgs.datasets import synthetic_scene
from kgs.fit.config import FitConfig
from kgs.fit.plan import make_plan
from kgs.fit.trainer import Trainer
from kgs.geometry.harmonics import SH_C0
from kgs.init_points import initial_points
from kgs.model import GaussianModel
from kgs.renderer import GaussianRenderer
from kgs.study.overfitting import BINS, coadaptation, count_over_threshold

# -- the probe of co-adaptation ------------------------------------------------------------------------------------


def spots(colors, depths, side=12):
    """Separate opaque spots on a grid, at each pixel one Gaussian for each colour, at the given depths."""
    rows, columns = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    pixels = torch.stack([columns, rows], -1).reshape(-1, 2) * 8.0 + 4.0 - 48.0
    means = torch.cat([torch.cat([pixels / 100 * depth, torch.full((len(pixels), 1), depth)], 1) for depth in depths])
    n = len(means)
    model = GaussianModel(
        means=means,
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1),
        log_scales=torch.full((n, 3), math.log(0.03)),
        opacity_logits=torch.full((n,), 9.0),
        sh_dc=((torch.tensor(colors).repeat_interleave(len(pixels))[:, None, None].expand(n, 1, 3) - 0.5) / SH_C0),
        sh_rest=torch.zeros(n, 0, 3),
    )
    scene = synthetic_scene(train_views=1, test_views=0, size=(96, 96))
    cameras = scene.train.cameras
    cameras.intrinsics[:, 0, 0] = cameras.intrinsics[:, 1, 1] = 100.0
    cameras.intrinsics[:, :2, 2] = 47.5
    cameras.extrinsics[:] = torch.eye(4)
    return model, scene.train


def test_gaussians_that_repeat_each_other_are_not_coadapted():
    repeated, views = spots([0.6] * 12, [2.0 + 0.01 * k for k in range(12)])
    rivals, _ = spots([0.2, 1.0] * 6, [2.0 + 0.01 * k for k in range(12)])
    assert coadaptation(repeated, views) < 0.01 * coadaptation(rivals, views)


def test_the_variance_of_one_before_another():
    model, views = spots([1.0, 0.2], [2.0, 2.05])
    # at each pixel both are there, or one, or none, each in one of four halves; all pairs of these by hand
    half = len(model) // 2
    states = []
    for front, behind in ((1, 1), (1, 0), (0, 1), (0, 0)):
        gaussians = model()
        switch = torch.tensor([front, behind]).repeat_interleave(half)
        out = GaussianRenderer()(
            replace(gaussians, opacities=gaussians.opacities * switch), views.camera(0), outputs=("image", "alpha")
        )
        states.append((out.image[0].detach(), out.alpha[0, 0] > 0.8))
    pairs = [(a, b, seen & also) for a, seen in states for b, also in states]
    total = sum(float((0.5 * (a - b) ** 2).mean(0)[covered].sum()) for a, b, covered in pairs)
    expected = total / sum(int(covered.sum()) for _, _, covered in pairs)
    values = [coadaptation(model, views, subsets=2, seed=seed) for seed in range(40)]
    assert sum(values) / 40 == pytest.approx(expected, rel=0.07)  # 3 standard errors of 5760 draws
    assert 0.05 < expected < 0.8**2 * 2 / 9  # where spots are opaque the front one shows in two of three


def test_it_is_repeatable_and_says_when_nothing_is_covered():
    model, views = spots([1.0, 0.2], [2.0, 2.05])
    assert coadaptation(model, views, seed=3) == coadaptation(model, views, seed=3)
    single, views = spots([1.0], [2.0], side=1)
    assert coadaptation(single, views, subsets=8) is None


# -- Gaussians over the threshold ----------------------------------------------------------------------------------


def test_counts_by_distance():
    scene = synthetic_scene(train_views=2, test_views=0, size=(24, 32))
    points = initial_points(scene.train, "random", count=600)
    plan = make_plan(scene, FitConfig(steps=4, max_gaussians=600), points)
    trainer = Trainer(scene, plan, points)
    trainer.fit()
    counts = count_over_threshold(trainer, points.points)
    assert len(counts["distance"]) == BINS + 1
    assert counts["distance"] == sorted(counts["distance"])
    assert sum(counts["gaussians"]) == len(trainer.model)
    assert max(counts["gaussians"]) < 1.2 * min(counts["gaussians"])  # quantiles of where they began
    assert all(over <= count for over, count in zip(counts["over"], counts["gaussians"], strict=True))
    trainer.state.densifier.grad_threshold = 0.0
    assert count_over_threshold(trainer, points.points)["over"] == counts["gaussians"]
    trainer.state.densifier.grad_threshold = math.inf
    assert sum(count_over_threshold(trainer, points.points)["over"]) == 0

"""The counts of entries that projection hands to compositing: right, and used for the very tensors alone."""

import gc
from dataclasses import replace

import pytest
import torch
from projection_checks import wide_scene

from kgs import RasterOptions, composite, project
from kgs.backends.gpu import compositing, entry_counts

THRESHOLD = RasterOptions().alpha_threshold


def projected(cameras=1):
    return project(*wide_scene(1, 40, cameras), backend="triton")


def test_the_counts_are_those_of_compositing_and_spare_it_a_wait(monkeypatch):
    found = projected()
    known = entry_counts.find(found, THRESHOLD)
    assert len(known.counts) == len(found)
    assert known.entries == known.counts.sum() > 40
    waits, real = [], compositing.GpuCompositor._count
    monkeypatch.setattr(compositing.GpuCompositor, "_count", lambda *a: waits.append(real(*a)[1]) or real(*a))
    image = composite(found, found.colors, backend="triton").features
    assert not waits
    fresh = composite(replace(found, means2d=found.means2d.clone()), found.colors, backend="triton").features
    assert waits == [known.entries]
    assert torch.equal(image, fresh)
    sliced = RasterOptions(max_bytes=2**14)
    assert torch.equal(composite(found, found.colors, options=sliced, backend="triton").features, image)
    assert len(waits) > 2


@pytest.mark.parametrize(
    "change",
    [
        lambda x: replace(x, opacities=x.opacities * 1.0),
        lambda x: replace(x, factors=x.factors.clone()),
        lambda x: replace(x, eps2d=0.0),
        lambda x: replace(x, image_size=(50, 61)),
        lambda x: replace(x, num_cameras=2),
        lambda x: x.opacities.mul_(0.5) is None or x,
        lambda x: x.factors.detach().mul_(2.0) is None or x,
        lambda x: x.means2d[3].add_(1.0) is None or x,
    ],
)
def test_what_is_changed_is_counted_anew(change):
    found = projected()
    assert entry_counts.find(found, THRESHOLD) is not None
    assert entry_counts.find(found, 0.0) is None
    assert entry_counts.find(change(found), THRESHOLD) is None


def test_they_are_known_with_gradients_not_of_several_cameras_nor_in_inference_mode_and_forgotten():
    gaussians, cameras = wide_scene(1, 40)
    leaf = replace(gaussians, opacities=gaussians.opacities.clone().requires_grad_())
    found = project(leaf, cameras, backend="triton")
    assert entry_counts.find(found, THRESHOLD) is not None
    assert entry_counts.find(projected(2), THRESHOLD) is None
    with torch.inference_mode():
        assert entry_counts.find(projected(), THRESHOLD) is None
    before = len(entry_counts._known)
    del found
    gc.collect()
    assert len(entry_counts._known) < before

"""Photos that contradict each other are told by what a splat shows of them in large squares."""

from dataclasses import replace

import pytest
import torch

from kgs.datasets import synthetic_scene
from kgs.metrics.outlines import MIN_MEAN, MIN_PSNR, doubt, outline_levels

VIEWS = synthetic_scene(train_views=3, size=(48, 72)).train
DEPTHS = [torch.full((48, 72), 4.0)] * 3


def levels(change=None, depths=DEPTHS):
    """Of renders that show the photos exactly, but for a change of the last photo."""
    images = VIEWS.images.clone()
    if change is not None:
        images[2] = change(images[2])
    return outline_levels(replace(VIEWS, images=images), VIEWS.images[:, None], depths)


def moved(photo):
    """A photo in which something large lies elsewhere."""
    return torch.cat([photo[:, :, :36].flip(2) * 0.5, photo[:, :, 36:]], 2)


def noisy(photo):
    return (photo + 0.1 * torch.randn(photo.shape, generator=torch.Generator().manual_seed(0))).clamp(0, 1)


def test_what_is_shown_exactly_or_in_outline_is_not_in_doubt():
    assert [*levels()] == list(VIEWS.names)
    assert min(levels().values()) == 100
    fine = levels(noisy)
    assert MIN_PSNR < fine[VIEWS.names[2]] < 40
    assert doubt(levels()) == doubt(fine) == doubt({}) == ""


def test_a_photo_with_something_moved_is_named():
    found = levels(moved)
    assert found[VIEWS.names[2]] < MIN_PSNR < MIN_MEAN < found[VIEWS.names[0]]
    assert VIEWS.names[2] in doubt(found)
    assert VIEWS.names[0] not in doubt(found)


def test_photos_that_contradict_each_other_are_said_to():
    assert "contradict" in doubt({"a": 31.0, "b": 25.0, "c": 33.0})
    assert "b." in doubt({"a": 31.0, "b": 25.0, "c": 33.0})
    assert "contradict" not in doubt({"a": 45.0, "b": 25.0, "c": 45.0})


@pytest.mark.parametrize("depth", [0.0, -1.0])
def test_a_surface_that_no_other_view_shows_does_not_count(depth):
    assert levels(moved, [torch.full((48, 72), depth)] * 3) == {}

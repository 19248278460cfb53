"""The dark border that undistortion leaves around photos: found where there is one, and nowhere else."""

import math
from dataclasses import replace

import pytest
import torch
from init_point_scenes import as_views
from refusals import refused

from kgs import ArgumentError
from kgs.datasets import load_scene, synthetic_scene
from kgs.datasets.border import find_border_mask
from kgs.fit.targets import targets
from kgs.losses import photometric_loss
from kgs.metrics.evaluate import evaluate


@pytest.fixture(scope="module")
def scene():
    return synthetic_scene(train_views=3, test_views=1, size=(144, 192))


def behind(left=1.0, top=2.0, right=0.5, bottom=0.0):
    """What borders of these widths, in pixels with a fraction, let through."""
    rows, columns = torch.arange(1.0, 145.0)[:, None], torch.arange(1.0, 193.0)
    sides = columns - left, columns.flip(0) - right, rows - top, rows.flip(0) - bottom
    return math.prod(side.clamp(0, 1) for side in sides)


def test_a_border_of_changing_thickness_is_followed(scene):
    thickness = torch.linspace(2.0, 0.6, 192)  # of the upper side, as distortion leaves it
    light = (torch.arange(1, 145)[:, None] - thickness).clamp(0, 1)
    found = find_border_mask(scene.train.images * light)
    torch.testing.assert_close(found, light, atol=0.4, rtol=0)
    assert float((found - light).abs()[light < 1].mean()) < 0.1


def test_the_scene_is_not_taken_for_a_border(scene):
    photos = scene.train.images.clone()
    assert find_border_mask(photos) is None
    assert find_border_mask(photos * behind(left=0, top=8.0, right=0)) is None  # too wide
    assert find_border_mask(torch.rand(2, 3, 5, 5)) is None  # too small
    assert find_border_mask(photos * behind() * 0.02) is None  # too dark to tell
    photos[0, :, :2] = 0.0  # in one photo alone
    assert find_border_mask(photos) is None
    assert find_border_mask(scene.train.images[:1] * behind()) is None  # one photo tells nothing
    assert find_border_mask(torch.zeros(3, 3, 144, 192)) is None


def with_border(scene, light, known=True):
    def put(views):
        return replace(views, images=views.images * light, border_mask=light if known else None)

    return replace(scene, train=put(scene.train), test=put(scene.test))


def test_a_render_is_measured_behind_the_border(scene):
    light = behind()
    views = with_border(scene, light).test
    photos = iter(scene.test.images)
    assert evaluate(lambda _: next(photos)[None], views)["psnr"] is None  # infinite
    photos = iter(scene.test.images)
    assert evaluate(lambda _: next(photos)[None], replace(views, border_mask=None))["psnr"] < 30


def test_a_border_has_no_part_in_a_fit(scene):
    light = behind(left=2.0, top=2.0, right=0.0)
    target = targets(with_border(scene, light).train, torch.zeros(3), torch.device("cpu"))[0]
    render = torch.full_like(target.image, 0.5).requires_grad_()
    photometric_loss(target.as_photographed(render), target.image, 0.2, moments=target.moments).backward()
    assert bool((render.grad[0, :, light == 0] == 0).all())
    assert bool((render.grad[0, :, light == 1] != 0).any())


def test_a_render_is_compared_as_the_photo_shows_it(scene):
    """In [0, 1] and behind the border; what lies in the border is black whatever the render has there."""
    plain, light = scene.train, behind(left=1.0, top=0.0, right=0.0)
    render = torch.tensor([-0.5, 0.25, 1.5])[:, None, None].expand(3, 144, 192)
    shown = replace(plain, border_mask=light).as_photo(0, render)
    assert bool((shown[:, :, 0] == 0).all())
    assert shown[:, 5, 5].tolist() == [0.0, 0.25, 1.0]
    assert plain.as_photo(0, render)[:, 0, 0].tolist() == [0.0, 0.25, 1.0]


def test_halving_and_choosing_keep_the_border(scene):
    light = behind(left=2.0, top=1.0, right=0.0)
    views = with_border(scene, light).train
    assert views.select([1]).border_mask is light
    halved = views.downsample(2).border_mask
    assert float(halved[20, 0]) == 0.0
    assert float(halved[0, 20]) == 0.5


def test_pixels_of_the_border_are_not_usable(scene):
    light = behind(left=1.0, top=0.0, right=0.0)
    masks = torch.ones(3, 1, 144, 192)
    masks[1, 0, 5, 5] = 0.2
    views = replace(as_views(scene.train.cameras, scene.train.images, masks), border_mask=light)
    assert not bool(views.usable[:, :, 0].any())
    assert views.usable[:, 5, 5].tolist() == [True, False, True]
    assert bool(views.usable[:, 6:, 6:].all())
    assert replace(views, alphas=None, border_mask=None).usable is None
    with refused(ArgumentError, name="border_mask"):
        replace(views, border_mask=light[1:])


def test_a_scene_is_loaded_with_its_border(kgs_data):
    loaded = load_scene(kgs_data / "nerfstudio" / "fox", 3, 2)
    assert loaded.train.border_mask is not None
    assert loaded.train_full_size is not None
    assert loaded.train_full_size.border_mask is not None
    assert torch.equal(loaded.test.border_mask, loaded.train.border_mask)
    assert 0.4 < float(loaded.train.border_mask[120, 0]) < 0.6  # half a pixel of black on the left
    assert bool((loaded.train.border_mask[3:-3, 3:-3] == 1).all())
    assert any("border" in note for note in loaded.notes)
    assert load_scene(kgs_data / "llff" / "fern", 3, 2).train.border_mask is None

"""Points where the error is: what is drawn, what it becomes, and when."""

import math
from dataclasses import replace

import pytest
import torch
from init_point_scenes import cameras, painted_planes
from refusals import refused
from trainers import assert_same_bits, begun, fitted, settled, stop_at

from kgs import ArgumentError
from kgs.datasets.scene import Views
from kgs.fit import FitConfig, Trainer
from kgs.fit.config import PRESETS, Recipe
from kgs.fit.error_points import ErrorPoints
from kgs.fit.plan import make_schedule
from kgs.geometry.cameras import project, select
from kgs.geometry.multiview import unproject
from kgs.init_points import initial_points
from kgs.init_points.dense import Reserve

CPU = torch.device("cpu")
DEPTH = 5.0
HEIGHT, WIDTH = 32, 40
# densified after 10, 20 and 30 steps of 50; no Gaussian is cloned, split or removed
CONFIG = FitConfig(steps=50, drop=0.0, seed=5, evaluations=1, sh_degree=1, max_gaussians=10_000)
CONFIG = replace(CONFIG, recipe=Recipe(error_points=0.1, grad_threshold=1e9, prune_opacity=0.0))


def reserve_of(views: Views, shape=(HEIGHT, WIDTH)) -> Reserve:
    """A point at depth 5 for each pixel of each view of this size, in a colour that names the pixel."""
    y, x = torch.meshgrid(torch.arange(shape[0]), torch.arange(shape[1]), indexing="ij")
    pixels = torch.stack([x.flatten(), y.flatten()], 1).repeat(len(views), 1)
    which = torch.arange(len(views)).repeat_interleave(shape[0] * shape[1])
    zoom = torch.tensor([WIDTH / shape[1], HEIGHT / shape[0]])
    points = unproject(views.cameras, (pixels + 0.5) * zoom - 0.5, torch.full((len(which),), DEPTH).double(), which)
    colors = torch.cat([pixels / 255, which[:, None] / 255], 1)
    return Reserve(points.float(), colors, which)


@pytest.fixture(scope="module")
def reserve(scene):
    return reserve_of(scene.train)


@pytest.fixture(scope="module")
def dense(points, reserve):
    """The initial points with a reserve."""
    return replace(points, reserve=reserve)


@pytest.fixture(scope="module")
def whole(scene, dense):
    """A fit of them that was not stopped."""
    return fitted(scene, dense, CONFIG)


@pytest.fixture(scope="module")
def plain(scene, points):
    """The same of points without a reserve."""
    return fitted(scene, points, CONFIG)


@pytest.fixture
def error_points(scene, reserve):
    return ErrorPoints.of(reserve, scene.train, 0, CPU)


def observe(points: ErrorPoints, view: int, error: torch.Tensor) -> None:
    """Let the render of a view be wrong by so much in each pixel `(H, W)`."""
    points.observe(view, error.expand(1, 3, -1, -1), torch.zeros(1, 3, *error.shape))


def pixels_of(model) -> list[tuple[int, int, int]]:
    """The x, y and view that the colours name."""
    colors = (255 * (model.sh_dc[:, 0] * 0.28209479177387814 + 0.5)).round().int()
    return [tuple(row) for row in colors.tolist()]


# -- the draw --------------------------------------------------------------------------------------------------------


def test_points_are_drawn_in_proportion_to_the_error(error_points):
    error = torch.zeros(HEIGHT, WIDTH)
    error[:, :20] = 0.1
    error[:, 20:] = 0.4
    observe(error_points, 1, error)
    drawn = pixels_of(error_points.draw(300, 0))
    assert {view for _, _, view in drawn} == {1}  # the others have shown no error yet
    right = sum(x >= 20 for x, _, _ in drawn)
    assert 205 < right < 265  # 0.8 of 300 at first, and a little less as they are used up: 235 with a deviation of 7


def test_nothing_is_drawn_twice_or_without_an_error(error_points):
    error = torch.zeros(HEIGHT, WIDTH)
    error[3:5, 7:12] = 0.5
    drawn = list[tuple[int, int, int]]()
    for count in (4, 4, 4, 4):
        observe(error_points, 2, error)
        drawn += pixels_of(error_points.draw(count, 0))
    assert sorted(drawn) == sorted((x, y, 2) for x in range(7, 12) for y in (3, 4))
    assert len(error_points.draw(-3, 0)) == 0  # more Gaussians than there may be


def test_the_last_error_of_a_view_counts(error_points):
    observe(error_points, 0, torch.ones(HEIGHT, WIDTH))
    error = torch.zeros(HEIGHT, WIDTH)
    error[10, 30] = 0.01
    observe(error_points, 0, error)
    assert pixels_of(error_points.draw(5, 0)) == [(30, 10, 0)]


def test_a_render_of_half_the_width_tells_of_four_pixels_each(error_points):
    error = torch.zeros(HEIGHT // 2, WIDTH // 2)
    error[6, 9] = 0.2
    observe(error_points, 0, error)
    assert set(pixels_of(error_points.draw(9, 0))) == {(18, 12, 0), (19, 12, 0), (18, 13, 0), (19, 13, 0)}


def test_a_sweep_of_other_pixels_finds_the_fits(scene):
    points = ErrorPoints.of(reserve_of(scene.train, (HEIGHT // 2, WIDTH // 2)), scene.train, 0, CPU)
    error = torch.zeros(HEIGHT, WIDTH)
    error[12:14, 18:20] = 0.2
    observe(points, 0, error)
    assert pixels_of(points.draw(9, 0)) == [(9, 6, 0)]


def test_errors_that_are_not_finite_are_not_drawn(error_points):
    error = torch.zeros(HEIGHT, WIDTH)
    error[0, :3] = torch.tensor([math.nan, math.inf, 1.0])
    observe(error_points, 0, error)
    assert pixels_of(error_points.draw(9, 0)) == [(2, 0, 0)]


# -- what is drawn ---------------------------------------------------------------------------------------------------


def test_a_new_gaussian_has_a_quarter_of_a_pixel_of_its_photo_at_its_depth(scene, error_points):
    for view in range(3):
        observe(error_points, view, torch.ones(HEIGHT, WIDTH))
    model = error_points.draw(200, 2)
    for (x, y, view), mean, scales in zip(pixels_of(model), model.means, model.log_scales.exp(), strict=True):
        camera = select(scene.train.cameras, [view])
        right = mean + scales[0] * camera.extrinsics[0, 0, :3]  # a standard deviation to the camera's right
        pixels, depths = project(camera, torch.stack([mean, right]).detach())
        torch.testing.assert_close(pixels[0, 0], torch.tensor([x, y]).double(), rtol=0, atol=1e-3)
        assert float(depths[0, 0]) == pytest.approx(DEPTH, rel=1e-5)
        assert float((pixels[1, 0] - pixels[0, 0]).norm()) == pytest.approx(0.25, rel=1e-3)
        assert torch.equal(scales, scales[:1].expand(3))
    torch.testing.assert_close(model.opacity_logits.sigmoid(), torch.full((200,), 0.1))
    assert torch.equal(model.quats, torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(200, 4))
    assert model.sh_rest.shape == (200, 8, 3)
    assert not model.sh_rest.any()


def test_colours_are_those_of_the_scene_without_the_gains_of_the_photo(scene, reserve):
    gains = torch.tensor([[0.5, 1.0, 2.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]])
    gray = replace(reserve, colors=torch.full_like(reserve.colors, 0.2))
    points = ErrorPoints.of(gray, replace(scene.train, gains=gains), 0, CPU)
    observe(points, 0, torch.ones(HEIGHT, WIDTH))
    colors = points.draw(1, 0).sh_dc[0, 0] * 0.28209479177387814 + 0.5
    torch.testing.assert_close(colors.detach(), torch.tensor([0.4, 0.2, 0.1]), rtol=0, atol=0.5 / 255 + 1e-6)


# -- in a fit --------------------------------------------------------------------------------------------------------


def counts(trainer: Trainer) -> list[int]:
    """The number of Gaussians after each step."""
    numbers = list[int]()
    trainer.fit(lambda trainer, _: numbers.append(len(trainer.model)))
    return numbers


def test_a_share_is_added_at_each_densification_in_the_first_part_of_a_fit(scene, dense):
    assert counts(begun(scene, dense, CONFIG)) == [150] * 9 + [165] * 10 + [181] * 10 + [199] * 21


def test_there_are_never_more_than_max_gaussians(scene, dense):
    assert counts(begun(scene, dense, CONFIG, max_gaussians=170)) == [150] * 9 + [165] * 10 + [170] * 31
    assert counts(begun(scene, dense, CONFIG, max_gaussians=100)) == [150] * 50


def test_old_gaussians_and_their_moments_stay_and_new_ones_have_none(scene, points, dense):
    trainers = begun(scene, dense, CONFIG), begun(scene, points, CONFIG)
    for trainer in trainers:
        trainer.fit(stop_at(10))
    added, without = (trainer.state for trainer in trainers)
    for name, parameter in added.model.per_gaussian().items():
        before = without.model.get_parameter(name)
        assert torch.equal(parameter[:150], before)
        for key, moment in added.optimizer.state[parameter].items():
            if isinstance(moment, torch.Tensor) and moment.shape == parameter.shape:
                assert torch.equal(moment[:150], without.optimizer.state[before][key])
                assert not moment[150:].any()


def test_errors_are_those_of_the_renders_of_the_fit(scene, dense):
    """Where one photo differs from the render all over, and the others nowhere, new points are of that photo."""
    rates = {f"lr_{name}": 0.0 for name in ("sh_dc", "sh_rest", "opacity", "scales", "quats")}
    recipe = replace(CONFIG.recipe, lr_means=1e-30, lr_means_final=1e-30, opacity_decay=1.0, alpha_threshold=1 / 255)
    still = replace(CONFIG, training_background="scene", recipe=replace(recipe, **rates))
    trainer = begun(scene, dense, still)
    images = torch.cat([trainer.result().render(scene.train.camera(i)) for i in range(3)]).detach()
    images[1] = 1.0
    trainer = begun(replace(scene, train=replace(scene.train, images=images)), dense, still)
    trainer.fit(stop_at(10))
    assert [view for _, _, view in pixels_of(trainer.model)[150:]] == [1] * 15


def test_points_without_a_reserve_and_the_papers_presets_add_none(scene, points, dense, plain):
    off = replace(CONFIG.recipe, error_points=0.0)
    for given in (points, dense):
        assert_same_bits(fitted(scene, given, CONFIG, recipe=off), plain)
    for preset in ("paper", "plain"):
        assert make_schedule(settled(PRESETS[preset])).error_points == ()


def test_the_same_seed_has_the_same_bits_and_another_one_other_points(scene, dense, whole):
    assert_same_bits(fitted(scene, dense, CONFIG), whole)
    points = [ErrorPoints.of(dense.reserve, scene.train, seed, CPU) for seed in (0, 1)]
    for one in points:
        observe(one, 0, torch.ones(HEIGHT, WIDTH))
    assert not torch.equal(*(one.draw(50, 0).means for one in points))


@pytest.mark.parametrize("step", [4, 10, 17, 30, 40])
def test_a_resumed_fit_has_the_bits_of_one_that_was_not_stopped(scene, dense, whole, tmp_path, step):
    path = tmp_path / "checkpoint.safetensors"
    stopped = begun(scene, dense, CONFIG)
    stopped.fit(stop_at(step))
    stopped.save(path)
    resumed = Trainer.resume(scene, CONFIG, path)
    assert (resumed.state.error_points is None) == (step >= 30)  # after the last draw nobody needs them
    resumed.fit()
    assert len(resumed.model) == 199
    assert_same_bits(resumed, whole)


def test_a_state_that_was_loaded_can_be_loaded_again(scene, dense, whole):
    trainer = begun(scene, dense, CONFIG)
    trainer.fit(stop_at(10))
    saved = trainer.state_dict()
    for _ in range(2):
        other = begun(scene, dense, CONFIG)
        other.load_state_dict(saved)
        other.fit()
        assert_same_bits(other, whole)


@pytest.mark.parametrize("name", ["colors", "views", "errors", "is_left"])
def test_a_saved_state_with_rows_missing_is_refused(scene, dense, name):
    saved = begun(scene, dense, CONFIG).state_dict()
    saved["error_points"][name] = saved["error_points"][name][:-1]
    with refused(ArgumentError, name=f"error_points/{name}"):
        begun(scene, dense, CONFIG).load_state_dict(saved)


# -- the reserve -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def planes():
    """Of a quarter of the pixels."""
    return painted_planes(cameras(size=(120, 90)))


def test_the_reserve_of_dense_points_is_what_was_agreed_on_and_not_drawn(planes):
    drawn = initial_points(planes, count=2000, draw="spread")
    more = initial_points(planes, count=10**6, draw="spread")
    assert drawn.reserve is not None
    assert len(drawn.points) + len(drawn.reserve.points) == len(more.points) + len(more.reserve.points)
    first = {tuple(row) for row in drawn.points.tolist()}
    assert not first & {tuple(row) for row in drawn.reserve.points.tolist()}
    pixels, depths = project(planes.cameras, drawn.reserve.points)
    rows = torch.arange(len(depths))
    x, y = pixels[rows, drawn.reserve.views].round().long().unbind(1)
    assert torch.equal(planes.images[drawn.reserve.views, :, y, x], drawn.reserve.colors)


@pytest.mark.parametrize("kind", ["sift", "random"])
def test_other_kinds_have_none(planes, kind):
    assert initial_points(planes, kind, count=1000).reserve is None

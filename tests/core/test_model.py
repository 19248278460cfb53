import copy
import io
import math

import pytest
import torch
from factories import pinhole
from factories import random_cloud as cloud
from factories import random_model as model
from refusals import refused
from torch import nn

from kgs import ArgumentError, GaussianRenderer
from kgs.model import GaussianModel


def test_activations_are_exp_and_sigmoid():
    made = model()
    with torch.no_grad():
        made.log_scales[0] = torch.tensor([0.0, math.log(2.0), -1.0])
        made.opacity_logits[0] = math.log(3.0)
    gaussians = made()
    assert gaussians.scales[0].tolist() == pytest.approx([1.0, 2.0, math.exp(-1.0)], rel=1e-6)
    assert gaussians.opacities[0].item() == pytest.approx(0.75, rel=1e-6)
    assert gaussians.means is made.means
    assert gaussians.quats is made.quats


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_only_the_active_bands_are_in_colors(degree):
    made = model()
    made.sh_degree = degree
    colors = made().colors
    size = (degree + 1) ** 2
    assert colors.shape == (7, size, 3)
    assert torch.equal(colors, torch.cat([made.sh_dc, made.sh_rest], dim=1)[:, :size])
    colors.sum().backward()
    if degree == 0:
        assert colors is made.sh_dc
        assert made.sh_rest.grad is None
    else:
        assert torch.equal(made.sh_rest.grad[:, : size - 1], torch.ones(7, size - 1, 3))
        assert not made.sh_rest.grad[:, size - 1 :].any()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_every_degree_has_six_parameters_and_starts_active(degree):
    made = model(sh_degree=degree)
    assert made.sh_degree == made.max_sh_degree == degree
    names = ["means", "quats", "log_scales", "opacity_logits", "sh_dc", "sh_rest"]
    assert [name for name, _ in made.named_parameters()] == names
    assert len(made) == 7
    assert model(0, degree), "true, also without Gaussians"


def test_first_values_follow_the_recipe():
    points, colors = cloud()
    made = GaussianModel.from_points(points, colors)
    gaussians = made()
    assert torch.equal(made.means, points)
    assert torch.allclose(0.28209479177387814 * made.sh_dc[:, 0] + 0.5, colors, atol=1e-7)
    assert not made.sh_rest.any()
    assert torch.equal(made.quats, torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(200, 4))
    assert torch.allclose(gaussians.opacities, torch.full((200,), 0.1))


def test_a_state_dict_rebuilds_a_model_of_any_size():
    made = model(9, 2)
    made.sh_degree = 1
    for again, degree in (
        (GaussianModel(**made.state_dict()), 1),
        (GaussianModel(**made.state_dict(), sh_degree=0), 0),
    ):
        assert again.sh_degree == degree
        assert all(torch.equal(a, b) for a, b in zip(made.parameters(), again.parameters(), strict=True))
        with torch.no_grad():
            again.means.zero_()
        assert bool(made.means.any())


@pytest.mark.parametrize("assign", [False, True])
@pytest.mark.parametrize("n", [0, 5, 9])
def test_load_state_dict_takes_over_size_and_degrees(n, assign):
    made, other = model(9, 3), model(5, 1)
    GaussianModel.load_state_dict(other, {**model(max(n, 4), 0).state_dict()})
    made.sh_degree = 2
    held = dict(other.named_parameters())
    buffer = io.BytesIO()
    torch.save(nn.Sequential(made).state_dict(), buffer)
    buffer.seek(0)
    nn.Sequential(other).load_state_dict(torch.load(buffer, weights_only=True), assign=assign)
    assert (len(other), other.sh_degree, other.max_sh_degree) == (9, 2, 3)
    for name, parameter in other.named_parameters():
        assert torch.equal(parameter, made.get_parameter(name))
        assert assign or parameter is held[name], "an optimiser would hold the old one"
    other().colors.sum().backward()


def test_the_six_parameters_alone_are_a_state_of_the_full_degree():
    state = model(9, 2).state_dict()
    del state["_extra_state"]
    other = model(5, 0)
    other.load_state_dict(state)
    assert (len(other), other.sh_degree) == (9, 2)


def test_a_state_that_does_not_fit_together_is_refused_and_changes_nothing():
    made, other = model(9), model(5)
    before = {name: value.clone() for name, value in other.state_dict().items()}
    changes = {"quats": torch.zeros(8, 4), "sh_rest": torch.zeros(9, 5, 3), "_extra_state": torch.tensor(4)}
    for name, change in changes.items():
        named = "sh_degree" if name == "_extra_state" else name
        with refused(ArgumentError, name=named):
            other.load_state_dict(made.state_dict() | {name: change})
        assert all(torch.equal(value, before[name]) for name, value in other.state_dict().items())
    with pytest.raises(RuntimeError, match="Missing key"):
        other.load_state_dict({"means": other.means})


@pytest.mark.parametrize(
    ("dtype", "large"), [(torch.float32, 100.0), (torch.float64, 800.0), (torch.float32, math.inf)]
)
def test_a_scale_beyond_the_dtype_has_gradient_zero_and_the_others_theirs(dtype, large):
    made = model(3, dtype=dtype)
    with torch.no_grad():
        made.log_scales[1, 0] = large
    scales = made().scales
    assert torch.equal(scales, made.log_scales.exp())
    assert scales[1, 0] == math.inf
    camera = pinhole(20, 24, 20.0, dtype=dtype)
    for loss in (scales.clamp(max=2.0).sum(), GaussianRenderer()(made(), camera).image.sum()):
        made.zero_grad()
        loss.backward()
        assert all(bool(torch.isfinite(p.grad).all()) for p in made.parameters() if p.grad is not None)
        assert made.log_scales.grad[1, 0] == 0
    assert torch.equal(scales[0], made.log_scales[0].exp())


def test_antialiased_is_kept_by_what_makes_another_model():
    assert not GaussianModel.from_points(*cloud()).antialiased
    state = model().state_dict()
    made = GaussianModel(**state, antialiased=True)
    assert made.state_dict().keys() == state.keys()
    for again in (made.select(torch.arange(3)), made.to(torch.float64), copy.deepcopy(made)):
        assert again.antialiased
    made.sh_degree = 1
    assert repr(made) == "GaussianModel(7 Gaussians, sh_degree=1 of 3, torch.float64, antialiased)"


@pytest.mark.parametrize("rows", [torch.ones(6, dtype=torch.bool), torch.ones(8, 1, dtype=torch.bool)])
def test_a_mask_of_another_length_selects_nothing(rows):
    with pytest.raises(ArgumentError) as caught:
        model(7).select(rows)
    assert (caught.value.name, caught.value.got) == ("rows", str(tuple(rows.shape)))


def test_a_model_that_was_moved_to_half_precision_is_not_rendered(each_backend):
    with pytest.raises(TypeError, match="bfloat16"):
        model().to(torch.bfloat16)(backend=each_backend)

"""DropGaussian against `torch.nn.Dropout`: what it does to values and gradients, its rates and its warnings."""

import math
import warnings

import pytest
import torch
from factories import drop_layer as at
from factories import other_defaults
from factories import random_opacities as draw
from torch import nn

from kgs import DropGaussian, drop_gaussian

CPU = {"device": "cpu", "dtype": torch.float32}
# -- nn.Dropout's semantics ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(1000,), (1000, 1), (3, 1000), (0,)])
@pytest.mark.parametrize("p", [0.05, 0.2, 0.9])
def test_without_a_seed_the_bits_are_those_of_nn_dropout(p, shape, dtype):
    x = torch.rand(shape, generator=torch.Generator().manual_seed(1), dtype=dtype)
    results = []
    for layer in (nn.Dropout(p), at(1.0, p=p), at(0.3, p=p, schedule="constant"), lambda x: drop_gaussian(x, p)):
        torch.manual_seed(5)
        results.append((layer(x), torch.rand(3)))
    for result, after in results[1:]:
        assert torch.equal(result, results[0][0])
        assert result.dtype == dtype
        assert result.shape == shape
        assert torch.equal(after, results[0][1]), "as much of the generator's stream must be used"


@pytest.mark.parametrize("seed", [None, 3])
def test_eval_returns_the_same_object_and_train_drops_again(seed):
    layer, x = at(1.0, p=0.5, seed=seed), draw()
    assert layer(x) is not x
    assert layer.eval()(x) is x
    assert drop_gaussian(x, 0.5, training=False) is x
    assert (layer.train()(x) == 0).any()


@pytest.mark.parametrize("seed", [None, 3])
def test_a_rate_of_zero_returns_the_same_object_and_draws_nothing(seed):
    x = draw()
    before = torch.get_rng_state()
    assert drop_gaussian(x, 0.0) is x
    assert DropGaussian(p=0.0, schedule="constant", seed=seed)(x) is x
    assert at(0.0, p=0.2, seed=seed)(x) is x
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("seed", [None, 3])
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_kept_values_are_scaled_once_dropped_ones_exactly_zero_and_nothing_is_clamped(dtype, seed):
    x = torch.full((1000,), 0.75, dtype=dtype, requires_grad=True)
    out = at(1.0, p=0.5, seed=seed)(x)
    assert out.dtype == dtype
    assert set(out.tolist()) == {0.0, 1.5}
    assert (x == 0.75).all(), "the input is not changed"
    out.sum().backward()
    assert set(x.grad.tolist()) == {0.0, 2.0}
    assert torch.equal(x.grad == 0, out == 0)


@pytest.mark.parametrize("seed", [None, 3])
def test_every_camera_of_a_batch_has_a_mask_of_its_own(seed):
    out = at(1.0, p=0.5, seed=seed)(torch.ones(1000).expand(2, 1000))
    assert 300 < (out[0] != out[1]).sum() < 700


def test_the_layer_adds_nothing_to_the_state_dict():
    layer = at(0.4, p=0.2, seed=3)
    layer(draw())
    assert layer.state_dict() == {}
    assert list(layer.parameters()) == []
    nn.Sequential(nn.Linear(1, 1), layer).load_state_dict(nn.Sequential(nn.Linear(1, 1), nn.Identity()).state_dict())


@pytest.mark.parametrize("seed", [None, 3])
def test_default_device_default_dtype_and_autocast_do_not_reach_the_layer(seed):
    torch.manual_seed(0)
    expected = at(1.0, p=0.5, seed=seed)(draw())
    with other_defaults():
        torch.manual_seed(0)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            layer, x = at(1.0, p=0.5, seed=seed), torch.rand(1000, generator=torch.Generator().manual_seed(0), **CPU)
            out = layer(x)
    assert torch.equal(out, expected)


@pytest.mark.parametrize("shape", [(12,), (12, 1), (2, 6)])
def test_gradcheck(shape):
    x = draw(12, torch.float64).reshape(shape).requires_grad_()

    def default_stream(x):
        torch.manual_seed(0)
        return DropGaussian(p=0.4, schedule="constant")(x)

    assert torch.autograd.gradcheck(default_stream, x)
    assert torch.autograd.gradgradcheck(default_stream, x)
    assert torch.autograd.gradcheck(lambda x: DropGaussian(p=0.4, schedule="constant", seed=2)(x), x)


# -- rates, schedules, progress ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("schedule", "rates"),
    [
        ("linear", {0.0: 0.0, 0.25: 0.1, 1.0: 0.4}),
        ("constant", {0.0: 0.4, 0.25: 0.4, 1.0: 0.4}),
        (lambda progress: progress**2, {0.0: 0.0, 0.5: 0.1, 1.0: 0.4}),
        (lambda progress: progress / 2, {0.0: 0.0, 0.5: 0.1, 1.0: 0.2}),
    ],
)
def test_the_rate_is_p_times_the_schedule(schedule, rates):
    layer = DropGaussian(p=0.4, schedule=schedule)
    for progress, rate in rates.items():
        layer.progress = progress
        assert layer.progress == progress
        assert layer.rate == pytest.approx(rate, rel=1e-12)
        torch.manual_seed(0)
        dropped = (layer(torch.ones(100_000)) == 0).double().mean().item()
        assert abs(dropped - rate) <= 5 * math.sqrt(rate * (1 - rate) / 100_000)


@pytest.mark.parametrize("progress", [-1e-9, 1.0000001, 2, math.nan, math.inf, "0.5", None])
def test_progress_outside_zero_to_one_is_refused_and_the_old_one_stays(progress):
    layer = at(0.5)
    with pytest.raises(ValueError, match="progress"):
        layer.progress = progress
    assert layer.progress == 0.5


def test_values_are_read_in_the_first_call_alone():
    layer, x = at(1.0, p=0.5), draw()
    layer(x)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        layer(x + 1)


def test_never_set_progress_is_one_warns_once_and_is_dropout_at_p():
    layer, x = DropGaussian(p=0.5), draw()
    assert layer.progress == 1.0
    torch.manual_seed(0)
    with pytest.warns(UserWarning, match="progress was never set"):
        first = layer(x)
    torch.manual_seed(0)
    assert torch.equal(first, nn.Dropout(0.5)(x))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        layer(x)


@pytest.mark.parametrize(
    "layer", [at(1.0), at(0.0), DropGaussian(schedule="constant"), DropGaussian().eval()], ids=["1", "0", "c", "eval"]
)
def test_nothing_is_warned_about_when_nothing_is_amiss(layer):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        layer(draw())


def test_the_warning_points_at_the_calling_line():
    with pytest.warns(UserWarning, match="never set") as caught:
        DropGaussian()(draw())
    assert caught[0].filename == __file__


@pytest.mark.parametrize("seed", [None, 3])
@pytest.mark.parametrize("values", [[-2.2, 0.3], [0.5, 1.5], [math.inf, 0.1]])
def test_logits_are_warned_about_once_for_each_layer(values, seed):
    layer, x = at(1.0, seed=seed), torch.tensor(values)
    with pytest.warns(UserWarning, match=r"expected opacities in \[0, 1\]"):
        layer(x)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        layer(x)
        for fine in (torch.tensor([0.0, 1.0]), torch.empty(0), torch.tensor([math.nan]), torch.ones(2, device="meta")):
            at(1.0, seed=seed)(fine)


def test_vmap_draws_a_mask_for_each_sample():
    out = torch.func.vmap(at(1.0, p=0.5), randomness="different")(torch.ones(2, 1000))
    assert 300 < (out[0] != out[1]).sum() < 700


def test_repr_says_what_will_happen():
    assert repr(DropGaussian()) == "DropGaussian(p=0.2, schedule=linear, progress=1.0 (never set))"
    assert (
        repr(at(0.5, p=0.1, schedule="constant", seed=3))
        == "DropGaussian(p=0.1, schedule=constant, progress=0.5, seed=3)"
    )
    assert "schedule=sqrt," in repr(DropGaussian(schedule=math.sqrt))

"""DropGaussian against `torch.nn.Dropout`, exact enumeration of its masks, and closed forms of binomial statistics."""

import copy
import io
import itertools
import math
import pickle
import warnings

import pytest
import torch
from torch import nn
from torch.utils.checkpoint import checkpoint

import kgs
from kgs import DropGaussian, drop_gaussian

BAD_RATES = [-0.1, 1, 1.0, 1.5, math.inf, -math.inf, math.nan]


def draw(n=1000, dtype=torch.float32, seed=0):
    return torch.rand(n, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def at(progress, **options):
    layer = DropGaussian(**options)
    layer.progress = progress
    return layer


def halved(progress):
    return progress / 2


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


def test_fork_rng_leaves_the_outer_stream_alone():
    layer = at(1.0, p=0.5)
    torch.manual_seed(0)
    with torch.random.fork_rng():
        inside = layer(draw())
    outside = layer(draw())
    assert torch.equal(inside, outside)


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
def test_kept_values_are_scaled_once_dropped_ones_exactly_zero_and_nothing_is_clamped(seed):
    x = torch.full((1000,), 0.9, dtype=torch.float64)
    out = at(1.0, p=0.2, seed=seed)(x)
    assert set(out.tolist()) == {0.0, 0.9 * (1 / 0.8)}
    assert out.max() > 1


@pytest.mark.parametrize("seed", [None, 3])
def test_every_camera_of_a_batch_has_a_mask_of_its_own(seed):
    out = at(1.0, p=0.5, seed=seed)(torch.ones(2, 1000))
    assert 300 < (out[0] != out[1]).sum() < 700
    assert at(1.0, p=0.5, seed=seed)(torch.ones(1000).expand(2, 1000)).unique(dim=0).shape[0] == 2


def test_the_input_is_not_changed():
    x = draw()
    before = x.clone()
    at(1.0, p=0.5)(x)
    at(1.0, p=0.5, seed=1)(x)
    assert torch.equal(x, before)


def test_the_renderers_module_calls_reach_the_layer_in_a_sequential():
    model = nn.Sequential(nn.Sigmoid(), at(1.0, p=0.5))
    logits = draw()
    assert (model(logits) == 0).any()
    assert torch.equal(model.eval()(logits), logits.sigmoid())


def test_the_layer_adds_nothing_to_the_state_dict():
    layer = at(0.4, p=0.2, seed=3)
    layer(draw())
    assert layer.state_dict() == {}
    assert list(layer.parameters()) == []
    nn.Sequential(nn.Linear(1, 1), layer).load_state_dict(nn.Sequential(nn.Linear(1, 1), nn.Identity()).state_dict())


def test_activation_checkpointing_recomputes_the_same_mask():
    layer = at(1.0, p=0.5)
    weight = draw(seed=2).requires_grad_()

    def loss(x):
        return (layer(x.sigmoid()) * weight).square().sum()

    gradients = []
    for reentrant in (None, False, True):
        x = draw(seed=1).requires_grad_()
        weight.grad = None
        torch.manual_seed(7)
        (loss(x) if reentrant is None else checkpoint(loss, x, use_reentrant=reentrant)).backward()
        gradients.append((x.grad, weight.grad))
    for x_grad, weight_grad in gradients[1:]:
        assert torch.equal(x_grad, gradients[0][0])
        assert torch.equal(weight_grad, gradients[0][1])


def _compiled(backend):
    torch._dynamo.reset()
    layer = DropGaussian(p=0.4)
    step = torch.compile(lambda x: layer(x) * 2, backend=backend)
    outputs = []
    for progress in (0.25, 0.5, 1.0):
        layer.progress = progress
        x = torch.ones(20_000, requires_grad=True)
        out = step(x)
        out.sum().backward()
        outputs.append((0.4 * progress, out.detach(), x.grad))
    layer.eval()
    return outputs, torch.equal(step(torch.ones(8)), torch.full((8,), 2.0))


def _check_compiled(backend):
    outputs, identity_in_eval = _compiled(backend)
    for rate, out, grad in outputs:
        kept = out != 0
        torch.testing.assert_close(out[kept], torch.full_like(out[kept], 2 / (1 - rate)))
        torch.testing.assert_close(grad, out)
        assert abs(kept.double().mean() - (1 - rate)) < 5 * math.sqrt(rate * (1 - rate) / len(out))
    assert identity_in_eval


def test_torch_compile_follows_the_progress():
    _check_compiled("eager")


@pytest.mark.slow
def test_torch_compile_with_inductor_follows_the_progress():
    try:
        torch.compile(lambda x: x + 1)(torch.ones(2))
    except Exception as error:
        pytest.skip(f"no compiler works here: {type(error).__name__}")
    _check_compiled("inductor")


# -- a stream of its own -------------------------------------------------------------------------------------------


def stream(layer, calls=3):
    return torch.stack([layer(draw()) for _ in range(calls)])


def test_own_stream_is_repeatable_and_advances():
    first = stream(at(1.0, p=0.5, seed=3))
    assert torch.equal(first, stream(at(1.0, p=0.5, seed=3)))
    assert not torch.equal(first[0], first[1])
    assert not torch.equal(first, stream(at(1.0, p=0.5, seed=4)))


@pytest.mark.parametrize("seed", [0, 3, -1, 2**63])
def test_own_stream_and_the_global_one_do_not_touch(seed):
    torch.manual_seed(0)
    first = stream(at(1.0, p=0.5, seed=seed))
    torch.manual_seed(1)
    before = torch.get_rng_state()
    assert torch.equal(stream(at(1.0, p=0.5, seed=seed)), first)
    assert torch.equal(torch.get_rng_state(), before)


def test_own_stream_does_not_depend_on_the_number_of_threads():
    threads = torch.get_num_threads()
    results = []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            torch.manual_seed(0)
            results.append((at(1.0, p=0.5, seed=3)(draw(100_000)), at(1.0, p=0.5)(draw(100_000))))
    finally:
        torch.set_num_threads(threads)
    for own, default in results[1:]:
        assert torch.equal(own, results[0][0])
        assert torch.equal(default, results[0][1])


def _through_pickle(layer):
    return pickle.loads(pickle.dumps(layer))


def _through_torch_save(layer):
    buffer = io.BytesIO()
    torch.save(layer, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=False)


@pytest.mark.parametrize("copied", [copy.deepcopy, _through_pickle, _through_torch_save, lambda layer: layer.to("cpu")])
@pytest.mark.parametrize("calls_before", [0, 2])
@pytest.mark.parametrize("schedule", ["linear", "constant", halved])
def test_copies_continue_the_stream(copied, calls_before, schedule):
    layer = at(0.75, p=0.5, schedule=schedule, seed=3)
    stream(layer, max(calls_before, 1)) if calls_before else None
    twin = copied(layer)
    if twin is not layer:
        assert (twin.p, twin.progress, twin.rate, twin.seed) == (layer.p, layer.progress, layer.rate, layer.seed)
        assert torch.equal(stream(twin), stream(layer))
    else:
        reference = at(0.75, p=0.5, schedule=schedule, seed=3)
        stream(reference, calls_before) if calls_before else None
        assert torch.equal(stream(twin), stream(reference))


def test_a_deepcopy_draws_from_a_generator_of_its_own():
    layer = at(1.0, p=0.5, seed=3)
    stream(layer)
    twin = copy.deepcopy(layer)
    stream(twin, 5)
    untouched = at(1.0, p=0.5, seed=3)
    stream(untouched)
    assert torch.equal(stream(layer), stream(untouched))


def test_rng_state_continues_the_stream_in_another_layer():
    layer = at(1.0, p=0.5, seed=3)
    stream(layer)
    state = layer.get_rng_state()
    expected = stream(layer)
    other = at(1.0, p=0.5, seed=99)
    other.set_rng_state(state)
    assert torch.equal(stream(other), expected)
    layer.set_rng_state(state)
    assert torch.equal(stream(layer), expected)


def test_rng_state_before_the_first_call_is_the_seeds():
    layer, other = at(1.0, p=0.5, seed=3), at(1.0, p=0.5, seed=4)
    other.set_rng_state(layer.get_rng_state())
    assert torch.equal(stream(other), stream(at(1.0, p=0.5, seed=3)))


def test_a_layer_on_the_default_generator_has_no_state():
    layer = DropGaussian()
    with pytest.raises(ValueError, match="seed"):
        layer.get_rng_state()
    with pytest.raises(ValueError, match="seed"):
        layer.set_rng_state(torch.get_rng_state())


def test_the_functions_generator_argument_is_used():
    x = draw()
    first = drop_gaussian(x, 0.5, generator=torch.Generator().manual_seed(1))
    assert torch.equal(first, drop_gaussian(x, 0.5, generator=torch.Generator().manual_seed(1)))
    assert not torch.equal(first, drop_gaussian(x, 0.5, generator=torch.Generator().manual_seed(2)))


# -- statistics ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [None, 3])
@pytest.mark.parametrize("p", [0.2, 0.7])
def test_kept_fraction_and_mean_factor_lie_within_five_sigma(p, seed):
    n = 1_000_000
    torch.manual_seed(11)
    factors = at(1.0, p=p, seed=seed)(torch.ones(n))
    kept = (factors != 0).double().mean().item()
    assert abs(kept - (1 - p)) < 5 * math.sqrt(p * (1 - p) / n)
    assert abs(factors.double().mean().item() - 1) < 5 * math.sqrt(p / (1 - p) / n)


def composite(opacities, weights, colors):
    """Front-to-back alpha blending of one pixel: sum c_i a_i prod_{j<i} (1 - a_j)."""
    color, light = torch.zeros(3, dtype=torch.float64), 1.0
    for alpha, rgb in zip(opacities * weights, colors, strict=True):
        color = color + light * alpha * rgb
        light = light * (1 - alpha)
    return color


def test_the_expectation_over_all_masks_is_the_undropped_pixel(monkeypatch):
    n, p = 8, 0.2
    opacities, weights = draw(n, torch.float64, 1) * 0.75, draw(n, torch.float64, 2)
    colors = draw(3 * n, torch.float64, 3).reshape(n, 3)
    expectation = torch.zeros(3, dtype=torch.float64)
    for kept in itertools.product((0.0, 1.0), repeat=n):
        mask = torch.tensor(kept, dtype=torch.float64)
        monkeypatch.setattr(torch.Tensor, "bernoulli_", lambda self, q, generator, mask=mask: self.copy_(mask))
        dropped = drop_gaussian(opacities, p, generator=torch.Generator())
        probability = math.prod(1 - p if k else p for k in kept)
        expectation += probability * composite(dropped, weights, colors)
    torch.testing.assert_close(expectation, composite(opacities, weights, colors), rtol=0, atol=1e-14)


def test_the_mean_of_many_random_pixels_is_the_undropped_pixel():
    n, p, draws = 8, 0.2, 20_000
    opacities, weights = draw(n, torch.float64, 1) * 0.75, draw(n, torch.float64, 2)
    alphas = at(1.0, p=p, seed=0)(opacities.expand(draws, n)) * weights
    light = torch.cumprod(torch.cat([torch.ones(draws, 1, dtype=torch.float64), 1 - alphas], 1), 1)
    brightness = (light[:, :-1] * alphas).sum(1)
    exact = composite(opacities, weights, torch.ones(n, 3, dtype=torch.float64))[0]
    assert abs(brightness.mean() - exact) < 5 * brightness.std() / math.sqrt(draws)


# -- gradients -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [None, 3])
def test_dropped_gradients_are_exactly_zero_and_kept_ones_exactly_the_factor(seed):
    x = draw(dtype=torch.float64).requires_grad_()
    out = at(1.0, p=0.2, seed=seed)(x)
    out.sum().backward()
    assert set(x.grad.tolist()) == {0.0, 1 / (1 - 0.2)}
    assert torch.equal(x.grad == 0, out == 0)


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


@pytest.mark.parametrize("p", BAD_RATES)
def test_rates_outside_zero_to_one_are_refused(p):
    with pytest.raises(ValueError, match="p: expected"):
        DropGaussian(p=p)
    for training in (True, False):
        with pytest.raises(ValueError, match="p: expected"):
            drop_gaussian(draw(), p, training=training)


@pytest.mark.parametrize(
    ("schedule", "rates"),
    [
        ("linear", {0.0: 0.0, 0.25: 0.1, 1.0: 0.4}),
        ("constant", {0.0: 0.4, 0.25: 0.4, 1.0: 0.4}),
        (lambda progress: progress**2, {0.0: 0.0, 0.5: 0.1, 1.0: 0.4}),
        (halved, {0.0: 0.0, 0.5: 0.1, 1.0: 0.2}),
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


def test_the_paper_rate_of_step_t_is_p_t_over_total():
    layer = DropGaussian(p=0.2)
    for step in (1, 500, 2000):
        layer.progress = step / 2000
        assert layer.rate == pytest.approx(0.2 * step / 2000, rel=1e-12)


@pytest.mark.parametrize("factor", [-1.0, 5.0, math.nan])
def test_a_schedule_that_leaves_the_range_is_refused_in_the_call(factor):
    layer = at(0.5, p=0.2, schedule=lambda progress: factor)
    with pytest.raises(ValueError, match="schedule"):
        layer(draw())


@pytest.mark.parametrize("schedule", ["cosine", "", 3, None])
def test_unknown_schedules_are_refused(schedule):
    with pytest.raises(ValueError, match="schedule"):
        DropGaussian(schedule=schedule)


@pytest.mark.parametrize("progress", [-1e-9, 1.0000001, 2, math.nan, math.inf])
def test_progress_outside_zero_to_one_is_refused_and_the_old_one_stays(progress):
    layer = at(0.5)
    with pytest.raises(ValueError, match="progress"):
        layer.progress = progress
    assert layer.progress == 0.5


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
        DropGaussian().forward(draw())
    assert caught[0].filename == __file__


def test_repr_says_what_will_happen():
    assert repr(DropGaussian()) == "DropGaussian(p=0.2, schedule=linear, progress=1.0 (never set))"
    assert (
        repr(at(0.5, p=0.1, schedule="constant", seed=3))
        == "DropGaussian(p=0.1, schedule=constant, progress=0.5, seed=3)"
    )
    assert "halved" in repr(DropGaussian(schedule=halved))


def test_the_layer_is_the_public_one():
    assert kgs.DropGaussian is DropGaussian
    assert kgs.drop_gaussian is drop_gaussian

"""DropGaussian against `torch.nn.Dropout`: what it does to values and gradients, its rates and its warnings."""

import copy
import importlib
import io
import math
import pickle
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from factories import drop_layer as at
from factories import random_camera, random_gaussians
from factories import random_opacities as draw
from torch import nn

import kgs.drop as drop_module
from kgs import DropGaussian, GaussianRenderer, drop_gaussian

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
    assert layer.eval()(x) is x
    assert layer.last_scale is None
    out = layer.train()(x)
    assert (out == 0).any()
    layer.eval()(x)
    assert layer.last_scale is None
    assert torch.equal(layer.train().last_scale * x, out)
    assert drop_gaussian(x, 0.5, training=False) is x


@pytest.mark.parametrize("seed", [None, 3])
def test_a_rate_of_zero_returns_the_same_object_and_draws_nothing(seed):
    x = draw()
    before = torch.get_rng_state()
    assert drop_gaussian(x, 0.0) is x
    assert DropGaussian(p=0.0, schedule="constant", seed=seed)(x) is x
    assert at(0.0, p=0.2, seed=seed)(x) is x
    below_zero_by_rounding = at(1.0, p=0.5, seed=seed, schedule=lambda progress: 0.3 - 0.1 * 3 * progress)
    assert below_zero_by_rounding.rate == 0.0
    assert below_zero_by_rounding(x) is x
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
    layer, x = at(1.0, p=0.5, seed=seed), torch.ones(2, 1000)
    outputs = [layer(x)]
    if seed is None:
        outputs.append(torch.func.vmap(layer, randomness="different")(x))
    for out in outputs:
        assert 300 < (out[0] != out[1]).sum() < 700


@pytest.mark.parametrize("p", [0.2, nn.Parameter(torch.tensor([0.0, 0.1, 0.5, 0.9]))], ids=["a rate", "rates"])
def test_the_layer_has_no_state_and_rates_get_no_gradient(p):
    layer = at(0.4, p=p, seed=3)
    layer(torch.ones(4, requires_grad=True)).sum().backward()
    assert layer.state_dict() == {}
    assert list(layer.parameters()) == []
    assert getattr(p, "grad", None) is None


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


@pytest.mark.parametrize("progress", [-1e-9, 1.000002, 2, math.nan, math.inf, "0.5", None])
def test_progress_outside_zero_to_one_is_refused_and_the_old_one_stays(progress):
    layer = at(0.5)
    with pytest.raises(ValueError, match="progress"):
        layer.progress = progress
    assert layer.progress == 0.5


@pytest.mark.parametrize("steps", [9, 10, 11, 2999])
def test_progress_that_is_added_up_ends_at_one(steps):
    layer = at(0.0, p=0.5)
    for _ in range(steps):
        layer.progress += 1 / steps
    assert layer.progress == pytest.approx(1.0, abs=1e-9)
    assert layer.rate <= 0.5
    layer.progress = 1.000001
    assert layer.progress == 1.0


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
def test_nothing_is_warned_about_when_nothing_is_amiss_and_values_are_read_in_the_first_call_alone(layer):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        layer(draw())
        layer(draw() + 1)


def hooked(layer):
    layer.register_forward_pre_hook(lambda module, args: None)
    layer.register_forward_hook(lambda module, args, output: None)
    return layer


@pytest.mark.parametrize(
    "wrapped",
    [
        lambda layer: layer,
        hooked,
        lambda layer: nn.Sequential(nn.Identity(), layer),
        lambda layer: nn.DataParallel(layer),  # without a GPU it calls its module
        lambda layer: torch.no_grad()(layer),
        lambda layer: torch.compile(layer, backend="eager"),
    ],
    ids=["layer", "hooked", "sequential", "parallel", "no_grad", "compiled"],
)
def test_the_warning_points_at_the_calling_line(wrapped):
    torch._dynamo.reset()
    call = wrapped(DropGaussian())
    with pytest.warns(UserWarning, match="never set") as caught:
        call(draw())
    (warning,) = [each for each in caught if "never set" in str(each.message)]
    assert warning.filename == __file__
    assert "call(draw())" in Path(__file__).read_text().splitlines()[warning.lineno - 1]


def test_the_warning_of_a_layer_in_the_renderer_points_at_the_line_that_renders():
    renderer = GaussianRenderer(DropGaussian())
    gaussians, camera = random_gaussians(4, 0, torch.float32), random_camera(8, 8, 0, torch.float32)
    with pytest.warns(UserWarning, match="never set") as caught:
        renderer(gaussians, camera)
    assert caught[0].filename == __file__


def test_the_warning_of_a_copied_file_points_at_the_calling_line(tmp_path, monkeypatch):
    (tmp_path / "copied_drop.py").write_text(Path(drop_module.__file__).read_text())
    (tmp_path / "copied_drop_user.py").write_text("def use(layer, x):\n    return layer(x)\n")
    monkeypatch.syspath_prepend(tmp_path)
    copied, user = map(importlib.import_module, ("copied_drop", "copied_drop_user"))
    with pytest.warns(UserWarning, match="never set") as caught:
        user.use(hooked(copied.DropGaussian()), draw())
    assert (caught[0].filename, caught[0].lineno) == (user.__file__, 2)


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


def test_repr_says_what_will_happen():
    assert repr(DropGaussian()) == "DropGaussian(p=0.2, schedule=linear, progress=1.0 (never set))"
    assert repr(DropGaussian(schedule="constant")) == "DropGaussian(p=0.2, schedule=constant)"
    full = repr(at(0.5, p=torch.zeros(5), schedule=math.sqrt, seed=3, scale=False))
    assert full == "DropGaussian(p=tensor of shape (5,), schedule=sqrt, progress=0.5, seed=3, scale=False)"


# -- a rate for each Gaussian --------------------------------------------------------------------------------------

RATES = torch.tensor([0.0, 0.1, 0.5, 0.9])


@pytest.mark.parametrize("seed", [None, 3])
@pytest.mark.parametrize("kind", [torch.float16, torch.float32, torch.float64])
@pytest.mark.parametrize("scale", [True, False])
@pytest.mark.parametrize("shape", [(4,), (4, 1), (50_000, 4)])
def test_each_gaussian_has_its_rate(shape, scale, kind, seed):
    """The share of dropped ones, the mean over masks, and the exact value of those that are kept."""
    layer = at(1.0, p=RATES.to(kind), seed=seed, scale=scale)
    torch.manual_seed(0)
    values = torch.tensor([0.2, 0.4, 0.6, 0.8], dtype=torch.float64)
    x = (values[:, None] if shape == (4, 1) else values.expand(shape)).clone().requires_grad_()
    out = layer(x)
    assert (out.shape, out.dtype) == (x.shape, x.dtype)
    factors = 1 / (1 - RATES.to(kind).double()) if scale else torch.ones(4, dtype=torch.float64)
    expected = torch.where(out == 0, 0.0, x * (factors[:, None] if shape == (4, 1) else factors))
    torch.testing.assert_close(out, expected, rtol=1e-14, atol=0.0)
    out.sum().backward()
    torch.testing.assert_close(x.grad, out.detach() / x.detach(), rtol=1e-14, atol=0.0)
    if shape == (50_000, 4):
        rates = RATES.to(kind).double()
        share = (out == 0).double().mean(0)
        assert (share - rates).abs().le(5 * (rates * (1 - rates) / 50_000).sqrt()).all()
        mean = values if scale else values * (1 - rates)
        bound = 5 * values * factors * (rates * (1 - rates) / 50_000).sqrt()
        assert (out.mean(0) - mean).abs().le(bound + 1e-12).all()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_rates_leave_the_dtype_and_their_schedule_is_that_of_a_number(dtype):
    x = torch.full((4,), 0.5, dtype=dtype)
    assert drop_gaussian(x, RATES).dtype == dtype
    layer = at(0.5, p=RATES)
    torch.testing.assert_close(layer.rate, RATES / 2)
    layer.p = torch.tensor([0.0, 0.0])
    assert torch.equal(layer(torch.tensor([0.3, 0.4])), torch.tensor([0.3, 0.4]))
    assert torch.equal(drop_gaussian(x, torch.zeros(4, dtype=torch.int64)), x)
    assert drop_gaussian(torch.empty(0), torch.empty(0)).shape == (0,)


# -- no compensation, and the factors of the last call -------------------------------------------------------------


@pytest.mark.parametrize("p", [0.0, 0.3, RATES])
@pytest.mark.parametrize("scale", [True, False])
@pytest.mark.parametrize("seed", [None, 3])
@pytest.mark.parametrize("shape", [(4,), (4, 1), (3, 4)])
def test_the_factors_of_the_last_call_are_those_of_its_opacities(shape, seed, scale, p):
    layer = at(1.0, p=p, seed=seed, scale=scale)
    assert layer.last_scale is None
    x = draw(math.prod(shape)).reshape(shape).requires_grad_()
    for _ in range(2):
        out = layer(x)
        factors = layer.last_scale
        assert (factors.shape, factors.dtype, factors.requires_grad) == (x.shape, x.dtype, False)
        assert torch.equal(out, x * factors)
        assert scale or set(factors.flatten().tolist()) <= {0.0, 1.0}
        (gradient,) = torch.autograd.grad(out.sum(), x)
        assert torch.equal(gradient, factors)


@pytest.mark.parametrize("p", [0.5, RATES])
@pytest.mark.parametrize("seed", [None, 3])
@pytest.mark.parametrize(
    "transform",
    [
        lambda layer: torch.func.vmap(layer, randomness="different"),
        lambda layer: torch.func.grad(lambda x: layer(x).sum()),
        lambda layer: torch.func.functionalize(layer),
        lambda layer: lambda x: torch.func.jvp(layer, (x,), (x,)),
    ],
    ids=["vmap", "grad", "functionalize", "jvp"],
)
def test_within_torch_func_there_are_no_factors(transform, seed, p):
    layer = at(1.0, p=p, seed=seed)
    x = torch.ones(3, 4)
    layer(x)
    transform(layer)(x)
    factors = layer.last_scale
    assert factors is None or factors.tolist(), "none, or some that can be read"
    if seed is None and not isinstance(p, torch.Tensor):
        assert factors is None
    out = layer(x)
    assert torch.equal(out, x * layer.last_scale)


@pytest.mark.parametrize("kind", [torch.tensor, np.float32, lambda value: torch.tensor([value])])
def test_a_schedule_may_return_a_number_of_any_kind(kind):
    assert at(0.5, p=0.5, schedule=lambda progress: kind(progress)).rate == 0.25


# -- streams ---------------------------------------------------------------------------------------------------------


class Masks(torch.utils.data.Dataset):
    """A data set that drops, in whatever process it is asked."""

    def __init__(self, layer):
        self.layer = layer

    def __len__(self):
        return 3

    def __getitem__(self, index):
        return self.layer(draw())


def halved(progress):
    return progress / 2


def stream(layer, calls=3):
    return torch.stack([layer(draw()) for _ in range(calls)])


@pytest.mark.parametrize("seed", [0, -1, 2**63, np.int64(3)])
def test_own_stream_and_the_global_one_do_not_touch(seed):
    torch.manual_seed(0)
    first = stream(at(1.0, p=0.5, seed=seed))
    torch.manual_seed(1)
    before = torch.get_rng_state()
    assert torch.equal(stream(at(1.0, p=0.5, seed=seed)), first)
    assert torch.equal(torch.get_rng_state(), before)


def test_own_stream_does_not_depend_on_the_number_of_threads(set_threads):
    results = []
    for count in (1, 2, 3):
        set_threads(count)
        results.append(at(1.0, p=0.5, seed=3)(draw(100_000)))
    assert all(torch.equal(result, results[0]) for result in results)


def _through_pickle(layer):
    return pickle.loads(pickle.dumps(layer))


def _through_torch_save(layer):
    buffer = io.BytesIO()
    torch.save(layer, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=False)


@pytest.mark.parametrize("copied", [copy.deepcopy, _through_pickle, _through_torch_save])
@pytest.mark.parametrize("calls_before", [0, 2])
@pytest.mark.parametrize("settings", [{}, {"schedule": "constant"}, {"schedule": halved, "scale": False}])
@pytest.mark.parametrize("p", [0.5, torch.linspace(0, 0.9, 1000)], ids=["a rate", "rates"])
def test_copies_have_all_settings_and_continue_the_stream_without_the_last_factors(copied, calls_before, settings, p):
    layer, other = (at(0.75, p=p, seed=3, **settings) for _ in range(2))
    for _ in range(calls_before):
        assert torch.equal(layer(draw()), other(draw()))
    twin = copied(layer)
    assert repr(twin) == repr(layer)
    assert torch.equal(torch.as_tensor(twin.rate), torch.as_tensor(layer.rate))
    assert twin.last_scale is None
    expected = stream(other)
    assert torch.equal(stream(twin), expected)
    assert torch.equal(stream(layer), expected), "its generator is its own"


@pytest.mark.parametrize("calls_before", [0, 3])
def test_rng_state_continues_the_stream_in_another_layer(calls_before):
    layer = at(1.0, p=0.5, seed=3)
    for _ in range(calls_before):
        layer(draw())
    state = layer.get_rng_state()
    expected = stream(layer)
    other = at(1.0, p=0.5, seed=99)
    other.set_rng_state(state)
    assert torch.equal(stream(other), expected)
    layer.set_rng_state(state)
    assert torch.equal(stream(layer), expected)


@pytest.mark.parametrize("context", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_a_worker_of_a_data_loader_continues_the_stream(context):
    layer = at(1.0, p=0.5, seed=3)
    stream(layer)
    loader = torch.utils.data.DataLoader(Masks(layer), batch_size=None, num_workers=1, multiprocessing_context=context)
    assert torch.equal(torch.stack(list(loader)), stream(layer))


@pytest.mark.parametrize("shape", [(1000,), (3, 50)])
def test_the_stream_is_that_of_bernoulli_on_the_cpu_for_tensors_on_any_device(shape):
    reference = torch.Generator().manual_seed(3)
    expected = [torch.empty(shape).bernoulli_(0.8, generator=reference) / 0.8 for _ in range(3)]
    layer = at(1.0, p=0.2, seed=3)
    assert torch.equal(layer(torch.ones(shape)), expected[0])
    assert layer(torch.ones(shape, device="meta")).device.type == "meta"  # stands for an accelerator
    state = layer.get_rng_state()
    assert state.device.type == "cpu"
    layer.set_rng_state(state)
    assert torch.equal(layer(torch.ones(shape)), expected[2])


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_stream_continues_from_cuda_to_the_cpu_and_back():
    layer, reference = (at(1.0, p=0.5, seed=3) for _ in range(2))
    for device in ("cuda", "cpu", "cuda"):
        other = at(1.0, p=0.5, seed=9)
        other.set_rng_state(layer.get_rng_state())
        layer = other
        assert torch.equal(layer(draw().to(device)).cpu(), reference(draw()))

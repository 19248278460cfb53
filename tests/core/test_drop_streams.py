"""DropGaussian's own stream of masks."""

import copy
import io
import pickle

import numpy as np
import pytest
import torch
from factories import drop_layer as at
from factories import random_opacities as draw


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

"""The same input gives the same bits, on however many threads and beside other renders."""

import threading

import pytest
import torch
from factories import OUTPUTS, leaves, random_camera, random_gaussians
from kornia.geometry.camera import PinholeCamera

from kgs import GaussianRenderer

pytestmark = pytest.mark.usefixtures("each_backend")

LARGE = (200, 400)  # enough tiles for several pieces of work
SMALL = (24, 32)  # one piece


def run(dtype=torch.float32, n=1500, options=None, seed=0, size=LARGE):
    """All outputs of one render and all gradients of a loss."""
    gaussians, inputs = leaves(random_gaussians(n, seed, dtype, 1, image_size=120))
    camera = random_camera(*size, seed, dtype)
    inputs += [camera.extrinsics.clone().requires_grad_(), camera.intrinsics.clone().requires_grad_()]
    posed = PinholeCamera(inputs[6], inputs[5], camera.height, camera.width)
    out = GaussianRenderer(**(options or {}))(gaussians, posed, outputs=OUTPUTS)
    gradients = torch.autograd.grad(out.image.square().sum() + out.depth.mean(), inputs)
    return [getattr(out, name).detach() for name in OUTPUTS] + list(gradients)


def assert_equal_bits(first, second):
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("size", "n", "options"), [(LARGE, 1500, {}), (SMALL, 100, {}), (LARGE, 300, {"max_bytes": 2**20})]
)
def test_one_and_two_threads_are_equal(set_threads, dtype, size, n, options):
    set_threads(1)
    first = run(dtype, n, options, size=size)
    set_threads(2)
    assert_equal_bits(run(dtype, n, options, size=size), first)


def test_rendering_leaves_the_number_of_threads_alone(set_threads):
    for count in (2, 3):
        set_threads(count)
        run(n=300)
        assert torch.get_num_threads() == count
        seen = []
        born_later = threading.Thread(target=lambda seen=seen: seen.append(torch.get_num_threads()))
        born_later.start()
        born_later.join()
        assert seen == [count]


def test_two_renders_at_the_same_time_are_equal_to_one(set_threads):
    set_threads(2)
    expected = run(n=500)
    found = [None] * 3

    def work(i):
        found[i] = run(n=500)

    workers = [threading.Thread(target=work, args=(i,)) for i in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    for result in found:
        assert_equal_bits(result, expected)


def test_rendering_draws_no_random_numbers():
    state = torch.get_rng_state()
    run(n=50)
    assert torch.equal(torch.get_rng_state(), state)

"""The promise of `max_bytes`, measured: the resident memory of a process of its own, and the memory of a card."""

import subprocess
import sys

import pytest
import torch
from factories import leaves, random_scene
from targets import move

from kgs import GaussianRenderer

PROGRAM = """
import sys
import torch
import kgs

torch.set_num_threads(1)
generator = torch.Generator().manual_seed(0)


def status(name):
    for line in open("/proc/self/status"):
        if line.startswith(name):
            return int(line.split()[1]) / 1024


def gaussians(n):  # lines of 2 px as tall as the image
    means = torch.cat([2 * torch.rand(n, 2, generator=generator) - 1, 4 + torch.rand(n, 1, generator=generator)], 1)
    scales, quats = torch.tensor([[0.004, 2.0, 0.004]]).repeat(n, 1), torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1)
    values = (means, quats, scales, 0.005 + 0.02 * torch.rand(n, generator=generator), torch.rand(n, 3))
    return kgs.Gaussians(*(value.requires_grad_() for value in values))


def run(n, height, max_bytes):
    k = torch.tensor([[500.0, 0, 127.5], [0, 500.0, (height - 1) / 2], [0, 0, 1]])
    camera = kgs.pinhole_cameras(torch.eye(4), k, 256, height)
    kgs.GaussianRenderer(max_bytes=max_bytes)(gaussians(n), camera).image.sum().backward()


mebibytes, count = int(sys.argv[1]), 15000
run(10, 32, 2**30)
few = gaussians(count)
open("/proc/self/clear_refs", "w").write("5")
before = status("VmRSS")
run(count, 1024, mebibytes * 2**20)
print(status("VmHWM") - before)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
@pytest.mark.slow
@pytest.mark.parametrize("mebibytes", [24, 64])
def test_a_call_stays_within_max_bytes_for_tall_gaussians(mebibytes):
    """Lines in 128 rows of tiles: 15 000 are 2 million spans, which took 170 MiB whatever the bound was."""
    run = [sys.executable, "-c", PROGRAM, str(mebibytes)]
    done = subprocess.run(run, capture_output=True, text=True, check=True)
    beside = 15000 * 4 * (14 + 2 * 14 + 40) / 2**20 + 256 * 1024 * 4 * 20 / 2**20  # numbers per Gaussian, per pixel
    assert float(done.stdout) <= mebibytes + beside


def test_max_bytes_bounds_the_memory_of_a_device_and_keeps_the_image(each_device):
    gaussians, camera = random_scene(8, torch.float32, 4000, (256, 320), None)
    bound, found = 24 * 2**20, []
    for max_bytes in (2**30, bound):
        given, inputs = leaves(move(gaussians, each_device))
        if each_device.type == "cuda":
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats()
            held = torch.cuda.memory_allocated()
        image = GaussianRenderer(max_bytes=max_bytes)(given, move(camera, each_device)).image
        found.append([image, *torch.autograd.grad(image.square().sum(), inputs)])
    if each_device.type == "cuda":
        beside = 4000 * 4 * 120 + 256 * 320 * 4 * 40  # numbers per Gaussian, per pixel
        assert torch.cuda.max_memory_allocated() - held <= bound + beside
    for (got, expected), error in zip(zip(*reversed(found), strict=True), (1e-5, *[1e-3] * 5), strict=True):
        assert (got - expected).abs().max() <= error * expected.abs().max()

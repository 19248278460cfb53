"""Loss, layer, densification, fits and commands on CUDA (`pytest -m cuda`), and with `-m slow` on the CPU, to try them.

Renders on CUDA are tested beside those on a CPU, by the fixtures `kernels` and `each_device`.
"""

from dataclasses import replace

import pytest
import torch
from factories import drop_layer, random_opacities
from targets import CARD, CPU, move

import kgs
from kgs.app.cli import main
from kgs.fit.config import FitConfig, Recipe
from kgs.fit.plan import make_plan
from kgs.fit.trainer import Trainer
from kgs.losses import photometric_loss, target_moments

CONFIG = FitConfig(steps=30, drop=0.3, seed=5, evaluations=3, recipe=Recipe(grad_threshold=1e-5))


@pytest.fixture(params=[pytest.param("cuda", marks=CARD), pytest.param("cpu", marks=pytest.mark.slow)])
def device(request):
    """Where the test runs."""
    return torch.device(request.param)


@pytest.fixture
def config(device):
    return replace(CONFIG, device=str(device))


def fitted(scene, points, config, steps=None):
    trainer = Trainer(scene, make_plan(scene, config, points), points)
    trainer.fit(lambda trainer, _: trainer.step == steps)
    return trainer


def bits(trainer):
    return {name: value.detach().cpu() for name, value in trainer.model.named_parameters()}


def assert_same_bits(first, second):
    assert all(torch.equal(value, bits(second)[name]) for name, value in bits(first).items())


def assert_finite(trainer):
    assert all(bool(value.isfinite().all()) for value in bits(trainer).values())


@pytest.mark.parametrize("masked", [False, True])
def test_the_loss_and_its_gradient(device, masked):
    generator = torch.Generator().manual_seed(0)
    image, target = torch.rand(2, 3, 45, 67, generator=generator), torch.rand(2, 3, 45, 67, generator=generator)
    mask = torch.ones(45, 67, dtype=torch.bool)
    mask[5:9, 20:30] = not masked
    found = []
    for where, fast, dtype in ((device, True, torch.float32), (CPU, False, torch.float64)):
        leaf = move(image, where, dtype).clone().requires_grad_()
        loss = photometric_loss(leaf, move(target, where, dtype), mask=mask.to(where), fast=fast)
        found.append([move(x, CPU, torch.float64) for x in (loss, torch.autograd.grad(loss, leaf)[0])])
    (loss, gradient), (expected, wanted) = found
    assert abs(loss - expected) <= 1e-6
    assert (gradient - wanted).abs().max() <= 1e-5 * wanted.abs().max()
    assert target_moments(target.to(device)).mean.device.type == device.type


def test_a_seeded_layer_drops_the_same_gaussians_as_on_the_cpu(device):
    opacities = random_opacities()
    expected, got = (drop_layer(0.5, p=0.4, seed=3) for _ in range(2))
    assert torch.equal(got.to(device)(opacities.to(device)).cpu(), expected(opacities))


def test_a_fit_learns_grows_and_repeats_bit_for_bit(device, scene, points, config):
    first, second = fitted(scene, points, config), fitted(scene, points, config)
    assert first.model.means.device.type == device.type
    assert len(first.model) > len(points.points)
    assert (
        first.state.curve[-1]["train_psnr"]
        > Trainer(scene, make_plan(scene, config, points), points).result().psnr(scene.train) + 1
    )
    assert_same_bits(first, second)


def test_a_fit_is_near_the_one_on_the_cpu(scene, points, config):
    here, there = (fitted(scene, points, x, 10) for x in (replace(CONFIG, device="cpu"), config))
    assert len(here.model) == len(there.model)
    assert abs(here.result().psnr(scene.test) - there.result().psnr(scene.test)) < 0.1


def test_a_fit_resumes_bit_for_bit_and_goes_to_the_cpu_and_back(device, scene, points, config, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    whole, half = fitted(scene, points, config), fitted(scene, points, config, 15)
    half.save(path)
    resumed = Trainer.resume(scene, config, path)
    resumed.fit()
    assert_same_bits(whole, resumed)
    for where in ("cpu", str(device)):
        other = Trainer.resume(scene, replace(CONFIG, device=where), path)
        other.train_step()
        other.save(path)
    assert other.step == 17
    assert_finite(other)


def test_coarse_steps(scene, points, config):
    assert_finite(fitted(scene, points, replace(config, coarse=0.5)))


def test_ply_files_go_between_devices(scene, points, config, tmp_path):
    trainer = fitted(scene, points, config, 5)
    kgs.save_ply(tmp_path / "splat.ply", trainer.model)
    again = kgs.load_ply(tmp_path / "splat.ply")
    assert torch.equal(again.means, trainer.model.means.detach().cpu())


def test_the_commands_fit_and_bench(device, folder, tmp_path, capsys):
    def run(words):
        with pytest.raises(SystemExit) as end:
            main([*words, "--device", str(device)])
        assert end.value.code in (0, None), capsys.readouterr().err

    out = tmp_path / "out"
    run(["fit", str(folder), "-o", str(out), "--steps", "20", "--init", "random", "--init-points", "300"])
    assert (out / "metrics.json").exists()
    run(["bench", "speed", "-o", str(tmp_path / "speed"), "--quick"])
    assert (tmp_path / "speed" / "speed.md").exists()

"""Loss, layer, densification, fits and commands on the device under test."""

from dataclasses import replace

import pytest
import torch
from factories import drop_layer, random_opacities

import kgs
from kgs.app.cli import main
from kgs.fit.config import FitConfig, Recipe
from kgs.fit.plan import make_plan
from kgs.fit.trainer import Trainer
from kgs.losses import photometric_loss, target_moments

CONFIG = FitConfig(steps=30, drop=0.3, seed=5, evaluations=3, recipe=Recipe(grad_threshold=1e-5))


@pytest.fixture
def config(device):
    return replace(CONFIG, device=str(device))


def fitted(scene, points, config, steps=None):
    trainer = Trainer(scene, make_plan(scene, config), points)
    trainer.fit(lambda trainer, _: trainer.step == steps)
    return trainer


def bits(trainer):
    return {name: value.detach().cpu() for name, value in trainer.model.named_parameters()}


@pytest.mark.parametrize("masked", [False, True])
def test_the_loss_and_its_gradient(device, there, masked):
    generator = torch.Generator().manual_seed(0)
    image, target = torch.rand(2, 3, 45, 67, generator=generator), torch.rand(2, 3, 45, 67, generator=generator)
    mask = torch.ones(45, 67, dtype=torch.bool)
    mask[5:9, 20:30] = not masked

    def both(move, fast, kind):
        leaf = move(image.to(kind)).requires_grad_()
        loss = photometric_loss(leaf, move(target.to(kind)), mask=move(mask), fast=fast)
        return loss.detach().cpu().double(), torch.autograd.grad(loss, leaf)[0].cpu().double()

    (loss, gradient), (expected, wanted) = both(there, True, torch.float32), both(lambda x: x, False, torch.float64)
    assert abs(loss - expected) <= 1e-6
    assert (gradient - wanted).abs().max() <= 1e-5 * wanted.abs().max()
    assert target_moments(there(target)).mean.device.type == device.type


def test_a_seeded_layer_drops_the_same_gaussians_as_on_the_cpu(device, there):
    opacities = random_opacities()
    expected, got = (drop_layer(0.5, p=0.4, seed=3) for _ in range(2))
    assert torch.equal(got.to(device)(there(opacities)).cpu(), expected(opacities))


def test_a_fit_learns_grows_and_repeats_bit_for_bit(device, scene, points, config):
    first, second = fitted(scene, points, config), fitted(scene, points, config)
    assert first.model.means.device.type == device.type
    assert len(first.model) > len(points.points)
    assert first.state.curve[-1]["train_psnr"] > Trainer(scene, make_plan(scene, config), points).psnr(scene.train) + 1
    assert all(torch.equal(value, bits(second)[name]) for name, value in bits(first).items())


def test_a_fit_is_near_the_one_on_the_cpu(device, scene, points, config):
    here, there = fitted(scene, points, replace(CONFIG, device="cpu"), 10), fitted(scene, points, config, 10)
    assert len(here.model) == len(there.model)
    assert abs(here.psnr(scene.test) - there.psnr(scene.test)) < 0.1


def test_a_fit_resumes_bit_for_bit_and_goes_to_the_cpu_and_back(device, scene, points, config, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    whole, half = fitted(scene, points, config), fitted(scene, points, config, 15)
    half.save(path)
    resumed = Trainer.resume(scene, config, path)
    resumed.fit()
    assert all(torch.equal(value, bits(resumed)[name]) for name, value in bits(whole).items())
    for where in ("cpu", str(device)):
        other = Trainer.resume(scene, replace(CONFIG, device=where), path)
        other.train_step()
        other.save(path)
    assert other.step == 17
    assert all(bool(value.isfinite().all()) for value in bits(other).values())


def test_coarse_steps(device, scene, points, config):
    done = fitted(scene, points, replace(config, coarse=0.5))
    assert all(bool(value.isfinite().all()) for value in bits(done).values())


def test_checkpoints_and_ply_go_between_devices(device, scene, points, config, tmp_path):
    trainer = fitted(scene, points, config, 5)
    kgs.save_ply(tmp_path / "splat.ply", trainer.model)
    again = kgs.load_ply(tmp_path / "splat.ply")
    assert torch.equal(again.means, trainer.model.means.detach().cpu())


def test_the_commands_fit_eval_and_render(device, folder, tmp_path, capsys):
    def run(words):
        with pytest.raises(SystemExit) as end:
            main(words)
        assert end.value.code in (0, None), capsys.readouterr().err

    out, options = str(tmp_path / "out"), ["--device", str(device)]
    run(["fit", str(folder), "-o", out, "--steps", "20", "--init", "random", "--init-points", "300", *options])
    assert (tmp_path / "out" / "metrics.json").exists()
    run(["bench", "speed", "-o", str(tmp_path / "speed"), "--quick", *options])
    assert (tmp_path / "speed" / "speed.md").exists()

"""The layer and kgs's call in other people's trainers: in the projects' own functions that render.

What docs/layer.md changes there is changed here. nerfstudio's file comes from its wheel; those of gsplat's examples
and of the paper's release from clones in the folder KGS_PEERS (gsplat, DropGaussian_release). CUDA is replaced, and
what else a function needs of its project.
"""

import ast
import json
import math
import os
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import tqdm
from factories import random_camera, random_gaussians
from kornia.metrics import ssim

import kgs

pytestmark = pytest.mark.slow

SIZE = (24, 32)  # height, width


def peer(*parts):
    """A file of a clone."""
    folder = os.environ.get("KGS_PEERS")
    if not folder or not (path := Path(folder, *parts)).exists():
        pytest.skip(f"there is no {'/'.join(parts)} in KGS_PEERS")
    return path.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def splatfacto(tmp_path_factory):
    """The file of nerfstudio's wheel; nothing of it is installed."""
    folder = tmp_path_factory.mktemp("wheel")
    load = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "-d", folder, "nerfstudio==1.1.5"]
    if subprocess.run(load, check=False, capture_output=True).returncode:
        pytest.skip("there is no nerfstudio 1.1.5 to download")
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as wheel:
        return wheel.read("nerfstudio/models/splatfacto.py").decode()


def function(source, name, changes, names):
    """A function of a file, after some of its lines were replaced; each must be there once."""
    found = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef) and node.name == name]
    assert len(found) == 1
    lines = source.splitlines()[found[0].lineno - 1 : found[0].end_lineno]
    indent = len(lines[0]) - len(lines[0].lstrip())
    text = "\n".join(line[indent:] for line in lines)
    for old, new in changes.items():
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    text = text.replace('device="cuda"', 'device="cpu"')
    namespace = {"torch": torch, "math": math, "Any": Any, **names}
    exec(compile(f"from __future__ import annotations\n{text}", name, "exec"), namespace)
    return namespace[name]


def scene():
    """Gaussians as trainers hold them, and a camera as gsplat has it."""
    gaussians = random_gaussians(60, 0, torch.float32, 1, 32)
    camera = random_camera(*SIZE, 0, torch.float32)
    k = camera.intrinsics[:, :3, :3].clone()
    k[:, :2, 2] += 0.5
    return gaussians, camera, k


def as_is(gaussians, camera, k, **options):
    """What the trainers should draw without the layer."""
    given = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors)
    return kgs.rasterization(*given, camera.extrinsics, k, SIZE[1], SIZE[0], sh_degree=1, **options)[0]


def check_drops(draw, drop, expected):
    """All Gaussians in eval(), fewer in train(), at the rate of the progress."""
    drop.eval()
    assert torch.allclose(draw(), expected, atol=1e-5)
    drop.train()
    drop.progress = 1.0
    assert drop.rate == 0.2
    assert (draw() - expected).abs().max() > 0.01
    drop.eval()
    assert torch.allclose(draw(), expected, atol=1e-5)


STEPS = 150


def trainer(tmp_path):
    """gsplat's Runner for three photos of random Gaussians: what its __init__ makes, with the layer in it."""
    strategies = pytest.importorskip("gsplat.strategy")
    strategy = strategies.DefaultStrategy(absgrad=True, refine_start_iter=10, refine_stop_iter=40, refine_every=20)
    source = peer("gsplat", "examples", "simple_trainer.py")
    names = {"rasterization": kgs.rasterization, "DefaultStrategy": strategies.DefaultStrategy}
    activate = 'opacities = torch.sigmoid(self.splats["opacities"])  # [N,]\n'
    own = {activate: f"{activate}    opacities = self.drop(opacities)\n"}
    rasterize_splats = function(source, "rasterize_splats", own, names)
    names |= {"F": torch.nn.functional, "json": json, "time": time, "tqdm": tqdm}
    names["yaml"] = SimpleNamespace(dump=lambda values, file: None)
    names["fused_ssim"] = lambda image, photo, padding: ssim(image, photo, 11, padding=padding).mean()
    before, after = "        # forward\n", "        if renders.shape[-1] == 4:\n"
    own = {before: f"        self.drop.progress = (step + 1) / max_steps\n        self.drop.train()\n{before}"}
    own |= {after: f"        self.drop.eval()\n{after}"}
    train = function(source, "train", own, names)

    gaussians, camera, k = scene()
    splats = {"means": gaussians.means, "quats": gaussians.quats, "scales": gaussians.scales.log()}
    splats |= {"opacities": gaussians.opacities.logit(), "sh0": gaussians.colors[:, :1], "shN": gaussians.colors[:, 1:]}
    splats = torch.nn.ParameterDict({name: value.clone() for name, value in splats.items()})
    off = "app_opt packed sparse_grad visible_adam with_ut with_eval3d antialiased random_bkgd depth_loss pose_opt"
    off += " pose_noise save_ply opacity_reg scale_reg tb_every"
    config = dict.fromkeys(off.split(), False) | dict.fromkeys(("post_processing", "compression"))
    config |= {"camera_model": "pinhole", "near_plane": 0.01, "far_plane": 1e10, "disable_viewer": True}
    config |= {"sh_degree": 1, "sh_degree_interval": 20, "ssim_lambda": 0.2, "strategy": strategy}
    config |= {"max_steps": STEPS, "batch_size": 1, "result_dir": tmp_path}
    config |= {"eval_steps": [STEPS // 2], "save_steps": [], "ply_steps": []}
    fields = {"splats": splats, "cfg": SimpleNamespace(**config), "device": "cpu", "world_rank": 0, "world_size": 1}
    fields |= {"stats_dir": tmp_path, "ckpt_dir": tmp_path, "post_processing_module": None}
    fields |= dict.fromkeys(("pose_optimizers", "app_optimizers", "post_processing_optimizers"), ())
    fields |= {"strategy_state": strategy.initialize_state(scene_scale=1.0), "render_traj": lambda step: None}
    runner = SimpleNamespace(**fields, drop=kgs.DropGaussian(p=0.2, seed=0).eval())
    runner.rasterize_splats = lambda *args, **options: rasterize_splats(runner, *args, **options)
    runner.train = lambda: train(runner)
    runner.optimizers = {name: torch.optim.Adam([value], lr=0.01) for name, value in splats.items()}
    return runner, (gaussians, camera, k)


def test_gsplats_simple_trainer_trains(tmp_path, monkeypatch):
    loader = torch.utils.data.DataLoader
    monkeypatch.setattr(torch.utils.data, "DataLoader", lambda views, shuffle, **_: loader(views, shuffle=shuffle))
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: None)
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda: 0)
    torch.manual_seed(0)
    runner, (gaussians, camera, k) = trainer(tmp_path)
    runner.trainset = []
    for i, shift in enumerate((-0.1, 0.0, 0.1)):
        pose = camera.extrinsics[0].inverse()
        pose[0, 3] += shift
        moved = SimpleNamespace(extrinsics=pose.inverse()[None])
        view = {"camtoworld": pose, "K": k[0], "image": 255 * as_is(gaussians, moved, k)[0]}
        runner.trainset.append(view | {"image_id": i, "camera_idx": 0})
    photo, pose = runner.trainset[1]["image"] / 255, runner.trainset[1]["camtoworld"]
    with torch.no_grad():
        runner.splats["sh0"].add_(torch.randn_like(runner.splats["sh0"]))

    def error():
        with torch.no_grad():
            image = runner.rasterize_splats(pose[None], k, SIZE[1], SIZE[0], sh_degree=1)[0][0]
        return torch.nn.functional.mse_loss(image, photo).item()

    evaluated = []
    runner.eval = lambda step: evaluated.append((step, runner.drop.training, runner.drop.rate))
    before = error()
    runner.train()
    assert error() < before / 4
    assert len(runner.splats["means"]) != 60
    assert evaluated == [(STEPS // 2 - 1, False, pytest.approx(0.1))]
    assert (tmp_path / f"ckpt_{STEPS - 1}_rank0.pt").exists()
    assert runner.drop.rate == pytest.approx(0.2)


class Tensor(torch.Tensor):
    """On the CPU, whatever is asked for."""

    def cuda(self):
        return self.as_subclass(torch.Tensor)


def test_splatfacto(splatfacto):
    call = "opacities=torch.sigmoid(opacities_crop).squeeze(-1),"
    own = {call: "opacities=self.drop(torch.sigmoid(opacities_crop).squeeze(-1)),"}
    assert "def populate_modules(self):" in splatfacto
    start = "self.step = step\n"
    own_step = {start: f"{start}    self.drop.progress = min(1.0, step / 30_000)\n"}
    step_cb = function(splatfacto, "step_cb", own_step, {})
    names = {"rasterization": kgs.rasterization, "get_viewmat": lambda pose: pose, "Cameras": SimpleNamespace}
    names |= dict.fromkeys(("Dict", "List", "Union"), dict)
    get_outputs = function(splatfacto, "get_outputs", own, names)
    gaussians, camera, k = scene()
    drop = kgs.DropGaussian(p=0.2)
    strategy = pytest.importorskip("gsplat.strategy").DefaultStrategy(absgrad=True)
    config = SimpleNamespace(rasterize_mode="classic", output_depth_during_training=True)
    config.sh_degree, config.sh_degree_interval, config.use_bilateral_grid = 1, 1000, False
    fields = {"means": gaussians.means, "quats": gaussians.quats, "scales": gaussians.scales.log()}
    fields |= {"opacities": gaussians.opacities.logit()[:, None], "features_dc": gaussians.colors[:, 0]}
    fields |= {"features_rest": gaussians.colors[:, 1:], "drop": drop, "strategy": strategy, "config": config}
    model = SimpleNamespace(**fields, training=False, crop_box=None, step=5000, device="cpu")
    model._get_downscale_factor = lambda: 1
    model._get_background_color = lambda: torch.zeros(3)
    view = SimpleNamespace(
        camera_to_worlds=camera.extrinsics, width=torch.tensor(SIZE[1]), height=torch.tensor(SIZE[0])
    )
    view.get_intrinsics_matrices = lambda: k.as_subclass(Tensor)
    view.rescale_output_resolution = lambda factor: None
    expected = as_is(gaussians, camera, k)[0].clamp(0, 1)
    check_drops(lambda: get_outputs(model, view)["rgb"], drop, expected)
    depth = as_is(gaussians, camera, k, render_mode="RGB+ED")[0, ..., 3:]
    assert torch.allclose(get_outputs(model, view)["depth"], depth, atol=1e-4)
    assert model.info["means2d"].shape == (1, 60, 2)
    step_cb(model, SimpleNamespace(optimizers={}), 15_000)
    assert drop.progress == 0.5

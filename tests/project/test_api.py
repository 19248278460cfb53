"""The public surface: what there is, and what it is called."""

import dataclasses
import importlib
import importlib.util
import inspect
import math
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import kgs

ROOT = Path(__file__).parents[2]
# to remove or rename a name, edit this list and the changelog in the same change
INVENTORY = {
    "kgs": """
        ArgumentError DataError Densifier DensifyReport DropGaussian GaussianModel GaussianRenderer Gaussians
        PosedCamera ProjectedGaussians Rendering RasterOptions TrainingDiverged camera_extent pinhole_cameras
        cameras composite drop_gaussian load_ply project rasterization save_compressed_ply save_ply wait_passively
    """,
    "kgs.losses": "TargetMoments photometric_loss target_moments",
    "kgs.datasets": "Scene Views load_scene synthetic_scene",
    "kgs.fit": """
        Fit FitConfig Hooks InitialPoints Plan Trainer choose_points fit_scene initial_points make_plan measure prune
    """,
    "kgs.reference": "Layers layers render",
}


@pytest.mark.parametrize("module", INVENTORY)
def test_inventory(module):
    assert sorted(importlib.import_module(module).__all__) == sorted(INVENTORY[module].split())


@pytest.mark.parametrize("package", ["kgs", "kgs.losses", "kgs.datasets", "kgs.fit"])
def test_no_public_name_is_that_of_a_module(package):
    """Whoever imported the module would put it in the place of the name."""
    module = importlib.import_module(package)
    names = [name for name in module.__all__ if not inspect.ismodule(getattr(module, name))]
    assert not [name for name in names if importlib.util.find_spec(f"{package}.{name}")]


LAZY = """
import sys
import kgs
assert "torch" not in sys.modules
assert set(kgs.__all__) <= set(dir(kgs))
assert not hasattr(kgs, "nonsense")
import kgs.datasets, kgs.fit, kgs.app.sfm
assert all(set(package.__all__) <= set(dir(package)) for package in (kgs.datasets, kgs.fit, kgs.app.sfm))
assert not hasattr(kgs.fit, "nonsense")
assert "torch" not in sys.modules
"""


def test_names_are_loaded_when_they_are_asked_for():
    subprocess.run([sys.executable, "-c", LAZY], cwd=ROOT, check=True)


def test_a_name_is_the_thing_itself():
    """Wherever it is imported from, and after pickling."""
    assert kgs.rasterization is importlib.import_module("kgs.gsplat").rasterization
    cloud = kgs.Gaussians(torch.zeros(1, 3), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1), torch.ones(1, 3))
    assert torch.equal(pickle.loads(pickle.dumps(cloud)).quats, cloud.quats)
    assert pickle.loads(pickle.dumps(kgs.GaussianRenderer)) is kgs.GaussianRenderer


# name -> its first parameters in order, with their defaults. What README and notebooks rely on
SIGNATURES = {
    "kgs.DropGaussian": "p=0.2, schedule='linear', seed=None, device='cpu', scale=True",
    "kgs.drop_gaussian": "opacities, p=0.2, training=True, generator=None, scale=True",
    "kgs.GaussianRenderer": "opacity_layer=None, options=None, backend='auto'",
    "kgs.GaussianRenderer.forward": "self, gaussians, cameras, background=None, outputs=('image',)",
    "kgs.RasterOptions": """
        tile_size=None, near_plane=0.01, eps2d=0.3, alpha_threshold=1 / 255, transmittance_stop=1e-4, max_bytes=None,
        frame=None, absgrad=False, far_plane=math.inf, radius_clip=0.0, antialiased=False
    """,
    "kgs.GaussianModel.from_points": "points, colors, sh_degree=3",
    "kgs.Gaussians": "means, quats, scales, opacities, colors",
    "kgs.PosedCamera": "model, extrinsics",
    "kgs.save_ply": "path, model",
    "kgs.save_compressed_ply": "path, model",
    "kgs.load_ply": "path",
    "kgs.losses.photometric_loss": "image, target, dssim_weight=0.2",
    "kgs.datasets.load_scene": "path, train_views=None, downscale=None",
    "kgs.fit.make_plan": "scene, config, points",
    "kgs.fit.Trainer": "scene, plan, points",
    "kgs.fit.Trainer.fit": "self, callback=None",
    "kgs.fit.Trainer.resume": "scene, config, path",
    "kgs.fit.choose_points": "scene, config",
    "kgs.fit.fit_scene": "scene, config=None",
    "kgs.fit.measure": "fit, lpips=None",
    "kgs.reference.render": """
        gaussians, camera, background=None, alpha_threshold=1 / 255, transmittance_stop=1e-4, near_plane=0.01, eps2d=0.3
    """,
}


@pytest.mark.parametrize("name", SIGNATURES)
def test_signatures(name):
    module = max((m for m in INVENTORY if name.startswith(m + ".")), key=len)
    value = importlib.import_module(module)
    for part in name[len(module) + 1 :].split("."):
        value = getattr(value, part)
    found = inspect.signature(value).parameters
    expected = inspect.signature(eval(f"(lambda {SIGNATURES[name]}: None)")).parameters
    assert list(found)[: len(expected)] == list(expected)
    assert {key: found[key].default for key in expected} == {key: p.default for key, p in expected.items()}
    # what comes after may be left out; `fields` are those of RasterOptions, by name
    later = [found[key] for key in list(found)[len(expected) :] if key != "fields"]
    assert inspect.Parameter.empty not in [parameter.default for parameter in later]


def test_the_values_that_flow_are_frozen():
    for name in ("Gaussians", "PosedCamera", "ProjectedGaussians", "Rendering"):
        made = getattr(kgs, name)
        assert dataclasses.is_dataclass(made)
        assert made.__dataclass_params__.frozen
    assert {"image", "alpha", "depth", "projected"} <= {field.name for field in dataclasses.fields(kgs.Rendering)}
    assert math.isclose(kgs.GaussianRenderer().options.alpha_threshold, 1 / 255)

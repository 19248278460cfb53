"""What runs with the required packages alone, and what is said where more are needed."""

import subprocess
import sys
from importlib.metadata import PackageNotFoundError

import pytest
import torch

from kgs._support.extras import check_opencv
from kgs.geometry.spacing import log_spacing

REQUIRED_ALONE = """
import sys

class Missing:
    def find_spec(name, path=None, target=None):
        if name.partition(".")[0] in OPTIONAL:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

OPTIONAL = ("cv2", "PIL", "trimesh", "scipy", "safetensors", "tqdm", "tyro", "matplotlib", "jinja2")
sys.meta_path.insert(0, Missing)

import kgs, torch, kgs.datasets, kgs.losses, kgs.reference
for name in kgs.__all__:
    getattr(kgs, name)
points = torch.rand(50, 3) + torch.tensor([-0.5, -0.5, 2.0])
model = kgs.GaussianModel.from_points(points, torch.rand(50, 3), sh_degree=1)
camera = kgs.pinhole_cameras(torch.eye(4)[None], torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), 16, 16)
image = kgs.GaussianRenderer(kgs.DropGaussian())(model(), camera).image
kgs.losses.photometric_loss(image, torch.rand(1, 3, 16, 16)).backward()
assert model.means.grad.abs().sum() > 0
for load in (lambda: kgs.datasets.load_scene, lambda: kgs.datasets.synthetic_scene):
    try:
        load()
    except ModuleNotFoundError as error:
        print(error)
"""


def test_layer_renderer_and_model_need_the_required_packages_alone():
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", REQUIRED_ALONE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 2
    assert all('"kgs-splat[scenes]"' in line for line in lines), lines


@pytest.mark.parametrize("copies", [1, 3, 5])
def test_spacings_without_opencv_are_those_with_it(monkeypatch, copies):
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(0)).repeat(copies, 1)
    expected = log_spacing(points)
    monkeypatch.setitem(sys.modules, "cv2", None)
    monkeypatch.setattr("kgs.geometry.spacing._MAX_DISTANCES", 7000)  # several blocks
    torch.testing.assert_close(log_spacing(points), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("installed", [["opencv-python"], ["opencv-python", "opencv-contrib-python-headless"]])
def test_two_packages_of_opencv_are_named(monkeypatch, recwarn, installed):
    def version(name):
        if name not in installed:
            raise PackageNotFoundError
        return "4.12"

    monkeypatch.setattr("importlib.metadata.version", version)
    check_opencv()
    said = " ".join(str(each.message) for each in recwarn)
    assert all(name in said for name in installed) == (len(installed) > 1)

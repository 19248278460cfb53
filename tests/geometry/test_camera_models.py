"""The lens models that kgs takes from `kornia.sensors`, which promises nothing: their conventions by OpenCV."""

import cv2
import numpy as np
import pytest
import torch
from factories import LENS_PARAMS
from kornia.sensors.camera import CameraModelType

from kgs.geometry.camera_models import camera_model, lens_of, project

LENSES = {
    "pinhole": CameraModelType.PINHOLE,
    "orthographic": CameraModelType.ORTHOGRAPHIC,
    "brown_conrady": CameraModelType.BROWN_CONRADY,
    "kannala_brandt": CameraModelType.KANNALA_BRANDT_K3,
}
SIZE = (48, 64)


def points():
    values = torch.rand(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return values * torch.tensor([1.0, 1.0, 2.0]) + torch.tensor([-0.5, -0.5, 1.0])


def by_opencv(lens, params, at):
    """OpenCV's pixels, whose coefficients have Kornia's order: k1, k2, p1, p2, k3 to k6; k1 to k4 of a fisheye."""
    fx, fy, cx, cy = params[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    coefficients = np.array(params[4:])
    if lens == "orthographic":  # OpenCV has none: x and y times the focal lengths
        return at[:, :2] * (fx, fy) + (cx, cy)
    if lens == "kannala_brandt":
        return cv2.fisheye.projectPoints(at[:, None], np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]
    return cv2.projectPoints(at, np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]


@pytest.mark.parametrize("lens", LENSES)
def test_convention_lens_models_are_opencvs(lens):
    params = LENS_PARAMS[LENSES[lens]]
    model = camera_model(lens, torch.tensor(params, dtype=torch.float64), SIZE)
    assert lens_of(model) == lens
    assert (int(model.height), int(model.width)) == SIZE
    pixels = project(model, model.params, points())
    np.testing.assert_allclose(pixels.numpy(), by_opencv(lens, params, points().numpy()), rtol=0, atol=1e-9)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("name", ["distortion", "projection", "params", "height", "width", "project"])
def test_a_model_of_kornia_has_what_kgs_reads(lens, name):
    """Where a new version of Kornia takes something away, the name of this test says what."""
    assert hasattr(camera_model(lens, torch.tensor(LENS_PARAMS[LENSES[lens]]), SIZE), name)

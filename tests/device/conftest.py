"""The device that these tests run on: CUDA (`pytest -m cuda`), and with `-m slow` the CPU, to try the tests."""

import pytest
import torch
from factories import FIELDS

from kgs import Gaussians, PosedCamera
from kgs.camera import move_camera

NO_CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


@pytest.fixture(
    params=[pytest.param("cuda", marks=[pytest.mark.cuda, NO_CUDA]), pytest.param("cpu", marks=pytest.mark.slow)]
)
def device(request):
    """Where the test runs."""
    return torch.device(request.param)


@pytest.fixture
def there(device):
    """Moves Gaussians, cameras or tensors to that device, leaves of their own."""

    def move(value):
        if isinstance(value, Gaussians):
            return Gaussians(*(move(getattr(value, name)) for name in FIELDS))
        if isinstance(value, PosedCamera):
            value.model.params = value.model.params.to(device)
            return PosedCamera(value.model, value.extrinsics.to(device))
        return value.detach().to(device) if isinstance(value, torch.Tensor) else move_camera(value, device)

    return move

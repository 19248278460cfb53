"""The camera of a photo that a fit has not seen, found against the fit: compared with the true one."""

from dataclasses import replace

import pytest
import torch
from kornia.geometry.conversions import rotation_matrix_to_axis_angle

from kgs.datasets import synthetic_scene
from kgs.fit.config import FitConfig
from kgs.fit.run import choose_points
from kgs.fit.trainer import Trainer
from kgs.geometry import camera_centers
from kgs.sfm.locate import locate


@pytest.fixture(scope="module")
def trainer():
    scene = synthetic_scene(train_views=3, test_views=1, size=(96, 128))
    config = FitConfig(steps=60, sh_degree=0, evaluations=1, init_points=3000)
    trainer = Trainer(scene, config, choose_points(scene, config))
    trainer.fit()
    return trainer


def test_a_camera_is_found_where_it_was(trainer):
    scene = trainer.scene
    elsewhere = replace(scene.test, cameras=scene.train.camera(0))  # the pose that is given is not looked at
    camera = locate(trainer, elsewhere)
    turn = camera.extrinsics[:, :3, :3] @ scene.test.cameras.extrinsics[:, :3, :3].mT
    assert float(rotation_matrix_to_axis_angle(turn).norm().rad2deg()) < 0.5
    centers = camera_centers(scene.train.cameras.extrinsics)
    apart = float((camera_centers(camera.extrinsics) - camera_centers(scene.test.cameras.extrinsics)).norm())
    assert apart < 0.05 * float((centers[0] - centers[-1]).norm())
    again = locate(trainer, elsewhere)
    assert torch.equal(camera.extrinsics, again.extrinsics)


def test_a_photo_of_something_else_has_no_place(trainer):
    noise = torch.rand(trainer.scene.test.images.shape, generator=torch.Generator().manual_seed(0))
    assert locate(trainer, replace(trainer.scene.test, images=noise)) is None
    assert locate(trainer, replace(trainer.scene.test, images=torch.zeros_like(noise))) is None

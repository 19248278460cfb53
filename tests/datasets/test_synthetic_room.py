"""The synthetic room: exact depths, cameras that fit the pictures, light that falls as it should, one room a seed."""

import numpy as np
import pytest
import torch
import trimesh
from kornia.geometry.depth import depth_to_3d_v2

from kgs.datasets.synthetic import room, synthetic_depths, synthetic_scene, views_beyond, world
from kgs.datasets.synthetic.furniture import Part, plain, printed
from kgs.datasets.synthetic.light import daylight, received
from kgs.datasets.synthetic.pictures import blank
from kgs.datasets.synthetic.raycast import raycast
from kgs.geometry.rigs import camera_centers

SIZE = (84, 112)


@pytest.fixture(scope="module")
def made():
    return room.make_room(0)


@pytest.fixture(scope="module")
def scene():
    return synthetic_scene(3, 5, SIZE)


@pytest.fixture(scope="module")
def depths(scene):
    return synthetic_depths(scene.train.cameras)


@pytest.mark.slow
def test_photos_are_neither_dark_nor_burnt_out(scene):
    assert scene.train.images.shape == (3, 3, *SIZE)
    assert scene.test.images.shape == (5, 3, *SIZE)
    for images in (scene.train.images, scene.test.images):
        assert images.min() >= 0.0
        assert images.max() <= 1.0
        assert (images == 1.0).float().mean() < 0.05
        assert 0.35 < images.mean() < 0.7
        assert images.std() > 0.15


def test_test_cameras_lie_between_the_training_cameras_and_outside(scene):
    train, test = (torch.linalg.inv(v.cameras.extrinsics.double())[:, :3, 3] for v in (scene.train, scene.test))
    assert torch.cdist(train, test).min() > 0.02
    low, high = train.amin(0)[:2], train.amax(0)[:2]
    inside = ((test[:, :2] > low) & (test[:, :2] < high)).all(dim=1)
    assert 1 <= inside.sum() < len(test)
    patch = torch.from_numpy(room.PATCH)
    assert ((test - torch.from_numpy(room.EYE)).abs() < 1.2 * patch).all()


def test_depths_of_the_wall_and_the_table_are_those_of_their_planes(scene, depths):
    """Points unprojected by Kornia lie on z = WALL and on the table's top, y = -TABLE."""
    for i in range(3):
        camera = scene.train.camera(i)
        points = depth_to_3d_v2(depths[i], camera.intrinsics[:, :3, :3].double())[0]
        motion = torch.linalg.inv(camera.extrinsics[0].double())
        points = points @ motion[:3, :3].T + motion[:3, 3]
        on_wall = (points[..., 2] - room.WALL).abs() < 1e-6
        on_table = (points[..., 1] + room.TABLE).abs() < 1e-6
        assert on_wall.double().mean() > 0.15
        assert on_table.double().mean() > 0.03
        assert (points[..., 2] < room.WALL + 1e-6).all()
        assert (points[..., 1] < 1e-6).all()  # nothing is under the floor


def test_a_point_has_its_colour_where_the_camera_projects_it(made, scene, depths):
    """Points spread over all triangles, projected by Kornia's camera, in each photo that sees them."""
    mesh = trimesh.Trimesh(made.triangles.reshape(-1, 3), np.arange(3 * len(made.triangles)).reshape(-1, 3))
    weights = mesh.area_faces * (np.linalg.norm(mesh.triangles_center - room.CENTER, axis=1) < 1.5)
    points, faces = trimesh.sample.sample_surface(mesh, 4000, face_weight=weights, seed=0)
    colors, points = torch.from_numpy(made.shade(points, faces)), torch.from_numpy(points).float()
    for i in range(3):
        camera = scene.train.camera(i)
        z = (points @ camera.rotation_matrix[0].T + camera.translation_vector[0, :, 0])[:, 2]
        u, v = camera.project(points).round().long().T
        visible = (u >= 0) & (v >= 0) & (u < SIZE[1] - 3) & (v < SIZE[0])
        visible &= (depths[i, 0][v.clamp(0, SIZE[0] - 1), u.clamp(0, SIZE[1] - 1)] - z).abs() < 0.01
        photo = scene.train.images[i]
        there, beside = (photo[:, v[visible], x[visible]].T - colors[visible] for x in (u, u + 3))
        assert visible.sum() > 800
        assert there.abs().mean(dim=1).median() < 0.015
        assert there.abs().mean() < 0.6 * beside.abs().mean()  # the same three pixels beside the truth


def test_normals_are_smooth_over_a_ball_and_sharp_at_an_edge():
    ball, brick = trimesh.creation.icosphere(subdivisions=3), trimesh.creation.box((1.0, 2.0, 3.0))
    np.testing.assert_allclose(world._normals(ball), ball.triangles, atol=0.02)
    np.testing.assert_allclose(world._normals(brick), np.repeat(brick.face_normals[:, None], 3, axis=1), atol=1e-12)
    rng = np.random.default_rng(0)
    faces = rng.integers(len(ball.faces), size=200)
    part = Part(ball, plain((255, 255, 255)))
    made = world.make_world([], world.put([part], 0.0, 0.0), room.SUN, room.SKY)
    points = np.einsum("nk,nkd->nd", rng.dirichlet([1, 1, 1], size=200), made.triangles[faces])
    mixed = made._normals_at(points, faces)
    np.testing.assert_allclose(mixed, points / np.linalg.norm(points, axis=1, keepdims=True), atol=0.02)


def test_light_is_lamberts_and_a_screen_shades_what_is_behind_it():
    up = np.array([0.0, -1.0, 0.0])
    screen = trimesh.creation.box((1.0, 0.02, 1.0)).apply_translation([0.0, -0.5, 0.0])
    lights = daylight(np.asarray(screen.triangles), up, up)
    points = np.array([[0.0, 0.0, 0.0], [0.0, -0.52, 0.0], [3.0, 0.0, 0.0], [0.0, -0.52, 0.0]])
    normals = np.array([up, up, up, [1.0, 0.0, 0.0]])
    under, above, beside, upright = received(lights, points, normals)
    np.testing.assert_allclose(above, beside, rtol=1e-5)  # both see the whole sky
    np.testing.assert_allclose(above - 0.16, [1.24, 1.22, 1.18], rtol=0.02)  # the sun's colour and the sky's
    assert (under < 0.5 * above).all()
    assert (upright < 0.5 * above).all()  # half of the sky, none of the sun
    assert (upright > 0.16).all()


def test_a_picture_lies_upright_on_its_rectangle():
    picture = blank(0.2, 0.1, (0, 0, 0))
    picture[: len(picture) // 2] = 255, 0, 0
    picture[:, : picture.shape[1] // 2, 2] = 255
    paint = printed(picture, 0.2, 0.1)
    corners = np.array([[-0.09, 0, 0.04], [0.09, 0, 0.04], [-0.09, 0, -0.04], [0.09, 0, -0.04]], dtype=np.float32)
    np.testing.assert_allclose(paint(corners), [[1, 0, 1], [1, 0, 0], [0, 0, 1], [0, 0, 0]], atol=1e-6)


def test_a_room_is_hit_by_every_ray(made):
    """From the middle of the cameras, far wider than they look: no gap between floor and wall."""
    matrix = np.array([[40.0, 0, 39.5], [0, 40.0, 29.5], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, 3] = -room.EYE
    _, faces = raycast(made.triangles, matrix, pose, (60, 80))
    assert (faces >= 0).all()


@pytest.mark.slow
def test_cameras_before_the_room_lie_so_many_times_as_far_out():
    for out in (1.0, 2.5):
        centers = camera_centers(views_beyond(out, 4, (6, 8)).cameras.extrinsics).numpy()
        flat = (centers - room.EYE)[:, :2] / room.PATCH[:2]
        np.testing.assert_allclose(np.linalg.norm(flat, axis=1), out, rtol=1e-4)
        np.testing.assert_allclose(centers[:, 2], room.EYE[2], atol=1e-5)

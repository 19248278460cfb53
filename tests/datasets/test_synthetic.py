"""The synthetic scene against closed forms, against itself across views, and as OpenCV's SIFT sees it."""

import numpy as np
import pytest
import torch
import trimesh
from kornia.geometry.depth import depth_to_3d_v2, warp_frame_depth

from kgs.datasets.scene import Scene
from kgs.datasets.synthetic import room, synthetic_depths, synthetic_scene
from kgs.datasets.synthetic.furniture import printed
from kgs.datasets.synthetic.light import daylight, received
from kgs.datasets.synthetic.pictures import blank
from kgs.datasets.synthetic.raycast import CHUNK, _project, raycast

SMALL = (42, 56)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return synthetic_scene(size=(84, 112))


def test_fields_are_those_of_a_scene_without_first_points(scene):
    assert scene.train.images.shape == (3, 3, 84, 112)
    assert scene.test.images.shape == (6, 3, 84, 112)
    assert scene.train.images.dtype == scene.train.cameras.extrinsics.dtype == torch.float32
    assert scene.train.names == ("train_00", "train_01", "train_02")
    assert scene.test.names[-1] == "test_05"
    assert scene.points.shape == (0, 3)
    assert scene.init_kind == "none"
    assert scene.offset.dtype == torch.float64
    assert not scene.offset.any()
    assert not scene.background.any()
    assert scene.train.images.min() >= 0.0
    assert scene.train.images.max() <= 1.0
    # integer pixel centres: a centred image has cx = (W - 1) / 2
    torch.testing.assert_close(scene.train.cameras.cx, torch.full((3,), 55.5))
    torch.testing.assert_close(scene.train.cameras.cy, torch.full((3,), 41.5))


@pytest.mark.slow
def test_same_seed_gives_the_same_bits_and_another_seed_another_scene():
    first, again, other = (synthetic_scene(2, 1, SMALL, seed) for seed in (0, 0, 1))
    for split in ("train", "test"):
        a, b, c = (getattr(x, split) for x in (first, again, other))
        assert torch.equal(a.images, b.images)
        assert torch.equal(a.cameras.extrinsics, b.cameras.extrinsics)
        assert (a.images - c.images).abs().mean() > 0.05
        assert not torch.equal(a.cameras.extrinsics, c.cameras.extrinsics)
    cameras = first.train.cameras
    assert not torch.equal(synthetic_depths(cameras, 1), synthetic_depths(cameras, 0))


def test_views_show_parallax_and_parts_that_other_views_do_not_see(scene):
    """Near and far things move differently by many pixels between neighbours, and some of the scene is hidden."""
    depths = synthetic_depths(scene.train.cameras)
    step = torch.linalg.norm(_centers(scene.train.cameras.extrinsics).diff(dim=0), dim=1).min()
    assert step * scene.train.cameras.fx[0] * (1 / depths.amin() - 1 / depths.amax()) > 0.09 * 112  # pixels
    _, seen, _ = _photo_error(scene.train, 0, scene.train, 1)
    assert 0.6 < seen.double().mean() < 0.95


@pytest.mark.parametrize(("source", "target"), [(0, 1), (1, 2), (2, 0)])
def test_views_agree_on_the_colour_of_the_surfaces_they_both_see(scene, source, target):
    """Kornia warps one view into the other by the true depth: pose, depth, intrinsics and images must fit together."""
    warped, seen, error = _photo_error(scene.train, source, scene.train, target)
    assert seen.double().mean() > 0.24
    assert error[seen].median() < 0.02
    # the same test a pixel beside the truth fails: it can see a wrong convention
    shifted = torch.roll(scene.train.images[target : target + 1], 1, dims=3)
    beside = (warped - shifted).abs().mean(dim=1, keepdim=True)
    assert error[seen].mean() < 0.6 * beside[seen].mean()


def test_raycast_closed_mesh_has_no_cracks_and_hides_what_is_behind():
    """From inside a finely divided ball every ray hits, also at pixels that lie exactly on edges."""
    ball = np.asarray(trimesh.creation.icosphere(subdivisions=4, radius=3.0).triangles)
    intrinsics, size = _pinhole(61, 81)
    depths, faces = raycast(ball, intrinsics, np.eye(4), size)
    assert (faces >= 0).all()
    np.testing.assert_allclose(depths * np.linalg.norm(_rays(intrinsics, size), axis=-1), 3.0, rtol=4e-3)
    screen = np.array([[[-9.0, -9.0, 2.0], [9.0, -9.0, 2.0], [0.0, 9.0, 2.0]]])
    depths, faces = raycast(np.concatenate([ball, screen]), intrinsics, np.eye(4), size)
    np.testing.assert_allclose(depths[faces == len(ball)], 2.0, rtol=1e-12)
    assert (faces == len(ball)).mean() > 0.4


def test_raycast_is_the_solution_of_each_pair_of_a_ray_and_a_triangle():
    """Large triangles, of which some reach behind the camera, and small ones, among which some occur twice."""
    rng = np.random.default_rng(0)
    intrinsics, size = _pinhole(120, 160)
    large = rng.normal(size=(6, 3, 3)) * [9.0, 9.0, 2.0] + [0.0, 0.0, 3.0]
    large[5] = [[-1.0, 1.0, 4.0], [1.0, 1.0, 4.0], [0.1, 1.0, -2.0]]  # a floor, from before the camera to behind it
    small = rng.normal(size=(80, 1, 3)) * [2.0, 2.0, 0.5] + [0.0, 0.0, 4.0] + 0.2 * rng.normal(size=(80, 3, 3))
    triangles = np.concatenate([large[:3], small, large[3:], small[:20]])
    counts = _project(triangles, intrinsics, np.eye(4), size).counts
    assert (counts > CHUNK).sum() >= 2
    assert (counts < CHUNK / 100).sum() > 60
    depths, faces = raycast(triangles, intrinsics, np.eye(4), size)
    weights = _rays(intrinsics, size) @ np.linalg.inv(triangles)[:, None]
    total = weights.sum(axis=-1)
    hit = (weights >= 0).all(axis=-1) & (total > 0)
    distances = np.where(hit, 1 / np.where(hit, total, 1.0), np.inf)
    nearest = distances.min(axis=0)
    np.testing.assert_allclose(np.where(faces < 0, np.inf, depths), nearest, rtol=1e-9)
    assert not depths[faces < 0].any()
    last = len(triangles) - 1 - np.argmin(distances[::-1], axis=0)
    np.testing.assert_array_equal(faces, np.where(np.isinf(nearest), -1, last))
    assert (faces >= 86).sum() > 100


def _photo_error(source, i, target, j):
    """View i of `source` warped into view j of `target`, where both see the surface, and the mean absolute error."""
    camera, other = target.camera(j), source.camera(i)
    depth = synthetic_depths(camera)
    matrix = camera.intrinsics[:, :3, :3].double()
    motion = other.extrinsics.double() @ torch.linalg.inv(camera.extrinsics.double())
    warped = warp_frame_depth(source.images[i : i + 1].double(), depth, motion, matrix)
    v, u = torch.meshgrid(torch.arange(depth.shape[2]), torch.arange(depth.shape[3]), indexing="ij")
    rays = torch.stack([u, v, torch.ones_like(u)], -1).double() @ torch.linalg.inv(matrix[0]).T
    points = (rays * depth[0, 0, ..., None]) @ motion[0, :3, :3].T + motion[0, :3, 3]
    grid = points @ matrix[0].T
    grid = grid[..., :2] / grid[..., 2:] / torch.tensor([depth.shape[3] - 1, depth.shape[2] - 1]) * 2 - 1
    # nearest, so that no value is mixed across the outline of an object
    there = torch.nn.functional.grid_sample(synthetic_depths(other), grid[None], mode="nearest", align_corners=True)
    seen = ((there[0, 0] - points[..., 2]).abs() < 0.05 * points[..., 2]) & (grid.abs() <= 1).all(-1)
    error = (warped - target.images[j : j + 1]).abs().mean(dim=1, keepdim=True)
    return warped, seen[None, None], error


def _centers(extrinsics):
    return torch.linalg.inv(extrinsics.double())[:, :3, 3]


def _pinhole(height, width):
    matrix = np.array([[0.9 * width, 0.0, (width - 1) / 2], [0.0, 0.9 * width, (height - 1) / 2], [0.0, 0.0, 1.0]])
    return matrix, (height, width)


def _rays(intrinsics, size):
    v, u = np.mgrid[: size[0], : size[1]]
    return np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(intrinsics).T


# -- room ------------------------------------------------------------------------------------------------------------


SIZE = (84, 112)


@pytest.fixture(scope="module")
def made():
    return room.make_room(0)


@pytest.fixture(scope="module")
def depths(scene):
    return synthetic_depths(scene.train.cameras)


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

"""First points: planes warped by homographies (the true depth is known), closed forms, OpenCV, and the real scenes."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from kornia.geometry.camera import PinholeCamera

from kgs.datasets.scene import Views
from kgs.errors import DataError
from kgs.fit.starts import FirstPoints, first_points, typical_depths
from kgs.fit.starts.tracks import Tracks, find_tracks
from kgs.fit.starts.triangulate import triangulate, triangulate_certain

WIDTH, HEIGHT = 240, 180
SMALL = (80, 60)
CENTERS = np.array([[-0.4, 0.0, 0.0], [0.0, 0.15, 0.1], [0.4, -0.1, 0.0]])
BACK, FRONT = (6.0, 0.3), (3.0, -0.2)  # planes z = depth + slope x
BACK_TINT, FRONT_TINT = (1.0, 0.5, 0.25), (0.25, 0.5, 1.0)


def cameras(centers: np.ndarray = CENTERS, turn: float = -0.05, size: tuple[int, int] = (WIDTH, HEIGHT)):
    """Cameras that look along z, each turned a little about y, with an off-centre principal point."""
    (width, height), count = size, len(centers)
    intrinsics, extrinsics = torch.eye(4).repeat(count, 1, 1), torch.eye(4).repeat(count, 1, 1)
    intrinsics[:, 0, 0] = intrinsics[:, 1, 1] = focal_length(width)
    intrinsics[:, 0, 2], intrinsics[:, 1, 2] = 0.51 * width, 0.49 * height
    for i, center in enumerate(centers):
        rotation = cv2.Rodrigues(np.array([0.0, turn * (i - (count - 1) / 2), 0.0]))[0]
        extrinsics[i, :3, :3] = torch.from_numpy(rotation)
        extrinsics[i, :3, 3] = torch.from_numpy(-rotation @ center)
    return PinholeCamera(intrinsics, extrinsics, torch.full((count,), height), torch.full((count,), width))


def focal_length(width: int) -> float:
    return 0.875 * width


def as_views(posed: PinholeCamera, images: torch.Tensor, masks: torch.Tensor | None = None) -> Views:
    return Views(posed, images, tuple(f"{i}.png" for i in range(len(images))), masks)


def texture(seed: int, tint: tuple[float, float, float], size: int = 900) -> np.ndarray:
    """Grey noise of several scales, in [0.1, 1], times a tint."""
    rng = np.random.default_rng(seed)
    noise = sum(
        s * cv2.GaussianBlur(rng.normal(size=(size, size)).astype(np.float32), (0, 0), s) for s in (2.5, 5.0, 10.0)
    )
    grey = 0.1 + 0.9 * np.clip(0.5 + noise / (5 * noise.std()), 0, 1)
    return grey[..., None] * np.array(tint, dtype=np.float32)


@pytest.fixture(scope="module")
def planes() -> Views:
    """A reddish plane across the images, and a bluish one before it over their upper left."""
    posed = cameras()
    images = np.zeros((3, HEIGHT, WIDTH, 3), dtype=np.float32)
    for (depth, slope), tint, seed, (left, top, side) in (
        (BACK, BACK_TINT, 1, (-6.0, -6.0, 12.0)),
        (FRONT, FRONT_TINT, 2, (-1.5, -1.2, 1.6)),
    ):
        painting = texture(seed, tint)
        step = side / len(painting)
        to_world = np.array([[step, 0, left], [0, step, top], [slope * step, 0, depth + slope * left]])
        for i in range(3):
            rotation, shift = posed.extrinsics[i, :3, :3].numpy(), posed.extrinsics[i, :3, 3].numpy()
            to_world_shifted = rotation @ to_world + shift[:, None] * np.array([[0, 0, 1]])
            homography = posed.intrinsics[i, :3, :3].numpy() @ to_world_shifted
            cv2.warpPerspective(
                painting,
                homography.astype(np.float64),
                (WIDTH, HEIGHT),
                dst=images[i],
                flags=cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_TRANSPARENT,
            )
    return as_views(posed, torch.from_numpy(images).permute(0, 3, 1, 2).contiguous())


@pytest.fixture(scope="module")
def found(planes: Views) -> FirstPoints:
    return first_points(planes, "sift")


def flat(posed: PinholeCamera | None = None) -> Views:
    """Images without a single feature."""
    posed = cameras(size=SMALL) if posed is None else posed
    return as_views(posed, torch.tensor([0.2, 0.4, 0.6])[:, None, None].repeat(posed.batch_size, 1, SMALL[1], SMALL[0]))


def depth_errors(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Relative distances along z to the nearer of the two planes, and whether that is the front one."""
    x, _, z = points.double().unbind(1)
    to_back, to_front = ((z / (depth + slope * x) - 1).abs() for depth, slope in (BACK, FRONT))
    return torch.minimum(to_back, to_front), to_front < to_back


def test_sift_points_lie_on_the_planes(found: FirstPoints) -> None:
    errors, front = depth_errors(found.points)
    assert found.kind == "sift"
    assert found.points.dtype == torch.float32
    assert found.points.shape == found.colors.shape
    assert min(int(front.sum()), int((~front).sum())) > 50
    assert float(errors.median()) < 0.005
    assert float((errors < 0.03).double().mean()) > 0.97


def test_sift_points_have_no_bias_in_depth(found: FirstPoints) -> None:
    x, _, z = found.points.double().unbind(1)
    for depth, slope in (BACK, FRONT):
        ratio = z / (depth + slope * x)
        assert abs(float(ratio[(ratio - 1).abs() < 0.03].median()) - 1) < 0.002


def test_sift_colors_are_those_of_the_planes(found: FirstPoints) -> None:
    _, front = depth_errors(found.points)
    for chosen, tint in ((front, FRONT_TINT), (~front, BACK_TINT)):
        shades = found.colors[chosen] / found.colors[chosen].sum(1, keepdim=True)
        expected = torch.tensor(tint) / sum(tint)
        assert float((shades - expected).abs().median()) < 0.005
    assert float(found.colors.std(0).min()) > 0.05


def test_the_same_bits_again_for_any_number_of_threads(planes: Views, found: FirstPoints) -> None:
    threads = torch.get_num_threads(), cv2.getNumThreads()
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            cv2.setNumThreads(count)
            again = first_points(planes, "sift", seed=count)
            assert torch.equal(again.points, found.points)
            assert torch.equal(again.colors, found.colors)
    finally:
        torch.set_num_threads(threads[0])
        cv2.setNumThreads(threads[1])


def test_masks_leave_out_keypoints(planes: Views) -> None:
    masks = torch.ones(3, 1, HEIGHT, WIDTH)
    masks[..., : WIDTH // 2] = 0
    tracks = find_tracks(as_views(planes.cameras, planes.images, masks))
    assert len(tracks.seen) > 30
    assert float(tracks.pixels[tracks.seen][:, 0].min()) > WIDTH // 2 - 1


def blobs(places: np.ndarray, scales: np.ndarray, size: tuple[int, int]) -> Views:
    """Gaussian blobs at known places as two cameras see them, the second moved along x by 8 pixels of disparity."""
    width, height = size
    ys, xs = np.mgrid[:height, :width]
    image = 0.1 + 0.3 * xs / width + 0.2 * ys / height  # the ramp gives the round blobs an orientation
    for (x, y), scale in zip(places, scales, strict=True):
        image += 0.3 * np.exp(-((xs - x) ** 2 + (ys - y) ** 2) / (2 * scale**2))
    images = torch.from_numpy(np.stack([image, np.roll(image, -8, axis=1)])).float()
    centers = np.array([[0.0, 0, 0], [8.0 / focal_length(width), 0, 0]])
    return as_views(cameras(centers, turn=0.0, size=size), images[:, None].repeat(1, 3, 1, 1))


@pytest.mark.parametrize("size", [(320, 240), (520, 400)], ids=["doubled", "as it is"])
def test_keypoints_have_integer_pixel_centres(size: tuple[int, int]) -> None:
    places = np.array([[70.0, 60.0], [131.25, 77.5], [200.0, 101.0], [90.6, 150.3], [180.0, 170.0]])
    tracks = find_tracks(blobs(places, np.array([3.0, 4.0, 5.0, 3.5, 6.0]), size))
    for view, offset in ((0, 0.0), (1, 8.0)):
        distances = torch.cdist(tracks.pixels[:, view] + torch.tensor([offset, 0.0]), torch.from_numpy(places))
        assert float(distances.amin(0).max()) < 0.08


def test_a_pattern_repeated_along_the_epipolar_lines_is_not_matched() -> None:
    pattern = texture(3, (1.0, 1.0, 1.0), size=320)[:240]
    posed = cameras(np.array([[0.0, 0, 0], [8.0 / focal_length(320), 0, 0]]), turn=0.0, size=(320, 240))
    counts = []
    for image in (pattern, np.tile(pattern[:, :64], (1, 5, 1))):
        pair = np.stack([image, np.roll(image, -8, axis=1)])
        tracks = find_tracks(as_views(posed, torch.from_numpy(pair).float().permute(0, 3, 1, 2)))
        counts.append(len(tracks.seen))
    assert counts[0] > 100
    assert counts[1] < 0.05 * counts[0]


def test_few_matches_fall_back_to_random_points_with_a_warning() -> None:
    with pytest.warns(UserWarning, match=r"SIFT found 0 in 3 training views.*500 random points"):
        result = first_points(flat(), "sift", count=500)
    assert result.kind == "random"
    assert result.points.shape == (500, 3)
    assert torch.allclose(result.colors, torch.tensor([0.2, 0.4, 0.6]).expand(500, 3), atol=1e-6)


def seeing_views(posed: PinholeCamera, points: torch.Tensor) -> torch.Tensor:
    """How many cameras see each point, by Kornia's own projection."""
    pixels = posed.project(points[None].expand(posed.batch_size, -1, -1))
    depths = (points @ posed.rotation_matrix.mT + posed.translation_vector.mT)[..., 2]
    limits = torch.stack([posed.width[0], posed.height[0]]) - 0.5
    return ((pixels > -0.5 - 1e-3) & (pixels < limits + 1e-3)).all(-1).logical_and(depths > 0).sum(0)


def test_random_points_are_seen_by_two_views_and_span_the_sift_depths(planes: Views, found: FirstPoints) -> None:
    result = first_points(planes, "random", count=2000)
    assert result.kind == "random"
    assert result.points.shape == result.colors.shape == (2000, 3)
    assert int(seeing_views(planes.cameras, result.points).min()) >= 2
    assert 0 <= float(result.colors.min()) <= float(result.colors.max()) <= 1
    depths, sift = result.points[:, 2], found.points[:, 2]
    assert 0.7 * float(sift.min()) < float(depths.min()) < float(depths.max()) < 1.6 * float(sift.max())


def test_random_points_depend_on_the_seed_alone() -> None:
    views = flat()
    first, again, other = (first_points(views, "random", seed=seed, count=300) for seed in (4, 4, 5))
    assert torch.equal(first.points, again.points)
    assert not torch.equal(first.points, other.points)


def test_random_points_fill_the_common_frustum_evenly() -> None:
    # Oracle: rejection from a box. Parallel cameras at x = 0, 1, 2, so the depths are 2 to 40 (1 and 20 baselines).
    posed = cameras(np.array([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]]), turn=0.0, size=SMALL)
    points = first_points(flat(posed), "random", count=20_000).points
    assert 2.0 <= float(points[:, 2].min()) < 5.0
    assert 39.0 < float(points[:, 2].max()) <= 40.0
    box = (torch.rand(400_000, 3, generator=torch.Generator().manual_seed(0)) - 0.5) * torch.tensor([60.0, 40.0, 38.0])
    box += torch.tensor([0.0, 0.0, 21.0])
    box = box[seeing_views(posed, box) >= 2]
    near, all_three = points[:, 2] < 20, seeing_views(posed, points) == 3
    assert float(near.double().mean()) == pytest.approx(float((box[:, 2] < 20).double().mean()), abs=0.01)
    expected = float((seeing_views(posed, box) == 3).double().mean())
    assert float(all_three.double().mean()) == pytest.approx(expected, abs=0.01)


def test_random_points_surround_the_place_where_orbiting_cameras_look() -> None:
    extrinsics = torch.eye(4).repeat(6, 1, 1)
    for i in range(6):
        extrinsics[i, :3, :3] = torch.from_numpy(cv2.Rodrigues(np.array([0.0, i * np.pi / 3, 0.0]))[0])
    target = torch.tensor([10.0, -3.0, 7.0])
    extrinsics[:, :3, 3] = torch.tensor([0.0, 0.0, 4.0]) - extrinsics[:, :3, :3] @ target
    sizes = torch.full((6,), SMALL[1]), torch.full((6,), SMALL[0])
    posed = PinholeCamera(cameras(size=SMALL).intrinsics[:1].repeat(6, 1, 1), extrinsics, *sizes)
    points = first_points(flat(posed), "random", count=2000).points
    assert float((points.mean(0) - target).norm()) < 0.5
    assert int(seeing_views(posed, points).min()) >= 2


@pytest.mark.parametrize("count", [1, 2])
def test_random_points_where_no_two_views_see_the_same(count: int) -> None:
    posed = cameras(np.zeros((count, 3)), turn=np.pi, size=SMALL)  # two cameras back to back
    points = first_points(flat(posed), "random", count=100).points
    assert points.shape == (100, 3)
    assert int(seeing_views(posed, points).min()) == 1


def test_file_with_colors(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    points, colors = rng.normal(size=(30, 3)).astype(np.float32), rng.integers(0, 256, (30, 4), dtype=np.uint8)
    trimesh.PointCloud(points, colors=colors).export(tmp_path / "cloud.ply")
    result = first_points(flat(), "file", file=tmp_path / "cloud.ply")
    assert result.kind == "file"
    assert result.points.dtype == result.colors.dtype == torch.float32
    np.testing.assert_array_equal(result.points.numpy(), points)
    np.testing.assert_allclose(result.colors.numpy(), colors[:, :3] / 255, atol=1e-6)


def test_file_without_colors_is_grey(tmp_path: Path) -> None:
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "cloud.ply")
    (tmp_path / "mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 2 0\nf 1 2 3\n")
    for name in ("cloud.ply", "mesh.obj"):
        result = first_points(flat(), "file", file=tmp_path / name)
        assert result.points.shape == (3, 3)
        assert torch.equal(result.colors, torch.full((3, 3), 0.5))


@pytest.mark.parametrize("content", [None, b"", b"ply\nformat ascii 1.0\nelement vertex 2\n", b"garbage"])
def test_broken_file(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "cloud.ply"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=r"cloud\.ply"):
        first_points(flat(), "file", file=path)


def test_file_with_a_point_that_is_not_finite(tmp_path: Path) -> None:
    trimesh.PointCloud(np.array([[0, 0, 1.0], [np.nan, 0, 0]])).export(tmp_path / "cloud.ply")
    with pytest.raises(DataError, match="finite"):
        first_points(flat(), "file", file=tmp_path / "cloud.ply")


def test_wrong_arguments() -> None:
    views = flat()
    with pytest.raises(ValueError, match=r"kind: expected one of \['dense', 'sift', 'random', 'file'\], got 'stereo'"):
        first_points(views, "stereo")
    with pytest.raises(ValueError, match="count: expected at least 1, got 0"):
        first_points(views, "random", count=0)
    with pytest.raises(ValueError, match="file: expected a path"):
        first_points(views, "file")


def test_typical_depths_are_the_first_percentile_and_the_median() -> None:
    views = flat(cameras(np.zeros((1, 3)), turn=0.0, size=SMALL))
    points = torch.zeros(101, 3)
    points[:, 2] = torch.arange(2.0, 103.0)
    assert typical_depths(views, points[torch.randperm(101)]) == pytest.approx((3.0, 52.0), rel=1e-6)
    behind_and_beside = torch.tensor([[0.0, 0.0, -5.0], [50.0, 0.0, 0.001]]).repeat(50, 1)
    assert typical_depths(views, torch.cat([points, behind_and_beside])) == pytest.approx((3.0, 52.0), rel=1e-6)


@pytest.mark.parametrize("points", [torch.zeros(0, 3), torch.tensor([[0.0, 0.0, -1.0]])])
def test_typical_depths_without_points_before_a_camera(points: torch.Tensor) -> None:
    assert typical_depths(flat(), points) == (1.0, 1.0)


def exact_tracks(points: torch.Tensor) -> Tracks:
    posed = cameras()
    pixels = posed.project(points.float()[None].expand(3, -1, -1)).transpose(0, 1)
    return Tracks(pixels.double(), torch.ones(len(points), 3, dtype=torch.bool))


def test_triangulation_agrees_with_opencv_for_two_views() -> None:
    posed, rng = cameras(), np.random.default_rng(0)
    pixels = rng.uniform(50, 200, (40, 3, 2))
    pixels[:, 2] = pixels[:, 0] + rng.uniform(-30, -10, (40, 1)) * [1, 0]
    seen = torch.tensor([True, False, True]).expand(40, 3)
    # OpenCV's equations in the same normalised coordinates: two rays that do not meet have no other common answer.
    inverse = np.linalg.inv(posed.intrinsics[0, :3, :3].double().numpy())
    rays = np.concatenate([pixels, np.ones((40, 3, 1))], -1) @ inverse.T
    projections = posed.extrinsics[:, :3].double().numpy()
    expected = cv2.triangulatePoints(projections[0], projections[2], rays[:, 0, :2].T, rays[:, 2, :2].T)
    expected = (expected[:3] / expected[3]).T
    points = triangulate(Tracks(torch.from_numpy(pixels), seen), posed).numpy()
    np.testing.assert_allclose(points, expected, rtol=0.02, atol=0.02)


def test_exact_tracks_give_exact_points() -> None:
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(1)) * 2 + torch.tensor([-1.0, -1.0, 3.0])
    recovered, kept = triangulate_certain(exact_tracks(points), cameras())
    assert bool(kept.seen.all())
    torch.testing.assert_close(recovered.float(), points, rtol=1e-4, atol=1e-4)


def test_a_moved_and_scaled_world_moves_and_scales_the_points() -> None:
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(1)) * 2 + torch.tensor([-1.0, -1.0, 3.0])
    posed, shift = cameras(), torch.tensor([3.0, -2.0, 5.0])
    extrinsics = posed.extrinsics.double()
    extrinsics[:, :3, 3] = 100 * (extrinsics[:, :3, 3] - extrinsics[:, :3, :3] @ shift.double())
    moved = PinholeCamera(posed.intrinsics.double(), extrinsics, posed.height, posed.width)
    tracks = exact_tracks(points)
    expected, _ = triangulate_certain(tracks, posed)
    found, kept = triangulate_certain(tracks, moved)
    assert bool(kept.seen.all())
    torch.testing.assert_close(found / 100 - shift, expected, rtol=1e-9, atol=1e-9)


def test_uncertain_points_go() -> None:
    # Fine; far away (0.1 degrees); fine but for one observation 3 px off; 40 px off; behind the cameras.
    points = torch.tensor([[0.0, 0, 4], [0.0, 0, 400], [0.2, 0.1, 4], [0.1, 0.2, 4], [0.0, 0.1, -4]])
    tracks = exact_tracks(points)
    tracks.pixels[2, 1, 1] += 3.0
    tracks.pixels[3, 1, 1] += 40.0
    recovered, kept = triangulate_certain(tracks, cameras())
    torch.testing.assert_close(recovered.float(), points[[0, 2]], rtol=1e-4, atol=1e-4)
    assert kept.seen.tolist() == [[True, True, True], [True, False, True]]


def test_a_point_without_neighbours_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    wall = torch.rand(80, 3, generator=torch.Generator().manual_seed(1)) * 2 + torch.tensor([-1.0, -1.0, 5.0])
    alone = torch.tensor([[0.2, 0.1, 3.2]])
    monkeypatch.setattr("kgs.fit.starts.find_tracks", lambda _: exact_tracks(torch.cat([wall, alone])))
    posed = cameras()
    found = first_points(as_views(posed, torch.rand(3, 3, HEIGHT, WIDTH)), "sift")
    assert found.kind == "sift"
    torch.testing.assert_close(found.points, wall, rtol=1e-4, atol=1e-4)


REAL = [
    ("llff/fern", 3, 391),
    pytest.param("llff/flower", 3, 1513, marks=pytest.mark.slow),
    pytest.param("colmap/trex", 3, 544, marks=pytest.mark.slow),
    pytest.param("llff/fern", 6, 742, marks=pytest.mark.slow),
    pytest.param("llff/flower", 6, 2394, marks=pytest.mark.slow),
    pytest.param("colmap/trex", 6, 1455, marks=pytest.mark.slow),
    pytest.param("llff/fern", 9, 1350, marks=pytest.mark.slow),
    pytest.param("llff/flower", 9, 4021, marks=pytest.mark.slow),
    pytest.param("colmap/trex", 9, 2109, marks=pytest.mark.slow),
    pytest.param("nerfstudio/fox", 12, 1957, marks=pytest.mark.slow),
    pytest.param("nerfstudio/fox", 24, 3731, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("name", "train_views", "expected"), REAL)
def test_real_scene_gives_enough_points(kgs_data: Path, name: str, train_views: int, expected: int) -> None:
    from kgs.datasets import load_scene

    views = load_scene(kgs_data / name, train_views=train_views).train
    assert len(first_points(views, "sift").points) >= 0.9 * expected


@pytest.mark.slow
@pytest.mark.parametrize(("name", "bound"), [("llff/fern", 0.02), ("llff/flower", 0.04), ("colmap/trex", 0.02)])
def test_real_points_agree_with_the_full_model(kgs_data: Path, name: str, bound: float) -> None:
    # Median relative difference in depth to the nearest projected point, within 2 px, of the model from all views.
    from kgs.datasets import load_scene

    scene = load_scene(kgs_data / name, train_views=3, points="model-points")
    differences = []
    for i in range(3):
        pixels, depths = [], []
        for points in (first_points(scene.train, "sift").points, scene.points):
            camera = scene.train.camera(i)
            local = points @ camera.rotation_matrix[0].T + camera.translation_vector[0, :, 0]
            pixels.append(camera.project(points[local[:, 2] > 0][None])[0])
            depths.append(local[local[:, 2] > 0, 2])
        distances, nearest = torch.cdist(*pixels).min(1)
        differences.append((depths[0] / depths[1][nearest] - 1).abs()[distances < 2])
    assert float(torch.cat(differences).median()) < bound

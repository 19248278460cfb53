"""`load_scene`: one function for all layouts, and the one place where a folder becomes a scene."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from os import PathLike
from pathlib import Path
from typing import Self

import kornia.geometry as kg
import numpy as np
import torch
from PIL.ExifTags import Base
from torch import Tensor

from kgs._support.default_device import on_cpu
from kgs._support.errors import ArgumentError, DataError, listed
from kgs.geometry.cameras import pinhole_cameras

from .border import with_border
from .depths import find_depths, read_depths, rectified, resized
from .folders import CAMERAS_REPORT
from .frames import LARGEST, SMALLEST, Frame, FrameSet
from .image_file import color_notes
from .images import rectification, remap, resize
from .masks import find_masks
from .options import BACKGROUNDS, check_options
from .scene import Scene, Views
from .source import SceneSource
from .splits import TEST_EVERY, select_evenly, split_between_ends, split_by_name

_BORDER = "the photos have a dark border, left by undistortion: it counts as part of the lens, not of the scene"
# A camera whose picture is turned by a quarter clockwise: its x axis is up before, its y axis to the right.
_CLOCKWISE = torch.tensor(
    [[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
    dtype=torch.float64,
    device="cpu",
)
_VALID = 0.99  # share of a pixel that a mask keeps, above which it counts
_SIDEWAYS = (5, 6, 7, 8)  # Exif's orientations of photos that a quarter turn makes upright
_FINE_PIXELS = 1_000_000  # of an image for the initial points: twice the width and height halves the error of depths


def load_scene(
    path: str | PathLike[str] | SceneSource,
    train_views: int | None = None,
    downscale: float | None = None,
    *,
    hold_out: int | None = None,
    background: str = "black",
    points: str = "none",
    photos: bool = True,
    photo_folder: str = "",
    masks: str | PathLike[str] | None = None,
    mask_mode: str = "ignore",
    depths: str | PathLike[str] | None = None,
) -> Scene:
    """Load a scene of posed photos, whatever layout it has.

    The layout follows from the files in the folder, in this order: `poses_bounds.npy` (LLFF), `sparse/0`, `sparse/1`
    and so on or `sparse` (COLMAP), `transforms_train.json` (Blender), `transforms.json` (nerfstudio, instant-ngp), a
    COLMAP model beside its photos or their folder `images`. Of several COLMAP models the one with most images is read.
    What the files say is used, refused, or, if it cannot change an image, named in `Scene.notes`; so are photos that a
    COLMAP model has and the folder lacks. Colours are converted to sRGB where a photo's file says that they are others.

    Convention:
        Kornia's in the result, see `Views`: world-to-camera extrinsics with OpenCV axes, integer pixel centres. The
        world is the files', moved by `Scene.offset` (the mean of the training cameras' centres), not scaled or turned.

    Args:
        path: the scene's folder, or that folder opened before.
        train_views: how many views to train on, spread evenly over those that are not held out; None takes all.
        downscale: factor by which the photos (of `images/`, else of the largest `images_k/`) are reduced, >= 1; None
            leaves them as they are.
        hold_out: N >= 2 holds out every Nth photo by name, the first included, whatever the files say; 0 none, and
            `Scene.test` is empty. None holds out the test views that the files name, or else every eighth photo. If
            kgs found the cameras (photos.json), the two photos at the ends of the row of cameras are for training.
        background: "black" or "white", the colour behind images with an alpha channel.
        points: "none", or "model-points" for the points of a COLMAP model that at least two training views observe.
            Their positions were refined with the test views too.
        photos: False reads only the sizes of the photos: cameras, names and sizes are the same, `images` have no pixels
            (they are on torch's "meta" device), `masks` and `train_full_size` are None.
        photo_folder: where a scene (LLFF, COLMAP) has its photos in several sizes, the name of the folder to take, as
            "images_8"; "": that of the largest, `images` first. See also :func:`kgs.datasets.field.field_size`.
        masks: a folder with masks of the photos, which have their stems or names; white is kept. None: the masks that
            the layout's files name, else those in `masks/`.
        mask_mode: what black in a mask means. "ignore": such pixels are ignored (somebody walked by), see
            `Views.valid_mask`. "transparent": nothing is there, as where an image is transparent.
        depths: a folder with depth maps of training photos, which have their stems or names (.npy; .png and .tif of one
            channel), see `Views.depths`; those of test photos are not read. None: there are none.

    Raises:
        DataError: the folder is not a scene, or its files are missing, damaged or contradict each other.
        ValueError: train_views, downscale, hold_out, background, points or mask_mode is out of range.

    Examples:
        >>> scene = load_scene("fern", train_views=3, downscale=2)  # doctest: +SKIP
        >>> scene.train.images.shape  # doctest: +SKIP
        torch.Size([3, 3, 189, 252])
        >>> images = [view["image"] for view in scene.train]  # doctest: +SKIP
        >>> cameras = load_scene("fern", photos=False).test.cameras  # decodes no photo  # doctest: +SKIP
    """
    check_options(downscale, hold_out, background, points, mask_mode)
    source = SceneSource.of(path)
    root = source.root
    with on_cpu():
        frame_set = _with_masks(root, source.frames(photo_folder), None if masks is None else Path(masks))
        train, test = _split(root, frame_set, train_views, hold_out)
        cloud = frame_set.points
        if points == "model-points":
            if frame_set.model_points is None:
                raise DataError(root, "points", "a COLMAP model for model-points", "none")
            cloud = frame_set.model_points(train)
        farthest = float(cloud.points.abs().max()) if len(cloud.points) else 0.0
        if not farthest <= LARGEST:
            raise DataError(root, "points", f"coordinates up to {LARGEST:g}", f"{farthest:g}")
        if missing := [frame.path for frame in (*train, *test) if not frame.path.is_file()]:
            names = listed([path.relative_to(root) for path in missing])
            count = len(train) + len(test)
            raise DataError(root, "", f"{count} images", count - len(missing), advice=f"there is no {names}")
        color = torch.tensor(BACKGROUNDS[background], dtype=torch.float32)
        centers = torch.stack([frame.pose[:3, 3] for frame in train])
        spread = float((centers.amax(0) - centers.amin(0)).max())
        if 0 < spread < SMALLEST:
            expected = f"cameras in one place, or at least {SMALLEST:g} apart"
            raise DataError(root, "poses", expected, f"{spread:.2g}", advice="scale poses and points up")
        offset = centers.mean(dim=0)  # float64; without the test views
        lying = [frame.intrinsics.width >= frame.intrinsics.height for frame in train]
        first = train[lying.index(2 * sum(lying) >= len(lying))]  # of the kind, upright or lying, that most are
        depth_notes = list[str]()
        if depths is not None and photos:
            train, depth_notes = _with_depths(train, frame_set, Path(depths))
        scales = [_Scale.of(first, downscale or 1.0)]
        height, width = scales[0].size
        fine_downscale = max(1.0, (downscale or 1.0) * math.sqrt(height * width / _FINE_PIXELS))
        if photos and downscale is not None and fine_downscale < downscale:
            scales.append(_Scale.of(first, fine_downscale))
        transparent = mask_mode == "transparent"
        make_views = partial(_views, offset=offset, background=color, photos=photos, transparent=transparent)
        train_per_scale = [with_border(views) for views in make_views(train, scales)]
        at_size = train_per_scale[0]
        (test_views,) = make_views(test, scales[:1])
        colors = color_notes([frame.image for frame in (*train, *test)])
        notes = (*frame_set.notes, *_mask_notes([*train, *test], at_size, transparent), *depth_notes, *colors)
        if at_size.border_mask is not None:
            notes += (_BORDER,)
        return Scene(
            train=at_size,
            test=replace(test_views, border_mask=at_size.border_mask),
            points=(cloud.points - offset).float(),
            point_colors=cloud.colors.float(),
            init_kind=cloud.kind,
            offset=offset,
            background=color,
            root=root,
            train_full_size=train_per_scale[1] if len(scales) > 1 else None,
            notes=notes,
        )


def _with_masks(root: Path, frame_set: FrameSet, folder: Path | None) -> FrameSet:
    """The frames with their masks: those in `folder`, else those that the files name, else those in `masks/`."""
    parts = [frame_set.frames, frame_set.test or ()]
    if folder is None and any(frame.mask for frames in parts for frame in frames):
        return frame_set
    photos = [frame.path for frames in parts for frame in frames]
    masks = find_masks(photos, root, folder)
    notes = (*frame_set.notes, *masks.notes(root))
    frames, test = ([replace(frame, mask=masks.of(frame.path)) for frame in frames] for frames in parts)
    return replace(frame_set, frames=frames, test=None if frame_set.test is None else test, notes=notes)


def _mask_notes(frames: Sequence[Frame], train: Views, transparent: bool) -> list[str]:
    """How many photos have masks, and what these mean, as a sentence; [] without masks."""
    masked = sum(frame.mask is not None for frame in frames)
    if not masked:
        return []
    share = (
        "" if train.valid_mask is None else f", {1 - float(train.valid_mask.float().mean()):.0%} of the training pixels"
    )
    meaning = "treated as empty" if transparent else f"ignored{share}"
    return [f"masks of {masked} of {len(frames)} photos: black pixels are {meaning}"]


def _with_depths(train: Sequence[Frame], frame_set: FrameSet, folder: Path) -> tuple[list[Frame], list[str]]:
    """The training frames with their depth maps, and a sentence about those that have none."""
    maps = find_depths([frame.path for frame in (*frame_set.frames, *(frame_set.test or ()))], folder)
    without = [frame.name for frame in train if frame.path not in maps]
    notes = [f"training photos without a depth map: {len(without)} ({listed(without)})"] if without else []
    return [replace(frame, depths=maps.get(frame.path)) for frame in train], notes


def _split(
    root: Path, frame_set: FrameSet, train_views: int | None, hold_out: int | None
) -> tuple[list[Frame], list[Frame]]:
    """The frames to train on and those to test on, no photo in both."""
    frames = frame_set.frames
    test_frames = list(frame_set.test or ())
    counts = Counter(frame.path for frame in (*frames, *test_frames))
    for frame in (*frames, *test_frames):
        if counts[frame.path] > 1:
            in_both = all(frame.path in {other.path for other in part} for part in (frames, test_frames))
            where = "in the training and in the test views" if in_both else "several times"
            raise DataError(frame.source, frame.name, "each image once", f"it {where}")
    if frame_set.test is None or hold_out is not None:
        frames = [*frames, *test_frames]
        every = TEST_EVERY if hold_out is None else hold_out
        if len(frames) < 2 and every:
            raise DataError(root, "", "at least 2 posed images, one of them to test on", len(frames))
        if not frames:
            raise DataError(root, "", "posed images", "none")
        names = [frame.name for frame in frames]
        if every and len(frames) > 2 and (root / CAMERAS_REPORT).is_file():  # of photos that came without cameras
            centers = torch.stack([frame.pose[:3, 3] for frame in frames]).numpy()
            train, test = split_between_ends(names, centers, train_views, every)
        else:
            train, test = split_by_name(names, train_views, every)
        return [frames[i] for i in train], [frames[i] for i in test]
    chosen: Sequence[int] = select_evenly(len(frames), train_views)
    if train_views == len(frame_set.published) and len(frames) > max(frame_set.published):
        chosen = frame_set.published
    return [frames[i] for i in chosen], test_frames


@dataclass(frozen=True)
class _Scale:
    """By how much all photos are reduced, and the size that results."""

    factor: float
    size: tuple[int, int]  # (height, width)
    first: str  # width and height of the photo that sets this size, for messages

    @classmethod
    def of(cls, frame: Frame, factor: float) -> Self:
        """The scale of this photo, and of all others, which have to be as large."""
        frame.image.load()
        width, height = frame.image.size
        return cls(factor, _reduced(width, height, factor), f"{width}x{height}")


def _reduced(width: int, height: int, factor: float) -> tuple[int, int]:
    return max(1, round(height / factor)), max(1, round(width / factor))


def _check_size(frame: Frame, width: int, height: int, scales: Sequence[_Scale]) -> None:
    """Refuse a photo whose size is not that of its lens, or not that of the other photos."""
    lens = frame.intrinsics
    if not lens.same_aspect(width, height):
        described = f"the {lens.width}x{lens.height} that {frame.source.name} describes"
        advice = ""
        if lens.same_aspect(height, width) and frame.image.metadata.tags.get(Base.Orientation) in _SIDEWAYS:
            advice = "its Exif turns it by a quarter, and cameras have to be those of the photo as it is stored"
        got = f"{width}x{height} pixels"
        raise DataError(frame.path, "", f"a scaled version of {described}", got, advice=advice)
    for scale in scales:
        size = _reduced(width, height, scale.factor)
        if scale.size not in (size, size[::-1]):
            raise DataError(frame.path, "", f"{scale.first} pixels as the other images", f"{width}x{height}")


def _views(
    frames: Sequence[Frame],
    scales: Sequence[_Scale],
    offset: Tensor,
    background: Tensor,
    photos: bool,
    transparent: bool,
) -> list[Views]:
    """The frames as views, once for each scale; their photos are decoded once, or not at all."""
    count = len(frames)
    rectify = lru_cache(maxsize=1)(rectification)  # photos of one lens share it
    device = "cpu" if photos else "meta"
    images = [torch.empty(count, 3, *scale.size, dtype=torch.float32, device=device) for scale in scales]
    intrinsics = torch.eye(4, dtype=torch.float32).repeat(len(scales), count, 1, 1)
    alphas: list[dict[int, Tensor]] = [{} for _ in scales]
    valid: list[dict[int, Tensor]] = [{} for _ in scales]
    depth_maps: list[dict[int, Tensor]] = [{} for _ in scales]
    turned = [False] * count
    for i, frame in enumerate(frames):
        image = None
        if photos:
            image = frame.image.read()
            height, width = image.shape[:2]
        else:
            width, height = frame.image.size
        _check_size(frame, width, height, scales)
        try:
            lens, maps = rectify(frame.intrinsics.scaled(width, height))
        except ArgumentError as error:
            raise error.about(frame.source, f"{error.name} of {frame.name}") from error
        kept = depth_map = None
        if image is not None:
            if frame.mask is not None:
                kept = frame.mask.kept(frame.path, width, height)
            if kept is not None and transparent:
                alpha = kept[..., None] * (image[..., 3:] if image.shape[2] == 4 else 1.0)
                image = np.concatenate([image[..., :3], alpha], axis=2)
                kept = None
            if image.shape[2] == 4:
                alpha = image[..., 3:]
                image[..., :3] = image[..., :3] * alpha + background.numpy() * (1 - alpha)
            image = remap(image, maps, kept)
            kept = None if kept is None else remap(kept, maps)
            if frame.depths is not None:
                depth_map = rectified(read_depths(frame.depths, frame.path, width, height), maps)
        turned[i] = _reduced(width, height, scales[0].factor) != scales[0].size  # it is that size on its side
        if turned[i]:
            lens = lens.turned()
            image = None if image is None else np.ascontiguousarray(np.rot90(image, -1))
            kept = None if kept is None else np.ascontiguousarray(np.rot90(kept, -1))
            depth_map = None if depth_map is None else np.ascontiguousarray(np.rot90(depth_map, -1))
        for j, scale in enumerate(scales):
            height, width = scale.size
            if image is None:
                reduced_lens = lens.scaled(width, height)
            else:
                reduced, reduced_lens = resize(image, lens, width, height, kept)
                pixels = torch.from_numpy(reduced).permute(2, 0, 1)
                images[j][i] = pixels[:3]
                if len(pixels) == 4:
                    alphas[j][i] = pixels[3:].clone()
                if kept is not None:
                    valid[j][i] = torch.from_numpy(resize(kept, lens, width, height)[0]) > _VALID
                if depth_map is not None:
                    depth_maps[j][i] = torch.from_numpy(resized(depth_map, width, height))
            intrinsics[j, i, :3, :3] = torch.from_numpy(reduced_lens.matrix())
    poses = torch.zeros(count, 4, 4, dtype=torch.float64)
    for i, frame in enumerate(frames):
        poses[i] = frame.pose @ _CLOCKWISE if turned[i] else frame.pose
    u, _, vh = torch.linalg.svd(poses[:, :3, :3])  # u @ vh is a rotation exactly
    extrinsics = kg.Rt_to_matrix4x4(*kg.camtoworld_to_worldtocam_Rt(u @ vh, poses[:, :3, 3:] - offset[:, None])).float()
    names = tuple(frame.name for frame in frames)
    views = []
    for j, scale in enumerate(scales):
        opaque = torch.ones(1, *scale.size, dtype=torch.float32)
        stacked = torch.stack([alphas[j].get(i, opaque) for i in range(count)]) if alphas[j] else None
        every = opaque[0] > 0
        valid_mask = torch.stack([valid[j].get(i, every) for i in range(count)]) if valid[j] else None
        unknown = torch.zeros_like(opaque[0])
        depths = torch.stack([depth_maps[j].get(i, unknown) for i in range(count)]) if depth_maps[j] else None
        cameras = pinhole_cameras(extrinsics, intrinsics[j], *scale.size[::-1])
        turns = tuple(turned) if any(turned) else None
        views.append(Views(cameras, images[j], names, stacked, valid_mask=valid_mask, turned=turns, depths=depths))
    return views

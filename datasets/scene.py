"""A scene as every loader returns it: posed training and test images in one frame."""

import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self, SupportsIndex

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.nn.functional import avg_pool2d

from kgs._support.errors import ArgumentError, DataError
from kgs._support.shown import ShownByShapes
from kgs.geometry.cameras import resized, select


@dataclass(frozen=True, eq=False, repr=False)
class Views(ShownByShapes):
    """V posed images of one size: a data set of dicts, `views[0]["image"]`.

    Convention:
        Kornia's: world-to-camera extrinsics `(V, 4, 4)` with OpenCV axes (x right, y down, z forward), integer pixel
        centres (a centred image has cx = (W - 1) / 2). Float32, whatever torch's default dtype is.

    Args:
        cameras: the V cameras; height and width of each equal the images'.
        images: floating point RGB in [0, 1], `(V, 3, H, W)`; on the "meta" device (a shape without pixels) in a scene
            that was loaded with `photos=False`.
        names: file names, unique, in the order of the images.
        alphas: `(V, 1, H, W)` in [0, 1], the images' alpha channel, or None.
        border_mask: `(H, W)` in [0, 1], the share of light that each pixel lets through, the same in all images, or
            None: 1 everywhere. It is below 1 in the dark border that removing a lens's distortion can leave.
        valid_mask: bool `(V, H, W)`, the pixels that count, or None: all. Where somebody walked by, nothing is
            compared, and no keypoints or initial points are taken.
        gains: `(V, 3)` above 0, the factors of the scene's colours in each photo: its exposure and white balance; or
            None: 1. They are estimated before a fit, and loaders set none.
        turned: whether each photo was turned by a quarter clockwise, and its camera with it, to have the size of the
            others; None: none was.
        depths: `(V, H, W)` float32, the depth maps of the photos as their files have them: depths, or depths or inverse
            depths up to scale and shift; 0: unknown. None: there are none. Initial points alone are made of them.

    Raises:
        TypeError: the images are not a tensor of floating point numbers.
        ValueError: counts, shapes or sizes do not fit, or two names are equal.

    Examples:
        >>> from torch.utils.data import DataLoader
        >>> from kgs.datasets import synthetic_scene
        >>> batch = next(iter(DataLoader(synthetic_scene().train, batch_size=2)))
        >>> batch["image"].shape, batch["extrinsics"].shape, batch["intrinsics"].shape
        (torch.Size([2, 3, 126, 168]), torch.Size([2, 4, 4]), torch.Size([2, 3, 3]))
    """

    cameras: PinholeCamera
    images: Tensor
    names: tuple[str, ...]
    alphas: Tensor | None = None
    border_mask: Tensor | None = None
    valid_mask: Tensor | None = None
    gains: Tensor | None = None
    turned: tuple[bool, ...] | None = None
    depths: Tensor | None = None

    def __post_init__(self) -> None:
        count = len(self.names)
        if not isinstance(self.images, Tensor) or not self.images.is_floating_point():
            given = self.images.dtype if isinstance(self.images, Tensor) else type(self.images).__name__
            raise TypeError(f"images: expected a tensor of floating point RGB in [0, 1], got {given}")
        if len(set(self.names)) < count:
            raise ArgumentError("names", "each once", "two that are equal")
        if self.images.ndim != 4 or self.images.shape[:2] != (count, 3):
            raise ArgumentError("images", f"shape ({count}, 3, H, W)", tuple(self.images.shape))
        if self.cameras.batch_size != count:
            raise ArgumentError("cameras", f"{count} as names", self.cameras.batch_size)
        height, width = self.images.shape[-2:]
        if not bool(((self.cameras.height == height) & (self.cameras.width == width)).all()):
            sizes = [self.cameras.height.tolist(), self.cameras.width.tolist()]
            raise ArgumentError("cameras", f"height {height} and width {width} as images", sizes)
        shapes = {
            "alphas": (count, 1, height, width),
            "border_mask": (height, width),
            "valid_mask": (count, height, width),
            "gains": (count, 3),
            "depths": (count, height, width),
        }
        for name, shape in shapes.items():
            if (value := getattr(self, name)) is not None and tuple(value.shape) != shape:
                raise ArgumentError(name, f"shape {shape}", tuple(value.shape))
        if self.gains is not None and not bool((self.gains > 0).all()):
            raise ArgumentError("gains", "numbers above 0", self.gains.tolist())
        if self.turned is not None and len(self.turned) != count:
            raise ArgumentError("turned", f"{count} as names", len(self.turned))

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: SupportsIndex) -> dict[str, Tensor | int | str]:
        """One view as a dict, which `torch.utils.data.DataLoader` collates; an IndexError if there is none.

        Returns:
            image `(3, H, W)`, extrinsics `(4, 4)` and intrinsics `(3, 3)` as `kgs.pinhole_cameras` and
            `kgs.rasterization` take them with `pixel_centers="integer"`, index, name, alpha `(1, H, W)` where
            images have one, and valid_mask `(H, W)` where not all pixels count.
        """
        if not -len(self) <= (given := operator.index(index)) < len(self):
            raise IndexError(f"index: expected a whole number below {len(self)}, the number of views, got {given}")
        i = given % len(self)
        matrices = {"extrinsics": self.cameras.extrinsics[i], "intrinsics": self.cameras.intrinsics[i, :3, :3]}
        alpha = {} if self.alphas is None else {"alpha": self.alphas[i]}
        valid = {} if self.valid_mask is None else {"valid_mask": self.valid_mask[i]}
        return {"image": self.images[i], **matrices, "index": i, "name": self.names[i], **alpha, **valid}

    def __iter__(self) -> Iterator[dict[str, Tensor | int | str]]:
        return (self[i] for i in range(len(self)))

    def camera(self, index: SupportsIndex | Sequence[SupportsIndex] | Tensor) -> PinholeCamera:
        """The cameras at the given positions, one or several (Kornia's class cannot be indexed).

        TypeError for positions that are not integers, IndexError for views that do not exist.
        """
        return select(self.cameras, index)

    def select(self, indices: Sequence[int]) -> Self:
        """The views at the given positions, in that order."""
        rows = torch.tensor(indices, dtype=torch.int64, device="cpu")
        return replace(
            self,
            cameras=self.camera(rows),
            images=self.images[rows],
            names=tuple(self.names[i] for i in indices),
            alphas=None if self.alphas is None else self.alphas[rows],
            valid_mask=None if self.valid_mask is None else self.valid_mask[rows],
            gains=None if self.gains is None else self.gains[rows],
            turned=None if self.turned is None else tuple(self.turned[i] for i in indices),
            depths=None if self.depths is None else self.depths[rows],
        )

    def render(self, index: int, render: Callable[..., Tensor]) -> Tensor:
        """The render of one view in the exposure of its photo, `(1, 3, H, W)`.

        `render` is called with the camera and, where there are gains, with those of the view, `(3,)`: it multiplies the
        colours of the scene by them, and not the background that shows through, which no photo exposes.
        """
        camera = self.camera(index)
        return render(camera) if self.gains is None else render(camera, self.gains[index])

    def as_photo(self, index: int, image: Tensor) -> Tensor:
        """What :meth:`render` returned, `(..., 3, H, W)`, as the photo would show it.

        It is clamped to [0, 1], behind the photos' dark border.
        """
        image = image.clamp(0, 1)
        return image if self.border_mask is None else image * self.border_mask.to(image)

    def compared(self, index: int, image: Tensor) -> tuple[Tensor, Tensor, float]:
        """What :meth:`render` returned as the photo would show it, that photo, and the share of pixels that counts.

        Both are black where pixels do not count. The photo is `(3, H, W)`, on the device and of the type of the image.
        """
        image = self.as_photo(index, image)
        photo = self.images[index].to(image)
        if self.valid_mask is None:
            return image, photo, 1.0
        valid = self.valid_mask[index].to(image.device)
        return image * valid, photo * valid, float(valid.float().mean())

    @property
    def usable(self) -> Tensor | None:
        """Which pixels show the scene: opaque ones that count and no border covers, bool `(V, H, W)`; None: all."""
        parts = [] if self.alphas is None else [self.alphas[:, 0] > 0.5]
        parts += [] if self.border_mask is None else [(self.border_mask >= 1).expand(len(self), -1, -1)]
        parts += [] if self.valid_mask is None else [self.valid_mask]
        return torch.stack(parts).all(dim=0) if parts else None

    def downsample(self, factor: int) -> Self:
        """The views at 1 / factor of the width and height: means of factor x factor pixels; what is left over is cut.

        Of depths one of these pixels is taken, the middle one. Images with fewer rows or columns than that are a
        ValueError.
        """
        size = self.images.shape[-2] // factor, self.images.shape[-1] // factor
        if 0 in size:
            given = tuple(self.images.shape[-2:])
            raise ArgumentError("images", f"at least {factor} x {factor} pixels to downsample", given)
        middles = slice(factor // 2, None, factor)
        return replace(
            self,
            cameras=resized(self.cameras, 1 / factor, size),
            images=avg_pool2d(self.images, factor),
            alphas=None if self.alphas is None else avg_pool2d(self.alphas, factor),
            border_mask=None if self.border_mask is None else avg_pool2d(self.border_mask[None], factor)[0],
            valid_mask=None if self.valid_mask is None else avg_pool2d(self.valid_mask.float(), factor) == 1,
            depths=None if self.depths is None else self.depths[:, middles, middles][:, : size[0], : size[1]],
        )


@dataclass(frozen=True, eq=False, repr=False)
class Scene(ShownByShapes):
    """Training and test views in one world frame, with initial points if the layout has any.

    Args:
        train: the views to fit. Nothing of a fit may depend on `test`.
        test: the held-out views.
        points: `(P, 3)` float32, P may be 0.
        point_colors: `(P, 3)` in [0, 1].
        init_kind: where `points` come from: "none", "random" or "model-points".
        offset: `(3,)` float64, subtracted from the world's coordinates on loading; exports add it back.
        background: `(3,)`, the colour behind the scene, in [0, 1].
        root: the folder the scene was read from.
        train_full_size: the training views at a higher resolution, to find initial points in; None if `train` is as
            fine.
        notes: what the files say that is not used, one sentence each, to be shown to the user.
    """

    train: Views
    test: Views
    points: Tensor
    point_colors: Tensor
    init_kind: str
    offset: Tensor
    background: Tensor
    root: Path
    train_full_size: Views | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.train) == 0:
            raise DataError(self.root, "train", "at least one training view", "none")
        if self.train_full_size is not None and self.train_full_size.names != self.train.names:
            raise ArgumentError("train_full_size", f"the views {self.train.names} as train", self.train_full_size.names)
        shapes = tuple(self.points.shape), tuple(self.point_colors.shape)
        if shapes[0] != shapes[1] or len(shapes[0]) != 2 or shapes[0][1] != 3:
            raise ArgumentError("points, point_colors", "two of shape (P, 3)", f"{shapes[0]} and {shapes[1]}")

"""Draws the pictures of the guide from the splat of `kgs demo --scene room`.

python docs/pictures/make.py ROOM/splat.ply
"""

import sys
from pathlib import Path

import cv2
import torch
from torch import Tensor
from torch.nn.functional import normalize

import kgs
from kgs.datasets import synthetic_scene

WIDTH, HEIGHT = 480, 360  # of one picture
GAP = 8  # white columns between two
MASKS = 200  # drop masks whose images are averaged
RATES = 0.3, 0.6
FOLDER = Path(__file__).parent


def main(ply: str) -> None:
    """Draw all pictures."""
    scene = synthetic_scene(train_views=3, test_views=3, size=(HEIGHT, WIDTH))
    splat = kgs.load_ply(ply, origin=scene.offset)
    with torch.no_grad():
        gaussians = splat()
    viewmats = scene.test.cameras.extrinsics[1:2]
    of_layer(splat, gaussians, viewmats)
    of_outputs(splat, gaussians, viewmats)
    of_lenses(splat, gaussians, viewmats)


def of_layer(splat: kgs.GaussianModel, gaussians: kgs.Gaussians, viewmats: Tensor) -> None:
    """All Gaussians; one mask of the layer at each of two rates; the mean of many at the first rate."""

    def dropped(drop: kgs.DropGaussian) -> Tensor:
        return render(splat, gaussians, viewmats, opacities=drop(gaussians.opacities))

    low, high = (kgs.DropGaussian(rate, "constant", seed=0) for rate in RATES)
    whole = render(splat, gaussians, viewmats)
    mean = torch.stack([dropped(low) for _ in range(MASKS)]).mean(0)
    save("layer.jpg", [whole, dropped(low), dropped(high), mean])


def of_outputs(splat: kgs.GaussianModel, gaussians: kgs.Gaussians, viewmats: Tensor) -> None:
    """Colour, expected depth and normals of one camera."""
    cameras = kgs.pinhole_cameras(viewmats, lens(0.9), WIDTH, HEIGHT, "half")
    out = kgs.GaussianRenderer()(gaussians, cameras, outputs=("image", "alpha", "depth", "normal"))
    depth = out.depth[0, 0]
    near, far = depth[out.alpha[0, 0] > 0.5].quantile(torch.tensor([0.02, 0.98]))
    scaled = (255 * ((far - depth) / (far - near)).clamp(0, 1)).byte().numpy()
    colored = torch.from_numpy(cv2.applyColorMap(scaled, cv2.COLORMAP_VIRIDIS)[..., ::-1].copy()) / 255
    normals = (1 - normalize(out.normal[0], dim=0).permute(1, 2, 0)) / 2
    save("outputs.jpg", [out.image[0].permute(1, 2, 0), colored, normals])


def of_lenses(splat: kgs.GaussianModel, gaussians: kgs.Gaussians, viewmats: Tensor) -> None:
    """The same camera with three lenses; harmonics of degree 0, which all have."""
    images = [
        render(splat, gaussians, viewmats, focal=focal, camera_model=model, sh_degree=0)
        for model, focal in (("pinhole", 0.9), ("fisheye", 0.9), ("ortho", 0.45))
    ]
    save("lenses.jpg", images)


def lens(focal: float) -> Tensor:
    """Intrinsics of a focal length in widths, the first pixel's centre at (0.5, 0.5)."""
    length = focal * WIDTH
    return torch.tensor([[[length, 0.0, WIDTH / 2], [0.0, length, HEIGHT / 2], [0.0, 0.0, 1.0]]])


def render(
    splat: kgs.GaussianModel, gaussians: kgs.Gaussians, viewmats: Tensor, focal: float = 0.9, **options
) -> Tensor:
    """The image `(H, W, 3)` by `kgs.rasterization`; focal in widths."""
    options = {"opacities": gaussians.opacities, "sh_degree": splat.sh_degree} | options
    values = {
        "means": gaussians.means,
        "quats": gaussians.quats,
        "scales": gaussians.scales,
        "colors": gaussians.colors,
    }
    return kgs.rasterization(**values, viewmats=viewmats, Ks=lens(focal), width=WIDTH, height=HEIGHT, **options)[0][0]


def save(name: str, images: list[Tensor]) -> None:
    """Write images `(H, W, 3)` side by side as a JPEG."""
    gap = torch.ones(HEIGHT, GAP, 3)
    row = [part for image in images for part in (image.clamp(0, 1), gap)][:-1]
    pixels = (255 * torch.cat(row, dim=1)).round().byte().numpy()
    cv2.imwrite(str(FOLDER / name), pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main(sys.argv[1])

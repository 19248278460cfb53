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
        return render(splat, gaussians, viewmats, opacities=drop(gaussians.opacities))[0]

    low, high = (kgs.DropGaussian(rate, "constant", seed=0) for rate in RATES)
    whole = render(splat, gaussians, viewmats)[0]
    mean = torch.stack([dropped(low) for _ in range(MASKS)]).mean(0)
    save("layer.jpg", [whole, dropped(low), dropped(high), mean])


def of_outputs(splat: kgs.GaussianModel, gaussians: kgs.Gaussians, viewmats: Tensor) -> None:
    """Colour, expected depth and normals of one call."""
    colors, alphas, meta = render(splat, gaussians, viewmats, render_mode="RGB+ED", return_normals=True)
    depth = colors[..., 3]
    near, far = depth[alphas[..., 0] > 0.5].quantile(torch.tensor([0.02, 0.98]))
    scaled = (255 * ((far - depth) / (far - near)).clamp(0, 1)).byte().numpy()
    colored = torch.from_numpy(cv2.applyColorMap(scaled, cv2.COLORMAP_VIRIDIS)[..., ::-1].copy()) / 255
    normals = (1 - normalize(meta["normals"][0], dim=-1)) / 2
    save("outputs.jpg", [colors[..., :3], colored, normals])


def of_lenses(splat: kgs.GaussianModel, gaussians: kgs.Gaussians, viewmats: Tensor) -> None:
    """The same camera with three lenses."""
    images = [
        render(splat, gaussians, viewmats, focal=focal, camera_model=model)[0]
        for model, focal in (("pinhole", 0.9), ("fisheye", 0.9), ("ortho", 0.45))
    ]
    save("lenses.jpg", images)


def render(
    splat: kgs.GaussianModel, gaussians: kgs.Gaussians, viewmats: Tensor, focal: float = 0.9, **options
) -> tuple[Tensor, ...]:
    """Colours `(H, W, D)`, alphas `(H, W, 1)` and what else there is, by `kgs.rasterization`; focal in widths."""
    length = focal * WIDTH
    intrinsics = torch.tensor([[[length, 0.0, WIDTH / 2], [0.0, length, HEIGHT / 2], [0.0, 0.0, 1.0]]])
    opacities = options.pop("opacities", gaussians.opacities)
    values = gaussians.means, gaussians.quats, gaussians.scales, opacities, gaussians.colors
    colors, alphas, meta = kgs.rasterization(
        *values, viewmats, intrinsics, WIDTH, HEIGHT, sh_degree=splat.sh_degree, **options
    )
    return colors[0], alphas[0], meta


def save(name: str, images: list[Tensor]) -> None:
    """Write images `(H, W, 3)` side by side as a JPEG."""
    gap = torch.ones(HEIGHT, GAP, 3)
    row = [part for image in images for part in (image.clamp(0, 1), gap)][:-1]
    pixels = (255 * torch.cat(row, dim=1)).round().byte().numpy()
    cv2.imwrite(str(FOLDER / name), pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main(sys.argv[1])

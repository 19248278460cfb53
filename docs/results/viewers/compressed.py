"""What the rounding of splat.compressed.ply costs: `python compressed.py OUT BACK.ply`, of `kgs fit` or `kgs demo`.

BACK.ply is what another program reads in it: `npx splat-transform OUT/splat.compressed.ply BACK.ply`.
"""

import sys
from dataclasses import replace
from pathlib import Path

import kgs
from kgs.app.saved_fit import load_fit
from kgs.metrics.evaluate import evaluate

out, back = map(Path, sys.argv[1:])
fit = load_fit(out)[1]
plain = replace(fit, model=kgs.load_ply(out / "splat.ply", origin=fit.scene.offset))
rounded = replace(fit, model=kgs.load_ply(back, origin=fit.scene.offset))
sizes = [(out / name).stat().st_size for name in ("splat.ply", "splat.compressed.ply")]
print(f"{len(plain.model)} Gaussians, degree {plain.model.sh_degree}: {sizes[0]} to {sizes[1]} bytes, ", end="")
print(f"{sizes[0] / sizes[1]:.2f} times smaller")
for name, views in (("train", fit.scene.train), ("test", fit.scene.test)):
    if not len(views):
        continue
    photos = [evaluate(each.render, views)["psnr"] for each in (plain, rounded)]
    renders = [plain.render(views.camera(i))[0].clamp(0, 1) for i in range(len(views))]
    off = [((rounded.render(views.camera(i))[0].clamp(0, 1) - renders[i]) ** 2).mean() for i in range(len(views))]
    levels = [-10 * float(error.log10()) for error in off]
    print(f"{name}: to the renders of splat.ply {min(levels):.1f} to {max(levels):.1f} dB; ", end="")
    print(f"to the photos {photos[0]:.3f} before, {photos[1]:.3f} after")

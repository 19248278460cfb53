"""`kgs clean`: a splat without floaters, oversized and elongated Gaussians."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from kgs._support.errors import ArgumentError, DataError, printable
from kgs.app.console import VIEWER, as_line, each, say, say_next
from kgs.fit.config import Backend, Background

from .checks import check_file, check_photos_of, check_results
from .inputs import load_cameras, load_splat, options_of_fit
from .options import IfGiven, Out
from .tools import load_tools

if TYPE_CHECKING:
    from torch import Tensor

    from kgs.fit.clean import Cleaned
    from kgs.fit.fit import Fit
    from kgs.model import GaussianModel


def clean(
    splat: Path,
    /,
    *,
    out: Out = Path("clean.ply"),
    strength: float = 1.0,
    cameras: IfGiven[Path] = None,
    downscale: IfGiven[float] = None,
    background: Background = "black",
    device: str = "auto",
    backend: Backend = "auto",
) -> None:
    """Remove floaters, oversized and elongated Gaussians from a splat: what shows from beside the photos alone.

    A floater is a Gaussian that one photo shows and another sees through, or one near a camera, or an isolated one.
    Each photo is rendered before and after: what is
    removed lowers the PSNR of none by more than 0.05 dB times the strength.

    For example:
      kgs clean fern-3 -o fern-clean.ply
      kgs clean lego.ply --cameras lego -o lego-clean.ply --strength 4 --background white

    Args:
        splat: the folder of the results of kgs fit, or a 3DGS PLY file.
        out: the PLY file to write.
        strength: above 0, up to 100. The sizes from which a Gaussian is removed are divided by its root.
        cameras: of a PLY file, the scene (folder of LLFF, COLMAP, Blender or nerfstudio) that it was fitted to. Unless
            given, floaters are the isolated ones alone, and no photo is compared.
        downscale: with --cameras, reduce the photos by this factor.
        background: with --cameras, the colour behind the splat, and behind photos with transparency.
        device: auto: a GPU if kgs has kernels for it, else the CPU. Or cpu, cuda, cuda:1, ...
        backend: auto: that of the fit, or the fastest that is installed. kgs fit --help-all describes the others.
    """
    from kgs.datasets.options import check_options
    from kgs.datasets.source import SceneSource

    check_options(downscale, None)
    check_file(out, ".ply", splat)
    source = None if cameras is None else SceneSource(cameras)
    if source is not None:
        check_photos_of(source)
    if splat.is_dir():
        for name, value in (("cameras", cameras), ("downscale", downscale)):
            if value is not None:
                raise ArgumentError(name, "a PLY file as SPLAT", "a folder, which has its own scene")
        check_results(splat)
    elif cameras is None and downscale is not None:
        raise ArgumentError("downscale", "--cameras with it", "none")
    torch_device = load_tools(device, backend)

    from kgs.app.saved_fit import load_fit
    from kgs.fit.clean import check_left, check_strength, find_artifacts
    from kgs.fit.clean import clean as clean_fit
    from kgs.ply import save_ply

    check_strength(strength)
    fit = None
    if splat.is_dir():
        request, fit = load_fit(splat, torch_device, backend, say)
        downscale = request.shrink(fit.scene)
        background = "white" if request.background == "white" else "black"
    elif source is not None:
        scene = load_cameras(source, downscale, photos=True, background=background)
        fit = load_splat(splat, scene, torch_device, backend)
    if fit is not None:
        _check_some(splat, fit.model)
        cleaned = clean_fit(fit, strength, each)
        model = cleaned.fit.model
        removed = cleaned.removed
        fitted = len(fit.model)
        offset = fit.scene.offset
    else:
        whole, offset = _load_alone(splat)
        _check_some(splat, whole)
        artifacts = find_artifacts(whole, strength)
        model = whole.select(~artifacts.any)
        check_left(len(model))
        removed = artifacts.counts(artifacts.any)
        fitted = len(whole)
    save_ply(out, model, offset=offset)
    kinds = ", ".join(f"{count} {kind}" for kind, count in removed.items())
    say(f"{printable(out)}: {len(model)} of {fitted} Gaussians; removed: {kinds}")
    if fit is None:
        say("no photo was compared, and floaters are the isolated ones alone: --cameras SCENE names the photos")
        say_next(VIEWER.format(as_line(out)))
        return
    if cleaned.needed:
        say(f"{cleaned.needed} others stay: without them a training view would lose more than it may")
    _say_levels(fit, cleaned)
    options = []
    known = options_of_fit(out, SceneSource(fit.scene.root)).get("downscale")
    if (downscale or 1.0) > 1.0 and downscale != known:
        options += ["--size", str(max(fit.scene.train.images.shape[-2:]))]
    if background != "black":
        options += ["--background", background]
    say_next(as_line("kgs", "page", out, "--cameras", fit.scene.root, "-o", out.with_suffix(".html"), *options))


def _check_some(splat: Path, model: "GaussianModel") -> None:
    """Refuse a splat without Gaussians."""
    if not len(model):
        raise DataError(splat, "Gaussians", "at least one", "none")


def _load_alone(ply: Path) -> tuple["GaussianModel", "Tensor"]:
    """A splat without cameras, and the offset of its frame: 0, unless float32 would move its Gaussians."""
    import torch

    from kgs.ply import Float32Warning, load_ply

    with warnings.catch_warnings():
        warnings.simplefilter("error", Float32Warning)
        try:
            return load_ply(ply), torch.zeros(3, dtype=torch.float64)
        except Float32Warning:
            warnings.simplefilter("ignore")  # the other warnings were shown
            offset = load_ply(ply).means.detach().double().median(dim=0).values
            return load_ply(ply, origin=offset), offset


def _say_levels(fit: "Fit", cleaned: "Cleaned") -> None:
    """What training and test views lost."""
    from statistics import fmean

    names = fit.scene.train.names
    losses = [before - after for before, after in zip(cleaned.before, cleaned.after, strict=True)]
    name = printable(names[losses.index(max(losses))])
    before = fmean(cleaned.before)
    after = fmean(cleaned.after)
    say(f"train: PSNR {after:.2f}, before {before:.2f}; none lost more than {max(0.0, *losses):.3f} dB ({name})")
    test = fit.scene.test
    if len(test):
        levels = [one.psnr(test) for one in (cleaned.fit, fit)]
        if None not in levels:
            say(f" test: PSNR {levels[0]:.2f}, before {levels[1]:.2f}")

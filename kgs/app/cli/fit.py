"""`kgs fit`: from a folder of photos to a splat."""

import os
import re
import warnings
from contextlib import nullcontext
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from kgs._support.errors import DataError, printable
from kgs.app.console import VIEWER, as_line, say, say_next
from kgs.fit.config import COARSE, DETAILS, PRESETS, Background, FitConfig, min_side

from .inputs import check_tools
from .options import Existing, Out, options_in


def defaults(words: list[str]) -> dict[str, Any]:
    """The default of `config`, which follows from --preset and --detail."""
    preset = PRESETS.get(_value(words, "--preset"), PRESETS["auto"])
    detail = DETAILS.get(_value(words, "--detail"), DETAILS["normal"])
    return {"config": replace(preset, **detail.entries)}


def _value(words: list[str], option: str) -> str:
    """The value of an option where it is given last, as tyro takes it; "" where it is not given."""
    value = ""
    for word, following in pairwise([*options_in(words), ""]):
        if word == option:
            value = following
        elif word.startswith(f"{option}="):
            value = word.partition("=")[2]
    return value


def fit(
    scene: Existing,
    /,
    *,
    out: Out,
    views: int | None = None,
    hold_out: int | None = None,
    size: int | str | None = None,
    downscale: float | None = None,
    background: Background = "black",
    frames: int | None = None,
    masks: Existing | None = None,
    mask_mode: Literal["ignore", "transparent"] = "ignore",
    preset: Literal["auto", "paper", "plain"] = "auto",
    detail: Literal["low", "normal", "high"] = "normal",
    resume: bool = False,
    title: str | None = None,
    photos: bool = True,
    roll: float = 0.0,
    lpips_weights: Existing | None = None,
    live: bool = False,
    config: Annotated[FitConfig, tyro.conf.arg(name="")],
) -> int:
    """Turn a folder of photos into a splat, a page to look at it, and a film.

    For example:
      kgs fit PHOTOS -o OUT
      kgs fit fern -o fern-3 --views 3 --size 504

    Args:
        scene: a folder of 3 or more photos, a video, or a scene with camera poses (LLFF, COLMAP, Blender or
            nerfstudio). The cameras of photos are found first (extra sfm).
        out: folder for the results: index.html is the page to look at, turntable.webm or .mp4 the film.
        views: number of training views, spread over those that are not held out. Unless given: all of them.
        hold_out: every Nth photo is held out for testing; 0: none. Unless given: what the files say, or every eighth;
            unposed: none.
        size: reduce the photos to this many pixels on their longer side. Unless given: 800 for unposed photos on a CPU,
            else their own size. Or field: that of published tables. Or a folder of photos in several sizes, as
            images_4.
        downscale: reduce the photos by this factor instead.
        background: the colour behind photos with transparency.
        frames: how many frames are taken from a video. Unless given: twelve, fewer where the camera moves little, more
            where it moves far.
        masks: folder of masks, white where a photo is kept. Unless given: masks/ beside the photos, or
            IMG_1_mask.png beside IMG_1.jpg.
        mask_mode: what black in a mask means. ignore: these pixels do not count. transparent: empty space.
        preset: auto: what the training views need. paper: DropGaussian's rule and recipe, as published. plain: the same
            without dropping. See --preset paper --help-all.
        detail: sets size, steps and initial points together. low: 378 pixels. high: 1000 pixels. Options given by name
            win. See --detail high --help-all.
        resume: continue the unfinished fit in the folder of the results, or the finished one.
        title: of the page. Unless given: the name of the folder.
        photos: --no-photos leaves the photos out of the page.
        roll: turn page and film clockwise by so many degrees.
        lpips_weights: folder with the weights of VGG16 and LPIPS (npz). Unless given: LPIPS is not measured.
        live: show the splat as it grows on a page on this machine, until the fit ends; a line says its address.
        config: every number of the fit.
    """
    from kgs.app.fit_folder import fit_folder
    from kgs.app.scene_request import SceneRequest
    from kgs.app.stages import Stages
    from kgs.datasets import load_scene
    from kgs.datasets.field import field_size
    from kgs.datasets.folders import CAMERAS_REPORT
    from kgs.fit.prune import left_out
    from kgs.init_points.files import read_points
    from kgs.metrics.evaluate import as_text
    from kgs.metrics.lpips import Lpips

    from .checks import SMALLEST
    from .unposed import find_scene, is_unposed, on_ctrl_c

    check_tools(config.device, config.backend, "safetensors", "jinja2")
    if config.init_file is not None:
        with warnings.catch_warnings(action="ignore"):
            read_points(config.init_file)  # an error now, not once there are cameras
    lpips = None if lpips_weights is None else Lpips.load(lpips_weights).to(config.device)
    request = SceneRequest(
        scene=os.path.abspath(scene),
        train_views=views,
        downscale=downscale,
        hold_out=hold_out,
        background=background,
        points=config.init if config.init == "model-points" else "none",
        photos=photos,
        roll=roll,
        title=title or "",
        masks="" if masks is None else os.path.abspath(masks),
        mask_mode=mask_mode,
    )
    base = out
    unposed = is_unposed(scene)
    is_free = size is None and downscale is None  # the size follows from --detail
    stages = Stages(say, unposed)
    if is_free and (detail != "normal" or (unposed and config.device == "cpu")):
        size = DETAILS[detail].size
        if config.coarse is None:
            config = replace(config, coarse=COARSE)
    if preset in ("paper", "plain") and size is None and downscale is None and not unposed:
        size = "field"
    if unposed:
        stages.begin("cameras")
        assert not isinstance(size, str)  # refused before
        request, base = find_scene(scene, out, request, config.seed, size, frames)
    elif (out / CAMERAS_REPORT).exists():
        raise DataError(out, "", "holds cameras that kgs found for other photos: choose another folder")
    elif size == "field":
        photo_folder, factor, why = field_size(scene)
        say(why)
        request = replace(request, photo_folder=photo_folder, downscale=factor)
    elif isinstance(size, str):
        request = replace(request, photo_folder=size)
    elif size is not None:
        height, width = load_scene(scene, photos=False, hold_out=hold_out).train.images.shape[-2:]
        request = replace(request, downscale=max(1.0, max(height, width) / size))
    loaded = request.load(base, say)
    height, width = loaded.train.images.shape[-2:]
    if max(height, width) < SMALLEST:
        reason = f"expected at least {SMALLEST} pixels, got photos of {width}x{height}"
        if downscale is None:  # a size that is too small is refused before
            raise DataError(scene, "images", reason)
        raise ValueError(f"downscale: {reason}")
    say(f"{printable(scene)}: {len(loaded.train)} training and {len(loaded.test)} test views of {width}x{height}")
    with on_ctrl_c("the cameras that were found are kept" if unposed else ""):
        published = fit_folder(loaded, config, out, request, resume=resume, lpips=lpips, live=live, stages=stages)
    metrics = published.fit.metrics
    say(as_text(metrics))
    posed = out if unposed else scene
    splat = published.folder / "splat.ply"
    renders = out / "renders"
    shrink = request.shrink(base, loaded)
    shrunk = ("--downscale", f"{shrink:g}") if shrink > 1.0 else ()
    say(f"{printable(splat)}: {metrics['gaussians']} Gaussians after {metrics['steps']} steps")
    if needless := left_out(metrics["decisions"]):
        say(f"left out: {needless}")
    if published.signal:
        say_next("the same command with --resume goes on where it stopped")
        return 128 + published.signal
    full_side = request.full_side(loaded) if is_free and preset == "auto" else None
    more = (
        f"the same command with --detail high fits {full_side} pixels instead of {max(height, width)}, and takes longer"
    )
    say_next(
        f"open {as_line(out / 'index.html')} in a browser: the splat to look around in, and how good it is",
        *([more] if full_side else []),
        f"{as_line('kgs', 'render', splat, '--cameras', posed, '-o', renders, *shrunk)}  # pictures from every camera",
        f"{as_line('kgs', 'eval', out, '--lpips-weights', 'WEIGHTS')}  # measure again, with LPIPS",
        VIEWER.format(as_line(splat)),
    )
    return 0


def check_fit(
    scene: Path,
    out: Path,
    views: int | None,
    hold_out: int | None,
    size: int | str | None,
    downscale: float | None,
    frames: int | None,
    roll: float,
    lpips_weights: Path | None,
    resume: bool,
    config: FitConfig,
    **_: Any,
) -> None:
    """Check the arguments of `kgs fit`."""
    from kgs.app.files.locks import locked
    from kgs.app.files.outputs import check_folder
    from kgs.app.files.publishing import UNFINISHED
    from kgs.app.files.results_folder import check_fit_files
    from kgs.app.sfm.find import MIN_PHOTOS, find_video
    from kgs.datasets.folders import layout_of
    from kgs.datasets.options import check_options
    from kgs.metrics.weights import weight_files

    from .checks import SMALLEST, check_installed, check_photos, check_roll, check_scene
    from .unposed import is_unposed

    check_roll(roll)
    if size is not None and downscale is not None:
        raise ValueError("size: expected either a size or a downscale factor, got both")
    if isinstance(size, str) and re.fullmatch(r"field|images(_\d+)?", size) is None:
        raise ValueError(f"size: expected pixels, field or a folder as images_8, got {size!r}")
    if isinstance(size, int) and size < SMALLEST:
        raise ValueError(f"size: expected at least {SMALLEST} pixels, got {size}")
    if views is not None and views < 1:
        raise ValueError(f"views: expected a whole number of at least 1, got {views}")
    check_options(downscale, hold_out)
    if frames is not None and frames < MIN_PHOTOS:
        raise ValueError(f"frames: expected at least {MIN_PHOTOS}, got {frames}")
    if frames is not None and find_video(scene) is None:
        raise ValueError("frames: expected a video to take them from, got photos")
    unposed = is_unposed(scene)
    if unposed and isinstance(size, str):
        raise ValueError(f"size: expected pixels for photos without camera poses, got {size!r}")
    solver = ["pycolmap"] if unposed else []
    check_installed(config.device, config.backend, "safetensors", "jinja2", *solver)
    if lpips_weights is not None:
        weight_files(lpips_weights)
    check_folder(out, scene, make=False)
    with locked(out) if (out / UNFINISHED).is_dir() else nullcontext():
        check_fit_files(out, resume)
    if unposed:
        if config.init == "scene":
            raise ValueError(
                "init: expected another one for photos without camera poses, got 'scene', Blender's points"
            )
        assert not isinstance(size, str)
        shortest = min_side(config, lpips_weights is not None)
        check_photos(scene, out, views, hold_out, size, downscale, frames, shortest)
    else:
        check_scene(scene)
        if config.init == "scene" and layout_of(scene) != "Blender":
            raise ValueError(
                f"init: expected another one for the layout {layout_of(scene)}, got 'scene', Blender's points"
            )

"""`kgs fit`: from a folder of photos to a splat."""

import inspect
import os
from dataclasses import MISSING, field, make_dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import tyro

from kgs._support.errors import ArgumentError
from kgs.app.details import COARSE, DETAILS
from kgs.app.files.results import Results
from kgs.fit.config import PRESETS, Background, FitConfig, min_side

from .checks import check_frames, check_init, check_photos, check_roll
from .options import QUIET, Flag, IfGiven, Open, Out
from .run_fit import run_fit
from .size import check_size, default_size
from .tools import load_tools
from .words import options_in

# The short help shows these entries of FitConfig, and all other options of the command but the rare ones.
_OF_CONFIG = ("steps", "drop", "refine_poses", "seed", "device")
_RARE = ("downscale", "background", "lpips_weights", "mask_mode", "depths", "roll", "frames", "title", "config")


def first_config(words: list[str]) -> FitConfig:
    """The default of `config`: the command's own device, and what follows from --preset and --detail."""
    preset = PRESETS.get(_value(words, "--preset"), PRESETS["auto"])
    detail = DETAILS.get(_value(words, "--detail"), DETAILS["normal"])
    return replace(preset, device="auto", **detail.entries)


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
    scene: Path,
    /,
    *,
    out: Out,
    views: IfGiven[int] = None,
    hold_out: IfGiven[int] = None,
    size: Annotated[int | str | None, QUIET] = None,  # IfGiven[...] may be cached by typing as str | int
    downscale: IfGiven[float] = None,
    background: Background = "black",
    frames: IfGiven[int] = None,
    masks: IfGiven[Path] = None,
    mask_mode: Literal["ignore", "transparent"] = "ignore",
    depths: IfGiven[Path] = None,
    preset: Literal["auto", "paper", "plain"] = "auto",
    detail: Literal["low", "normal", "high"] = "normal",
    measure: Flag = False,
    resume: Flag = False,
    title: IfGiven[str] = None,
    no_photos: Flag = False,
    roll: float = 0.0,
    lpips_weights: IfGiven[Path] = None,
    open_page: Open = False,
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
        masks: folder of masks, white where a photo is kept: IMG_1.png or IMG_1.jpg.png of IMG_1.jpg. Unless given:
            masks/.
        mask_mode: what black in a mask means. ignore: these pixels do not count. transparent: empty space.
        depths: folder of depth maps, of a network or a sensor: IMG_1.npy, .png or .tif of IMG_1.jpg. They give initial
            points where no two photos agree on a depth.
        preset: auto: what the training views need. paper: DropGaussian's rule and recipe, as published. plain: the same
            without dropping. See --preset paper --help-all.
        detail: sets size, steps and initial points together. low: 378 pixels. high: 1000 pixels. Options given by name
            win. See --detail high --help-all.
        measure: measure a photo that a second fit leaves out. Only of unposed photos; it takes nearly twice as long.
        resume: continue the fit in OUT, unfinished or finished.
        title: of the page. Unless given: the name of the folder.
        no_photos: leave the photos out of the page.
        roll: turn page and film clockwise by so many degrees.
        lpips_weights: folder with the weights of VGG16 and LPIPS (npz). Unless given: LPIPS is not measured.
        open_page: open the page in a browser when the fit is done.
        config: every number of the fit.
    """
    from kgs.app.files.fit_files import begun_on_cpu
    from kgs.app.scene_request import SceneRequest
    from kgs.app.sfm.source import Source
    from kgs.datasets.options import check_options
    from kgs.metrics.weights import weight_files

    source = Source.open(scene)
    if source.has_kgs_cameras and hold_out is None:
        hold_out = 0
    if measure and (not source.has_kgs_cameras or hold_out or views is not None):
        reason = "photos without camera poses, and neither --hold-out nor --views: these hold photos out themselves"
        raise ArgumentError("measure", reason)
    if views is not None and views < 1:
        raise ArgumentError("views", "a whole number of at least 1", views)
    check_roll(roll)
    check_size(size, downscale, source.is_unposed)
    check_options(downscale, hold_out)
    check_frames(frames, source)
    if lpips_weights is not None:
        weight_files(lpips_weights)
    with Results.open(out, "fit", ["photos"] if source.is_unposed else [], resume) as results:
        shortest = min_side(config, lpips_weights is not None)
        check_photos(source, views, hold_out, size, downscale, frames, shortest)
        check_init(config.init, source, depths)
        if resume and config.device == "auto" and begun_on_cpu(out):
            config = replace(config, device="cpu")  # on a GPU it would go on with other bits
        device = load_tools(config.device, config.backend, "safetensors", "jinja2")
        config = replace(config, device=str(device))
        request = SceneRequest(
            scene=os.path.abspath(scene),
            train_views=views,
            downscale=downscale,
            hold_out=hold_out,
            background=background,
            points=config.init if config.init == "model-points" else "none",
            photos=not no_photos,
            roll=roll,
            title=title or "",
            masks="" if masks is None else os.path.abspath(masks),
            mask_mode=mask_mode,
            depths="" if depths is None else os.path.abspath(depths),
        )
        is_free = size is None and downscale is None  # the size follows from --detail
        if is_free:
            size = default_size(detail, preset, source.has_kgs_cameras, device.type == "cpu")
        if is_free and isinstance(size, int) and config.coarse is None:
            config = replace(config, coarse=COARSE)
        return run_fit(
            source,
            results,
            request,
            config,
            size,
            frames=frames,
            measure=measure,
            resume=resume,
            lpips_weights=lpips_weights,
            suggest_detail=is_free and preset == "auto",
            open_page=open_page,
        )


def short_help(config: FitConfig) -> type[Any]:
    """A class that has the options of the short help, with the numbers of `config`: tyro describes it as `fit`."""
    entries = list[tuple[str, Any, Any]]()
    hints = get_type_hints(fit, include_extras=True)
    for name, parameter in inspect.signature(fit).parameters.items():
        is_named = parameter.kind is parameter.KEYWORD_ONLY
        hint = hints[name] if is_named else Annotated[hints[name], tyro.conf.Positional]
        default = MISSING if parameter.default is parameter.empty else parameter.default
        if name not in _RARE:
            entries.append((name, hint, field(default=default)))
    hints = get_type_hints(FitConfig, include_extras=True)
    for name in _OF_CONFIG:
        value = getattr(config, name)
        hint = Annotated[hints[name], QUIET] if value is None else hints[name]
        entries.append((name, hint, field(default=value)))
    kind: type[Any] = make_dataclass("ShortHelp", entries, kw_only=True)
    of_config = inspect.cleandoc(FitConfig.__doc__ or "").partition("Args:")[2]
    kind.__doc__ = inspect.cleandoc(fit.__doc__ or "") + of_config
    return kind

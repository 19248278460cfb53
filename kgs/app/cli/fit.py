"""`kgs fit`: from a folder of photos to a splat."""

import inspect
import os
import re
import sys
import warnings
from contextlib import nullcontext
from dataclasses import MISSING, field, make_dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import tyro

from kgs._support.errors import ArgumentError, DataError, printable, quantity, quoted
from kgs.app.console import VIEWER, as_line, open_in_browser, say, say_next, say_on_terminal
from kgs.fit.config import COARSE, DETAILS, PRESETS, Background, FitConfig, min_side

from .checks import SMALLEST, check_photos, check_photos_of, check_roll, check_side
from .options import QUIET, Flag, IfGiven, Open, Out
from .tools import check_installed, load_tools
from .unposed import check_frames, find_scene, is_posed_by_kgs, on_ctrl_c, open_scene
from .words import options_in

# The short help shows these entries of FitConfig, and all other options of the command but the rare ones.
_OF_CONFIG = ("steps", "drop", "refine_poses", "seed", "device")
_RARE = ("downscale", "background", "lpips_weights", "mask_mode", "roll", "frames", "title", "config")


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
    from kgs.app.files.locks import locked
    from kgs.app.files.outputs import check_folder
    from kgs.app.files.publishing import UNFINISHED
    from kgs.app.files.results_folder import begun_on_cpu, check_fit_files
    from kgs.datasets.folders import CAMERAS_REPORT
    from kgs.datasets.options import check_options
    from kgs.metrics.weights import weight_files

    source = open_scene(scene)
    unposed = source is None
    as_photos = source is None or is_posed_by_kgs(source)
    if measure and (not as_photos or hold_out or views is not None):
        reason = "photos without camera poses, and neither --hold-out nor --views: these hold photos out themselves"
        raise ArgumentError("measure", reason)
    if as_photos and hold_out is None:
        hold_out = 0
    check_roll(roll)
    _check_size(size, downscale, unposed)
    if views is not None and views < 1:
        raise ArgumentError("views", "a whole number of at least 1", views)
    check_options(downscale, hold_out)
    check_frames(frames, scene)
    if lpips_weights is not None:
        weight_files(lpips_weights)
    check_folder(out, scene, make=False)
    with locked(out) if (out / UNFINISHED).is_dir() else nullcontext():
        check_fit_files(out, resume)
    if source is None:
        check_installed("pycolmap")
        pixels = size if isinstance(size, int) else None
        shortest = min_side(config, lpips_weights is not None)
        check_photos(scene, out, views, hold_out, pixels, downscale, frames, shortest)
    else:
        check_photos_of(source)
    if config.init == "scene" and (source is None or source.layout != "Blender"):
        kind = "photos without camera poses" if source is None else f"the layout {source.layout}"
        raise ArgumentError("init", f"another one for {kind}", "'scene', Blender's points")
    if resume and config.device == "auto" and begun_on_cpu(out):
        config = replace(config, device="cpu")  # on a GPU it would go on with other bits
    device = load_tools(config.device, config.backend, "safetensors", "jinja2")
    config = replace(config, device=str(device))

    from kgs._support.machine import device_name
    from kgs.app.fit_folder import fit_folder
    from kgs.app.held_out import MIN_PHOTOS, measure_held_out
    from kgs.app.scene_request import SceneRequest
    from kgs.app.stages import Stages
    from kgs.datasets import load_scene
    from kgs.datasets.field import field_size
    from kgs.fit.pruning import left_out
    from kgs.init_points.files import read_points
    from kgs.metrics.evaluate import as_text
    from kgs.metrics.lpips import Lpips

    if config.init_file is not None:
        with warnings.catch_warnings(action="ignore"):
            read_points(config.init_file)  # an error now, not once there are cameras
    lpips = None if lpips_weights is None else Lpips.load(lpips_weights).to(device)
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
    )
    is_free = size is None and downscale is None  # the size follows from --detail
    say(f"device: {device_name(device)}")
    stages = Stages(say_on_terminal, unposed, measure)
    if is_free and (detail != "normal" or (as_photos and device.type == "cpu")):
        size = DETAILS[detail].size
        if config.coarse is None:
            config = replace(config, coarse=COARSE)
    if preset in ("paper", "plain") and size is None and downscale is None and not as_photos:
        size = "field"
    if source is None:
        stages.begin("cameras")
        assert not isinstance(size, str)  # refused before
        request, source = find_scene(scene, out, request, config.seed, size, frames)
    elif (out / CAMERAS_REPORT).exists():
        raise DataError(
            out, "", "a folder without cameras", "those that kgs found for other photos", advice="choose another folder"
        )
    elif size == "field":
        photo_folder, factor, why = field_size(source)
        say(why)
        request = replace(request, photo_folder=photo_folder, downscale=factor)
    elif isinstance(size, str):
        request = replace(request, photo_folder=size)
    elif size is not None:
        height, width = load_scene(source, photos=False, hold_out=hold_out).train.images.shape[-2:]
        request = replace(request, downscale=max(1.0, max(height, width) / size))
    loaded = request.load(out, say, source)
    height, width = loaded.train.images.shape[-2:]
    if max(height, width) < SMALLEST:
        fault = (f"at least {SMALLEST} pixels", f"photos of {width}x{height}")
        if downscale is None:  # a size that is too small is refused before
            raise DataError(scene, "images", *fault)
        raise ArgumentError("downscale", *fault)
    kept = f"{quantity(len(loaded.train), 'training photo')} of {width}x{height}"
    say(f"{printable(scene)}: {kept}, {len(loaded.test) or 'none'} held out")
    with on_ctrl_c("the cameras that were found are kept" if unposed else ""):
        held_out: dict[str, Any] = {}
        if measure and len(loaded.train) < MIN_PHOTOS:
            say(f"other views are not measured: --measure needs at least {MIN_PHOTOS} photos")
        elif measure:
            stages.begin("measurement")
            held_out, stopped_by = measure_held_out(request, source, len(loaded.train), config, lpips, say)
            if stopped_by:
                say("stopped in the measurement: the fit was not begun", sys.stderr)
                return 128 + stopped_by
        published = fit_folder(
            loaded, config, out, request, resume=resume, lpips=lpips, held_out=held_out, stages=stages
        )
    metrics = published.fit.metrics
    say(as_text(metrics))
    posed = out if unposed else scene
    splat = published.folder / "splat.ply"
    renders = out / "renders"
    say(f"{printable(splat)}: {quantity(metrics['gaussians'], 'Gaussian')} after {quantity(metrics['steps'], 'step')}")
    if needless := left_out(published.fit.decisions):
        say(needless)
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
        f"{as_line('kgs', 'render', splat, '--cameras', posed, '-o', renders)}  # pictures from every camera",
        VIEWER.format(as_line(splat)),
    )
    if open_page:
        open_in_browser(out / "index.html")
    return 0


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


def _check_size(size: int | str | None, downscale: float | None, unposed: bool) -> None:
    """Raise a ValueError unless the photos can have this size."""
    if size is not None and downscale is not None:
        raise ArgumentError("size", "either a size or a downscale factor", "both")
    if isinstance(size, str) and re.fullmatch(r"field|images(_\d+)?", size) is None:
        raise ArgumentError("size", "pixels, field or a folder as images_8", quoted(size))
    if isinstance(size, str) and unposed:
        raise ArgumentError("size", "pixels for photos without camera poses", quoted(size))
    if isinstance(size, int):
        check_side(size)

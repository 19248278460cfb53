"""The command `kgs`, with one subcommand for each thing to do; what goes wrong is one line and an exit code.

Exit codes: 2 for what the user can mend, 1 for a failure, 128 + its number where a signal ended the work.
"""

from __future__ import annotations

import errno
import inspect
import os
import re
import shlex
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

from .errors import DataError, TrainingDiverged
from .fit.config import FAST, FitConfig, Recipe
from .fit.progress import say

__all__ = ["main"]

_BENCHES = {
    "speed": "time and memory of rendering and of training steps",
    "precision": "errors of images, gradients and footprints against time",
    "extremes": "errors, bounds and times of stiff and extreme cases",
    "starts": "depth errors, completeness and times of first points",
    "study": "DropGaussian on and off, its schedules and rivals, over scenes and seeds",
    "training": "test PSNR against time, one setting of a fit at a time",
}
_EXTRAS = {"viser": "view", "pycolmap": "sfm", "distributed": "study", "pandas": "study", "scipy": "study"}
_USERS = {errno.EACCES, errno.EEXIST, errno.EISDIR, errno.ENAMETOOLONG, errno.ENOENT, errno.ENOTDIR, errno.EROFS}
_RESULTS = ("splat.ply", "config.json", "metrics.json", "curve.png")


def main(arguments: list[str] | None = None) -> None:
    """Run one command and exit."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:  # closed: the next file that is opened would be taken for it
            os.open(os.devnull, os.O_RDWR)
    code = _exit_code(list(sys.argv[1:] if arguments is None else arguments))
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, AttributeError):  # nobody reads it; Python would complain on its way out
            with suppress(OSError, AttributeError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    sys.exit(code)


def _exit_code(words: list[str]) -> int:
    message, code, names = "", 2, dict[str, str]()
    try:
        command, prog, words = _find(words)
        names = _flags(command)
        return _call(command, prog, words)
    except SystemExit as stop:
        message, code = (stop.code, 2) if isinstance(stop.code, str) else ("", stop.code or 0)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] == "kgs":
            raise
        extra = _EXTRAS.get((error.name or "").partition(".")[0], "app")
        message = f'{error.name} is missing: run pip install -e ".[{extra}]" in a clone of kgs'
        message += f', or pip install "kgs-splat[{extra}]" where an index has it'
    except DataError as error:
        message = str(error)
    except ValueError as error:
        message = re.sub(r"^(\w+)( \(--[\w-]+\))?(?=:)", lambda name: names.get(name[1], name[0]), str(error))
    except TrainingDiverged as error:
        message, code = f"training diverged: {error}", 1
    except BrokenPipeError:
        code = 0  # head has read what it wanted
    except OSError as error:
        message, code = f"{error.filename or ''}: {error.strerror}".lstrip(": "), 2 if error.errno in _USERS else 1
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and not re.search("allocate|out of memory", str(error)):
            raise
        message, code = f"not enough memory: {error}".partition("\n")[0], 1
    except KeyboardInterrupt:
        code = 130
    if message:
        say(f"kgs: {message}", sys.stderr)
    return code


def _find(words: list[str]) -> tuple[Callable[..., Any], str, list[str]]:
    """The function that does what the first words ask for, what it is called, and the words that are left."""
    commands: dict[str, Callable[..., Any]] = {"demo": demo, "fit": fit, "render": render, "eval": evaluate}
    summaries = {name: (function.__doc__ or "").partition("\n")[0] for name, function in commands.items()}
    summaries["bench"] = "Measure this machine, or what the method is worth; kgs bench --help."
    if words[:1] == ["--version"]:
        from .fit.machine import versions

        raise SystemExit(say("\n".join(f"{name} {version}" for name, version in versions().items())))
    prog, name, rest = "kgs", *_first(words)
    if name == "bench":
        prog, summaries, (name, rest) = "kgs bench", _BENCHES, _first(rest)
    if name in ("-h", "--help"):
        lines = [f"usage: {prog} COMMAND ...", "", *(f"  {each:<10} {text}" for each, text in summaries.items())]
        raise SystemExit(say("\n".join([*lines, "", f"{prog} COMMAND --help lists the options and gives examples."])))
    if name not in summaries:
        raise SystemExit(f"expected a command of {prog}, one of {', '.join(summaries)}, got {name!r}")
    if prog == "kgs":
        return commands[name], f"kgs {name}", rest
    try:
        return getattr(import_module(f"kgs.bench.{name}"), name), f"{prog} {name}", rest
    except (AttributeError, ModuleNotFoundError):
        from .bench.command import bench

        return bench, "kgs bench", ["sparse" if name == "study" else name, *rest]


def _first(words: list[str]) -> tuple[str, list[str]]:
    return (words[0], words[1:]) if words else ("--help", [])


def _flags(function: Callable[..., Any]) -> dict[str, str]:
    """What the parameters of a command are called on the command line."""
    names = {name: name for name in inspect.signature(function).parameters}
    if "config" in names:
        names |= {entry.name: f"recipe.{entry.name}" for entry in fields(Recipe)}
        names |= {entry.name: entry.name for entry in fields(FitConfig)}
    names["train_views"] = "views"
    return {name: "--" + flag.replace("_", "-") for name, flag in names.items()}


def _call(function: Callable[..., Any], prog: str, words: list[str]) -> int:
    """Read the options of a command from its annotations, and run it."""
    import tyro

    marks: dict[str, Any] = {"out": tyro.conf.arg(aliases=("-o",)), "config": tyro.conf.arg(name="")}
    hints = get_type_hints(function, include_extras=True)
    for name, parameter in inspect.signature(function).parameters.items():
        if name in marks and parameter.kind is parameter.KEYWORD_ONLY:
            hints[name] = Annotated[hints[name], marks[name]]
    function.__annotations__ = hints
    if "config" in hints:
        function = partial(function, config=FAST if "--fast" in words else FitConfig())
    result = tyro.cli(function, prog=prog, args=words, config=(tyro.conf.FlagCreatePairsOff,))
    return result if isinstance(result, int) else 0


def demo(
    *,
    out: Path = Path("demo"),
    steps: int = 1200,
    size: tuple[int, int] = (54, 72),
    seed: int = 0,
    device: str = "cpu",
) -> None:
    """Fit three views of a built-in scene without and with DropGaussian, and compare views that were not used.

    For example:
      kgs demo -o demo
      kgs demo -o demo1 --seed 1

    Args:
        out: folder for demo.png, curve.png, metrics.json and splat.ply.
        steps: training steps of each of the two fits; the default takes some 3 minutes on 2 cores.
        size: height and width of the pictures.
        seed: the scene, the first points and both fits derive from it.
        device: cpu, cuda, ...
    """
    from kgs.datasets import synthetic_scene

    from .fit.demo import DEMO, run_demo

    config = replace(DEMO, seed=seed, steps=steps, device=device)
    _prepare(device, "matplotlib")
    runs = run_demo(synthetic_scene(train_views=3, size=size, seed=seed), out, config)
    say(f"\n{'':22}{'PSNR':>8}{'SSIM':>8}{'train PSNR':>12}{'Gaussians':>11}{'seconds':>9}")
    for name, run in runs.items():
        say(
            f"{name + ' DropGaussian':<22}{_shown(run['test']['psnr'], '8.2f')}{run['test']['ssim']:8.3f}"
            f"{_shown(run['train']['psnr'], '12.2f')}{run['gaussians']:11d}{run['seconds']:9.1f}"
        )
    before, after = (runs[name]["test"]["psnr"] for name in ("without", "with"))
    if before is not None and after is not None:
        say(f"\ndifference on test views: {after - before:+.2f} dB (one seed; try --seed 1, 2, ...)")
    say(f"pictures: {out / 'demo.png'}, {out / 'curve.png'}")
    _next({_line(out / "splat.ply"): "opens in any viewer of 3DGS files", "kgs fit SCENE -o OUT": "your own photos"})


def fit(
    scene: Path,
    /,
    *,
    out: Path,
    views: int | None = None,
    downscale: float | None = None,
    background: Literal["black", "white"] = "black",
    fast: bool = False,
    resume: bool = False,
    lpips_weights: Path | None = None,
    config: FitConfig,
) -> int:
    """Turn a folder of posed photos into a splat, with test metrics.

    For example:
      kgs fit fern -o fern-3 --views 3 --downscale 2
      kgs fit fern -o fern-3 --views 3 --downscale 2 --fast

    Args:
        scene: LLFF, COLMAP, Blender or nerfstudio folder.
        out: folder for splat.ply, metrics.json, test/*.png, curve.png, config.json and the checkpoints.
        views: training views, spread over the views that are not held out; all of them unless given.
        downscale: shrink the photos by this factor.
        background: behind photos with transparency.
        fast: a third of the time for 0.1 to 0.5 dB less PSNR of test views: other defaults, see --fast --help.
        resume: continue from the checkpoint in the output folder.
        lpips_weights: folder with VGG16 and LPIPS weights (npz); without it LPIPS is left out.
        config: every number of the fit.
    """
    from .fit.outputs import check_folder
    from .fit.run import fit_scene

    if config.init_file is not None and not config.init_file.is_file():
        raise DataError(config.init_file, "", "expected a point cloud for --init-file, found no such file")
    lpips = _prepare(config.device, "matplotlib", "safetensors", lpips=lpips_weights)
    check_folder(out, _RESULTS, scene, make=False)
    request = {
        "scene": os.path.abspath(scene),
        "train_views": views,
        "downscale": downscale,
        "background": background,
        "points": "model-points" if config.init == "model-points" else "none",
    }
    loaded = _load(request)
    height, width = loaded.train.images.shape[-2:]
    say(f"{scene}: {len(loaded.train)} training and {len(loaded.test)} test views of {width}x{height}")
    if width * height > 1e6 and config.device == "cpu":
        megapixels, minutes = width * height / 1e6, width * height * config.steps / 1.5e9
        say(f"{megapixels:.1f} Mpx on a CPU: expect about {minutes:.0f} minutes; see --downscale")
    metrics, stopped_by = fit_scene(loaded, config, out, resume=resume, lpips=lpips, request=request)
    _print_metrics(metrics)
    splat = out / "splat.ply"
    say(f"{splat}: {metrics['gaussians']} Gaussians after {metrics['steps']} steps")
    if stopped_by:
        _next({"the same command with --resume": "goes on where it stopped"})
        return 128 + stopped_by
    _next(
        {
            _line("kgs", "render", splat, "--cameras", scene, "-o", out / "renders"): "pictures from every camera",
            _line("kgs", "eval", out, "--lpips-weights", "WEIGHTS"): "measure again, with LPIPS",
            _line(splat): "opens in any viewer of 3DGS files",
        }
    )
    return 0


def render(
    ply: Path,
    /,
    *,
    cameras: Path,
    out: Path,
    downscale: float | None = None,
    background: Literal["black", "white"] = "black",
    device: str = "cpu",
) -> None:
    """Render a splat from every camera of a scene into PNGs.

    For example:
      kgs render fern-3/splat.ply --cameras fern -o renders
      kgs render fern-3/splat.ply --cameras fern -o small --downscale 8 --background white

    Args:
        ply: a 3DGS PLY file.
        cameras: the scene (LLFF, COLMAP, Blender or nerfstudio folder) whose cameras to use.
        out: folder for the PNGs, named like the scene's photos; not where these are.
        downscale: shrink the pictures by this factor.
        background: behind the splat.
        device: cpu, cuda, ...
    """
    from kgs.datasets import load_scene

    from .fit.outputs import check_folder
    from .fit.render import render_views

    _prepare(device)
    check_folder(out, (), cameras, make=False)
    scene = load_scene(cameras, None, downscale, background=background, photos=False)
    say(f"{render_views(ply, scene, out, device)} pictures in {out}")


def evaluate(out: Path, /, *, lpips_weights: Path | None = None, device: str = "cpu") -> None:
    """Measure a fit again and bring its metrics.json up to date; what is not measured stays as it is.

    For example:
      kgs eval fern-3
      kgs eval fern-3 --lpips-weights weights

    Args:
        out: the output folder of `kgs fit`.
        lpips_weights: folder with VGG16 and LPIPS weights (npz); without it LPIPS is not measured.
        device: cpu, cuda, ...
    """
    from .fit.metrics import measure_again
    from .fit.outputs import write_json
    from .fit.settings import load_fit
    from .json_files import read_json

    lpips = _prepare(device, lpips=lpips_weights)
    saved, path = load_fit(out, device), out / "metrics.json"
    scene = _load(saved.request)
    metrics = measure_again(path, read_json(path), scene, lambda c: saved.render(c, scene.background), lpips)
    write_json(path, metrics)
    _print_metrics(metrics)
    say(f"{path} is up to date")


def _prepare(device: str, *packages: str, lpips: Path | None = None) -> Any:
    """Make sure before any work that device and packages are there; the perceptual metric, where it is asked for."""
    from .fit.machine import check_device

    check_device(device)
    for package in packages:
        import_module(package)
    if lpips is None:
        return None
    from .fit.lpips import Lpips

    return Lpips.load(lpips).to(device)


def _load(request: dict[str, Any]) -> Any:
    from kgs.datasets import load_scene

    scene = load_scene(
        request["scene"],
        request["train_views"],
        request["downscale"],
        background=request["background"],
        points=request["points"],
    )
    for note in scene.notes:
        say(note)
    return scene


def _print_metrics(metrics: dict[str, Any]) -> None:
    names = {"psnr": "PSNR", "ssim": "SSIM", "ssim_zero_padded": "SSIM (zero padded)", "lpips_vgg": "LPIPS"}
    for part in ("test", "train"):
        values = metrics[part] or {}
        shown = [f"{title} {values[key]:.4g}" for key, title in names.items() if values.get(key) is not None]
        if shown:
            say(f"{part:>5}: " + ", ".join(shown))


def _shown(value: float | None, form: str) -> str:
    return f"{'-':>{form.partition('.')[0]}}" if value is None else f"{value:{form}}"


def _line(*words: object) -> str:
    return shlex.join(map(str, words))


def _next(steps: dict[str, str]) -> None:
    """What a user may want to do now."""
    say("next:")
    for command, reason in steps.items():
        say(f"  {command}  # {reason}")

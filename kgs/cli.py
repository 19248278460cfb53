"""The command `kgs`: finds the subcommand, reads its options, and turns what goes wrong into a line and an exit code.

Exit codes: 2 for what the user can mend, 1 for a failure, 128 + its number where a signal ended the work.
"""

import errno
import inspect
import os
import re
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, replace
from functools import partial
from importlib import import_module
from itertools import pairwise
from typing import Annotated, Any, get_type_hints

from .errors import DataError, TrainingDiverged, printable
from .fit.commands import demo, evaluate, fit
from .fit.config import FAST, PRESETS, FitConfig, Recipe
from .fit.splat_commands import page, render
from .io.console import say

_COMMANDS: dict[str, Callable[..., Any]] = {"demo": demo, "fit": fit, "render": render, "eval": evaluate, "page": page}
_BENCHES = {
    "speed": "time and memory of rendering and of training steps",
    "precision": "errors of images, gradients and footprints against time",
    "extremes": "errors of stiff and extreme cases, and their bounds",
    "starts": "depth errors, completeness and times of first points",
    "study": "DropGaussian on and off, its schedules and rivals, over scenes and seeds",
    "cameras": "how often cameras that kgs fit finds in bare photos are right, wrong or refused",
    "training": "test PSNR against time, one setting of a fit at a time",
}
_EXTRAS = {
    "numba": "fast",
    "pi_heif": "heic",
    "pycolmap": "sfm",
    "distributed": "study",
    "pandas": "study",
    "scipy": "study",
}
_USERS = {errno.EACCES, errno.EEXIST, errno.EISDIR, errno.ENAMETOOLONG, errno.ENOENT, errno.ENOTDIR, errno.EROFS}


def main(arguments: list[str] | None = None) -> None:
    """Run one command and exit."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:  # closed: the next file that is opened would be taken for it
            os.open(os.devnull, os.O_RDWR)
    with warnings.catch_warnings():
        code = _exit_code(list(sys.argv[1:] if arguments is None else arguments))
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, AttributeError):  # nothing reads it any more; Python would complain at exit
            with suppress(OSError, AttributeError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    sys.exit(code)


def _exit_code(words: list[str]) -> int:
    """Run one command; what goes wrong, and what its code warns of, is a line each."""
    message, code, names = "", 2, dict[str, str]()
    warnings.showwarning = lambda text, *_: say(f"kgs: {text}", sys.stderr)
    try:
        command, prog, words = _find(words)
        names = _flags(command)
        return _call(command, prog, words)
    except SystemExit as stop:
        message, code = (stop.code, 2) if isinstance(stop.code, str) else ("", stop.code or 0)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package == "kgs":
            raise
        extra = _EXTRAS.get(package, "app")
        message = f'{error.name} is missing: run pip install -e ".[{extra}]" in a clone of kgs'
        message += f', or pip install "kgs-splat[{extra}]" where an index has it'
    except DataError as error:
        message = str(error)
    except ValueError as error:
        message = re.sub(r"^(\w+)( \(--[\w-]+\))?(?=:)", lambda name: names.get(name[1], name[0]), str(error))
    except TrainingDiverged as error:
        message, code = printable(f"training diverged: {error}"), 1
    except BrokenPipeError:
        code = 0  # head has read what it wanted
    except OSError as error:
        message, code = (
            f"{printable(error.filename or '')}: {error.strerror}".lstrip(": "),
            2 if error.errno in _USERS else 1,
        )
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
    if words[:1] == ["--version"]:
        from .machine import versions

        found = versions()
        found.setdefault("numba", "is not installed: the extra fast brings it")
        say("\n".join(f"{name} {version}" for name, version in found.items()))
        raise SystemExit(0)
    prog, (name, *rest) = "kgs", words or ["--help"]
    summaries = {name: str(function.__doc__).partition("\n")[0] for name, function in _COMMANDS.items()}
    summaries["bench"] = "Measure this machine, or what the method is worth; kgs bench --help."
    if name == "bench":
        prog, summaries, (name, *rest) = "kgs bench", _BENCHES, rest or ["--help"]
    if name in ("-h", "--help"):
        lines = [f"usage: {prog} COMMAND ...", "", *(f"  {each:<10} {text}" for each, text in summaries.items())]
        say("\n".join([*lines, "", f"{prog} COMMAND --help lists the options and gives examples."]))
        raise SystemExit(0)
    if name not in summaries:
        raise SystemExit(f"expected a command of {prog}, one of {', '.join(summaries)}, got {name!r}")
    function = _COMMANDS[name] if prog == "kgs" else getattr(import_module(f"kgs.bench.{name}"), name)
    return function, f"{prog} {name}", rest


def _flags(function: Callable[..., Any]) -> dict[str, str]:
    """What the parameters of a command are called on the command line."""
    names = {"train_views": "views", **{name: name for name in inspect.signature(function).parameters}}
    if "config" in names:
        names |= {entry.name: f"recipe.{entry.name}" for entry in fields(Recipe)}
        names |= {entry.name: entry.name for entry in fields(FitConfig)}
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
        chosen = [word.removeprefix("--preset=") for word in words if word.startswith("--preset=")]
        chosen += [then for word, then in pairwise(words) if word == "--preset"]
        config = PRESETS.get((chosen or ["auto"])[-1], PRESETS["auto"])
        function = partial(
            function, config=replace(config, steps=FAST.steps, coarse=FAST.coarse) if "--fast" in words else config
        )
    result = tyro.cli(function, prog=prog, args=words, config=(tyro.conf.FlagCreatePairsOff,))
    return result if isinstance(result, int) else 0

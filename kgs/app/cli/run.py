"""Finds a command, reads its options, calls it, and turns what goes wrong into a line and an exit code."""

import difflib
import errno
import inspect
import re
import sys
import traceback
import warnings
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

from kgs._support.errors import DataError, TrainingDiverged, printable
from kgs.app.console import as_line, say
from kgs.fit.config import FitConfig, Recipe

from .interrupts import interrupt_as_usual

# The module and the function in it that are a command.
_COMMANDS = {
    "demo": ("kgs.app.cli.demo", "demo"),
    "fit": ("kgs.app.cli.fit", "fit"),
    "render": ("kgs.app.cli.render", "render"),
    "eval": ("kgs.app.cli.evaluate", "evaluate"),
    "page": ("kgs.app.cli.page", "page"),
    "clean": ("kgs.app.cli.clean", "clean"),
    "scale": ("kgs.app.cli.scale", "scale"),
    "export": ("kgs.app.cli.export", "export"),
    "check": ("kgs.app.cli.check", "check"),
    "bench speed": ("kgs.app.cli.bench", "speed"),
    "bench precision": ("kgs.app.cli.bench", "precision"),
    "bench extremes": ("kgs.app.cli.bench", "extremes"),
    "study": ("kgs.study.command", "study"),
}
_HEAVY = ("torch", "kornia", "cv2", "numba")
_EXTRAS = {
    "numba": "fast",
    "pi_heif": "heic",
    "pycolmap": "sfm",
    "distributed": "study",
    "pandas": "study",
    "scipy": "study",
}
USER_ERRORS = {
    errno.EACCES,
    errno.EEXIST,
    errno.EISDIR,
    errno.ENAMETOOLONG,
    errno.ENOENT,
    errno.ENOTDIR,
    errno.EROFS,
}
_OTHER_NAMES = {"train_views": "views"}  # arguments of the library, and their options


def exit_code(words: list[str]) -> int:
    """Run one command; errors and warnings are a line each, on stderr."""
    warnings.showwarning = lambda text, *_: say(f"kgs: {text}", sys.stderr)
    flags: dict[str, str] = {}
    code = 2
    try:
        name, words = _find(words)
        command, defaults = _load(name)
        flags = _flags_of(command)
        call = _parse(command, f"kgs {name}", words, defaults(words))
        _check(name, call)
        for module in _HEAVY:
            _import(module)
        interrupt_as_usual()
        return int(call() or 0)
    except SystemExit as stop:
        if not isinstance(stop.code, str):
            return stop.code or 0
        message = stop.code
    except ModuleNotFoundError as error:
        message = _of_a_missing_package(error)
    except ImportError as error:
        message = _of_a_broken_package(error)
    except DataError as error:
        message = str(DataError(error.path, flags.get(error.field, error.field), error.reason))
    except ValueError as error:
        argument, colon, reason = str(error).partition(":")
        if re.match(r"\w+: ", str(error)) is None and " expected " not in str(error):
            raise  # a mistake in kgs: messages for users begin with a name
        message = printable(flags.get(argument, argument) + colon + reason)
    except TrainingDiverged as error:
        message = printable(f"training diverged: {error}")
        code = 1
    except BrokenPipeError:
        return 0  # the reader has what it wanted
    except OSError as error:
        prefix = f"{printable(error.filename)}: " if error.filename else ""
        message = f"{prefix}{error.strerror}"
        code = 2 if error.errno in USER_ERRORS else 1
    except (MemoryError, RuntimeError) as error:
        if not _is_out_of_memory(error):
            raise
        message = f"not enough memory: {error}".partition("\n")[0]
        code = 1
    except KeyboardInterrupt as stop:
        message = f"stopped: {stop}" if str(stop) else "stopped"
        code = 130
    finally:
        interrupt_as_usual()
    say(f"kgs: {message}", sys.stderr)
    return code


def _is_out_of_memory(error: Exception) -> bool:
    """Whether memory was too short; torch and CUDA say so in a RuntimeError."""
    return isinstance(error, MemoryError) or any(cause in str(error) for cause in ("allocate", "of memory"))


def _of_a_missing_package(error: ModuleNotFoundError) -> str:
    """Message for a package that is not installed; it names the extra that brings it."""
    package = (error.name or "").partition(".")[0]
    if package == "kgs":
        raise error
    if package == "triton":  # torch brings it
        return str(error)
    extra = _EXTRAS.get(package, "app")
    return (
        f'{error.name} is missing: run pip install -e ".[{extra}]" in a clone of kgs, '
        f'or pip install "kgs-splat[{extra}]" where an index has it'
    )


def _import(module: str) -> None:
    """Import a large package. A missing one, or a broken numba, is left to the command that needs it."""
    try:
        import_module(module)
    except ModuleNotFoundError:
        pass
    except (ImportError, OSError) as error:  # torch loads its libraries itself
        if module != "numba":
            raise ImportError(str(error), name=module) from error


def _of_a_broken_package(error: ImportError) -> str:
    """Message for an installed package that fails to import."""
    names = [frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__)]
    tops = [name.partition(".")[0] for name in [error.name or "", *names]]
    package = next((top for top in tops if top not in ("", "kgs", *sys.stdlib_module_names)), "")
    if not package:  # a mistake in kgs
        raise error
    from importlib.metadata import packages_distributions

    project = packages_distributions().get(package, [package])[0]
    reason = printable(str(error).strip().partition("\n")[0].rstrip("."))
    return (
        f"{package} is installed, but cannot be loaded ({reason}): run pip install --force-reinstall {project} "
        f"(of the extra {_EXTRAS.get(package, 'app')})"
    )


def _find(words: list[str]) -> tuple[str, list[str]]:
    """Split the words of a command line into the name of the command and the rest."""
    if words[:1] == ["--version"]:
        _say_versions()
        raise SystemExit(0)
    group = "bench" if words[:1] == ["bench"] else ""
    prefix = f"{group} " if group else ""
    name, *rest = words[len(prefix.split()) :] or ["--help"]
    names = [each.removeprefix(prefix) for each in _COMMANDS if each.startswith(prefix)]
    if name in ("-h", "--help"):
        _say_commands(prefix)
        raise SystemExit(0)
    if name not in names:
        known = list(dict.fromkeys(each.partition(" ")[0] for each in names))
        near = difflib.get_close_matches(name, known, 1)
        meant = f": did you mean {near[0]}?" if near else ""
        whole = f"kgs {group}".strip()
        raise SystemExit(f"expected a command of {whole}, one of {', '.join(known)}, got {printable(name)!r}{meant}")
    return prefix + name, rest


def _say_versions() -> None:
    from kgs._support.machine import versions

    lines = {"numba": "is not installed: the extra fast brings it", **versions()}
    say("\n".join(f"{name} {version}" for name, version in lines.items()))


def _say_commands(prefix: str) -> None:
    lines = [f"usage: kgs {prefix}COMMAND ...", ""]
    for name in _COMMANDS:
        if name.startswith(prefix):
            summary = str(_load(name)[0].__doc__).partition("\n")[0]
            lines.append(f"  {name.removeprefix(prefix):<16} {summary}")
    say("\n".join([*lines, "", f"kgs {prefix}COMMAND --help lists the options and gives examples."]))


def _load(name: str) -> tuple[Callable[..., Any], Callable[[list[str]], dict[str, Any]]]:
    """The function of a command, and the function that derives defaults from its words."""
    module, function = _COMMANDS[name]
    home = import_module(module)
    return getattr(home, function), getattr(home, "defaults", lambda _: {})


def _check(name: str, call: partial[Any]) -> None:
    """Report mistakes that need no torch."""
    module, function = _COMMANDS[name]
    check = getattr(import_module(module), f"check_{function}", None)
    if check is not None:
        bound = inspect.signature(call.func).bind(*call.args, **call.keywords)
        bound.apply_defaults()
        check(**bound.arguments)


def _flags_of(command: Callable[..., Any]) -> dict[str, str]:
    """The options of a command by the names of arguments, which errors of the library begin with."""
    parameters = inspect.signature(command).parameters
    recipe = [entry.name for entry in fields(Recipe)] if "config" in parameters else []
    config = [entry.name for entry in fields(FitConfig)] if "config" in parameters else []
    own = [name for name, parameter in parameters.items() if parameter.kind is parameter.KEYWORD_ONLY]
    paths = {
        **{name: f"recipe.{name}" for name in recipe},
        **{f"recipe.{name}": f"recipe.{name}" for name in recipe},
        **{name: name for name in (*config, *own)},  # `steps` is that of the fit
        **_OTHER_NAMES,
    }
    return {name: "--" + path.replace("_", "-") for name, path in paths.items()}


def _check_out(command: Callable[..., Any], prog: str, words: list[str]) -> None:
    """Refuse a command line that lacks nothing but the folder for the results, and suggest one."""
    out = inspect.signature(command).parameters.get("out")
    asked = ("--out", "-h", "--help", "--help-all", "--help_all")
    is_given = any(word in asked or word.startswith("--out=") or word[:2] == "-o" for word in words)
    is_needed = out is not None and out.kind is out.KEYWORD_ONLY and out.default is out.empty
    if is_given or not is_needed or "--" in words or not words or words[0].startswith("-"):
        return
    if not words[0]:
        raise ValueError(f"{next(iter(inspect.signature(command).parameters))}: expected a path, got ''")
    name = f"{Path(words[0]).resolve().stem}-{prog.rpartition(' ')[2]}"
    whole = as_line(*prog.split(), *words, "-o", name)
    raise SystemExit(f"-o: expected a folder for the results, for example {whole}")


def _parse(command: Callable[..., Any], prog: str, words: list[str], defaults: dict[str, Any]) -> partial[Any]:
    """Read the options; returns the call that they ask for, once its input paths are there."""
    import tyro

    from .options import EXISTS, PATHS, EmptyPath, describe, has_short_help, options_in, short

    _check_out(command, prog, words)
    asked = options_in(words)
    if {"--help-all", "--help_all"} & {*asked}:
        words = ["--help" if word in ("--help-all", "--help_all") else word for word in asked]
    elif has_short_help(command) and {"-h", "--help"} & {*asked}:
        try:
            plain = (tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone)
            tyro.cli(short(command, defaults["config"]), prog=prog, args=["--help"], config=plain)
        finally:
            say(f"{prog} --help-all shows all options")

    markers = [tyro.conf.FlagCreatePairsOff]
    if not has_short_help(command):
        markers.append(tyro.conf.DisallowNone)  # an option that is not given is None

    def bind(*arguments: Any, **options: Any) -> partial[Any]:
        bound = inspect.signature(command).bind(*arguments, **options)
        for name, value in bound.arguments.items():
            hint = command.__annotations__[name]
            path = value if any(EXISTS in get_args(part) for part in (hint, *get_args(hint))) else None  # or optional
            if isinstance(value, FitConfig):
                name, path = "init_file", value.init_file
            if EmptyPath in (type(value), type(path)):
                raise ValueError(f"{name}: expected a path, got ''")
            if path is not None and not path.exists():
                raise DataError(path, "", f"expected {EXISTS}, found none")
        return partial(command, *arguments, **options)

    describe(bind, command)
    function = partial(bind, **defaults) if defaults else bind
    with PATHS:
        call: partial[Any] = tyro.cli(function, prog=prog, args=words, config=markers)
    return call

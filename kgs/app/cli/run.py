"""Finds a command, reads its options, calls it, and turns what goes wrong into a line and an exit code.

tyro reads one command at a time. With its subcommands `kgs --help` would have 100 lines, and take more than twice as
long, because the options of all commands would be read.
"""

import difflib
import errno
import inspect
import pkgutil
import re
import signal
import sys
import traceback
import warnings
from collections.abc import Callable
from dataclasses import fields
from functools import partial, wraps
from itertools import takewhile
from pathlib import Path
from typing import Any

from kgs._support.errors import ArgumentError, DataError, PhotosRefused, TrainingDiverged, listed, printable
from kgs.app.console import as_line, log_shown, quiet, say
from kgs.fit.config import FitConfig, Recipe

from .interrupts import interrupt_as_usual
from .tools import explain_import_error
from .words import options_in, take_quiet

COMMANDS = {
    "demo": "kgs.app.cli.demo:demo",
    "fit": "kgs.app.cli.fit:fit",
    "poses": "kgs.app.cli.poses:poses",
    "render": "kgs.app.cli.render:render",
    "eval": "kgs.app.cli.evaluate:evaluate",
    "page": "kgs.app.cli.page:page",
    "clean": "kgs.app.cli.clean:clean",
    "scale": "kgs.app.cli.scale:scale",
    "export": "kgs.app.cli.export:export",
    "check": "kgs.app.cli.check:check",
    "bench speed": "kgs.app.cli.bench:speed",
    "bench precision": "kgs.app.cli.bench:precision",
    "bench extremes": "kgs.app.cli.bench:extremes",
    "study": "kgs.study.command:study",
}
FAILED = 1  # a package, memory or disk space was missing, training diverged, or kgs check found something wrong
WRONG_WORDS = 2  # as of tyro
WRONG_FILE = 3
REFUSED_PHOTOS = 4
BUG = 70  # EX_SOFTWARE of sysexits.h
_USER_ERRORS = {
    errno.EACCES,
    errno.EEXIST,
    errno.EISDIR,
    errno.ENAMETOOLONG,
    errno.ENOENT,
    errno.ENOTDIR,
    errno.EROFS,
}
_NO_MEMORY = re.compile("DefaultCPUAllocator: (can't allocate|not enough) memory")
_HELP_ALL = {"--help-all", "--help_all"}
_HELP = {"-h", "--help", "help"}


def exit_code(words: list[str]) -> int:
    """Run one command; errors and warnings are a line each, on stderr. docs/command.md lists the codes."""
    warnings.showwarning = lambda text, *_: say(f"kgs: {text}", sys.stderr)
    flags: dict[str, str] = {}
    try:
        words, is_quiet = take_quiet(words)
        name, words = _find(words)
        command = load_command(name)
        flags = _flags_of(command)
        call = _parse(command, name, words)
        with quiet(is_quiet), log_shown():
            return int(call() or 0)
    except SystemExit as stop:
        if not isinstance(stop.code, str):
            return stop.code or 0
        code = WRONG_WORDS
        message = stop.code
    except BrokenPipeError:
        return 0  # the reader has what it wanted
    except KeyboardInterrupt as stop:
        code = 128 + signal.SIGINT
        message = f"stopped: {stop}" if str(stop) else "stopped"
    except Exception as error:
        code, message = _explain(error, flags)
    finally:
        interrupt_as_usual()
    say(f"kgs: {message}", sys.stderr)
    return code


def _explain(error: Exception, flags: dict[str, str]) -> tuple[int, str]:
    """The exit code and the line of an error; what is no mistake of the user shows its traceback, too.

    A mistake of the user is known by its class, :class:`kgs.ArgumentError` or :class:`kgs.DataError`.
    """
    match error:
        case DataError():
            code = REFUSED_PHOTOS if isinstance(error, PhotosRefused) else WRONG_FILE
            return code, str(error)
        case ArgumentError():
            name = flags.get(error.name, error.name)
            return WRONG_WORDS, str(ArgumentError(name, error.expected, error.got, advice=error.advice))
        case ImportError() if explanation := explain_import_error(error):
            return FAILED, explanation
        case TrainingDiverged():
            return FAILED, printable(f"training diverged: {error}")
        case OSError():
            code = WRONG_FILE if error.errno in _USER_ERRORS else FAILED
            prefix = f"{printable(error.filename)}: " if error.filename else ""
            return code, prefix + (error.strerror or printable(error))
        case _ if _is_of_memory(error):
            return FAILED, f"not enough memory: {error}".partition("\n")[0]
    say("".join(traceback.format_exception(error)).rstrip(), sys.stderr)
    return BUG, "this is a mistake in kgs: please report it, with the lines above and those of kgs check"


def _is_of_memory(error: Exception) -> bool:
    """Whether memory ran out, as Python, a GPU or torch's allocator of the CPU says it."""
    torch = sys.modules.get("torch")
    of_gpu = torch is not None and isinstance(error, torch.OutOfMemoryError)
    of_cpu = isinstance(error, RuntimeError) and _NO_MEMORY.search(str(error)) is not None
    return isinstance(error, MemoryError) or of_gpu or of_cpu


def _find(words: list[str]) -> tuple[str, list[str]]:
    """Split the words of a command line into the name of the command and the rest."""
    if words[:1] in (["--version"], ["-V"]):
        _say_versions()
        raise SystemExit(0)
    prefix = "bench " if words[:1] == ["bench"] else ""
    name, *rest = words[len(prefix.split()) :] or ["--help"]
    if name == "help" and rest:
        return _find([*prefix.split(), *rest, "--help"])
    if name in _HELP:
        _say_commands(prefix)
        raise SystemExit(0)
    if prefix + name in COMMANDS:
        return prefix + name, rest
    names = [each.removeprefix(prefix).partition(" ")[0] for each in COMMANDS if each.startswith(prefix)]
    known = list(dict.fromkeys(names))
    near = difflib.get_close_matches(name, known, 1)
    meant = f": did you mean {near[0]}?" if near else ""
    group = f"kgs {prefix}".strip()
    raise SystemExit(f"expected a command of {group}, one of {', '.join(known)}, got {printable(name)!r}{meant}")


def _say_versions() -> None:
    from kgs._support.machine import versions

    lines = {"numba": "is not installed: the extra fast brings it", **versions()}
    say("\n".join(f"{name} {version}" for name, version in lines.items()))


def _say_commands(prefix: str) -> None:
    lines = [f"usage: kgs {prefix}COMMAND ...", ""]
    for name in COMMANDS:
        if name.startswith(prefix):
            summary = str(load_command(name).__doc__).partition("\n")[0]
            lines.append(f"  {name.removeprefix(prefix):<16} {summary}")
    lines += ["", f"kgs {prefix}COMMAND --help lists the options and gives examples."]
    lines += ["-q, with any command: only errors and warnings are printed. kgs -V prints versions."]
    say("\n".join(lines))


def load_command(name: str) -> Callable[..., Any]:
    """The function that is a command."""
    command: Callable[..., Any] = pkgutil.resolve_name(COMMANDS[name])
    # tyro keeps the line breaks of a function's docstring: describe each argument in one line
    command.__doc__ = re.sub(r"\n {8}(?=\S)", " ", inspect.cleandoc(command.__doc__ or ""))
    return command


def _flags_of(command: Callable[..., Any]) -> dict[str, str]:
    """The options of a command by the names of arguments, which errors of the library begin with."""
    parameters = inspect.signature(command).parameters.values()
    own = [parameter.name for parameter in parameters if parameter.kind is parameter.KEYWORD_ONLY]
    paths = {name: name for name in own}
    if "config" in own:
        recipe = {entry.name: f"recipe.{entry.name}" for entry in fields(Recipe)}
        config = {entry.name: entry.name for entry in fields(FitConfig)}
        paths = {**recipe, **{path: path for path in recipe.values()}, **config, **paths}  # `steps` is that of the fit
    paths["train_views"] = "views"
    return {name: "--" + path.replace("_", "-") for name, path in paths.items()}


def _check_one_path(command: Callable[..., Any], words: list[str]) -> None:
    """Refuse several files where one path is expected: a shell makes them of PHOTOS/*.jpg."""
    parameters = inspect.signature(command).parameters.values()
    given = [*takewhile(lambda word: not word.startswith("-"), words)]
    is_one = sum(parameter.kind is not parameter.KEYWORD_ONLY for parameter in parameters) == 1
    if is_one and len(given) > 1 and all(Path(word).exists() for word in given):
        names = listed([Path(word).name for word in given], 3)
        raise SystemExit(f"expected one path, got {len(given)} ({names}). For photos, name their folder")


def _check_out(command: Callable[..., Any], name: str, words: list[str]) -> None:
    """Refuse a command line that lacks nothing but the folder for the results, and suggest one."""
    out = inspect.signature(command).parameters.get("out")
    asked = {"--out", *_HELP, *_HELP_ALL}
    is_given = any(word in asked or word.startswith("--out=") or word[:2] == "-o" for word in words)
    is_needed = out is not None and out.kind is out.KEYWORD_ONLY and out.default is out.empty
    if is_given or not is_needed or "--" in words or not words or words[0].startswith("-"):
        return
    if not words[0]:
        raise ArgumentError(next(iter(inspect.signature(command).parameters)), "a path", "''")
    folder = f"{Path(words[0]).resolve().stem}-{name.rpartition(' ')[2]}"
    whole = as_line("kgs", *name.split(), *words, "-o", folder)
    raise SystemExit(f"-o: expected a folder for the results, for example {whole}")


def _parse(command: Callable[..., Any], name: str, words: list[str]) -> partial[Any]:
    """Read the options, or say what they are; returns the call that they ask for."""
    import tyro

    from .options import EMPTY, PATHS

    _check_one_path(command, words)
    _check_out(command, name, words)
    prog = f"kgs {name}"
    asked = {*options_in(words)}
    plain = (tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone)  # an option that is not given is None

    @wraps(command)
    def bind(*arguments: Any, **options: Any) -> partial[Any]:
        bound = inspect.signature(command).bind(*arguments, **options).arguments
        config = bound.get("config")
        for option, value in [*bound.items(), ("init_file", config and config.init_file)]:
            if value is EMPTY:
                raise ArgumentError(option, "a path", "''")
        return partial(command, *arguments, **options)

    function: Callable[..., partial[Any]] = bind
    if name == "fit":
        from .fit import first_config, short_help

        config = first_config(words)
        if asked & _HELP and not asked & _HELP_ALL:
            try:
                tyro.cli(short_help(config), prog=prog, args=["--help"], config=plain)
            finally:
                say(f"{prog} --help-all shows all options. -q: only errors and warnings are printed.")
        function = partial(bind, config=config)
    with PATHS:
        return tyro.cli(
            function,
            prog=prog,
            args=["--help"] if asked & _HELP_ALL else words,
            config=plain[:1] if name == "fit" else plain,  # None undoes what a preset sets
        )

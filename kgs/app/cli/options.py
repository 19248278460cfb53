"""Types of options that several commands share, and what `--help` says of a command's options."""

import inspect
import re
from collections.abc import Callable
from dataclasses import fields, make_dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import tyro

from kgs.fit.config import FitConfig

EXISTS = "a file or folder that is there"  # marks paths that are looked for before torch is loaded
Existing = Annotated[Path, EXISTS]
Out = Annotated[Path, tyro.conf.arg(aliases=("-o",))]


class EmptyPath(type(Path())):  # type: ignore[misc]  # the class of this system's paths
    """What "" on a command line becomes: a `Path` would be the current folder."""


PATHS = tyro.constructors.ConstructorRegistry()


@PATHS.primitive_rule
def _path(type_info: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec[Path] | None:
    if type_info.type is not Path:
        return None
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH",
        instance_from_str=lambda words: Path(words[0]) if words[0] else EmptyPath(),
        is_instance=lambda value: isinstance(value, Path),
        str_from_instance=lambda path: [str(path)],
    )


def options_in(words: list[str]) -> list[str]:
    """The words among which there are options: those after a "--" are none."""
    return words[: words.index("--")] if "--" in words else words


# The short help shows these entries of FitConfig, and all other options of the command but the rare ones.
_OF_A_FIT = ("steps", "drop", "refine_poses", "seed", "device")
_RARE = ("downscale", "lpips_weights", "mask_mode", "frames", "title", "live")


def has_short_help(command: Callable[..., Any]) -> bool:
    """Whether `--help` shows only some of the command's options, and `--help-all` all: where a fit is configured."""
    return "config" in inspect.signature(command).parameters


def short(command: Callable[..., Any], config: FitConfig) -> Callable[..., Any]:
    """A stand-in for the command whose help lacks what few people need, with the numbers of `config`."""
    entries = list[tuple[str, Any]]()
    for name, hint in get_type_hints(FitConfig, include_extras=True).items():
        is_shown = name in _OF_A_FIT
        entries.append((name, _quiet(hint, getattr(config, name)) if is_shown else Annotated[hint, tyro.conf.Suppress]))
    kind: type[Any] = make_dataclass("ShortConfig", entries)
    kind.__doc__ = FitConfig.__doc__

    def shortened(**_: Any) -> None:
        """Never called: tyro prints the help and exits."""

    hints = {name: Annotated[command.__annotations__[name], tyro.conf.Suppress] for name in _RARE}
    describe(shortened, command, config=Annotated[kind, tyro.conf.arg(name="")], **hints)
    return partial(shortened, config=kind(**{entry.name: getattr(config, entry.name) for entry in fields(FitConfig)}))


def describe(function: Callable[..., Any], command: Callable[..., Any], **hints: Any) -> None:
    """Have tyro read the options of `command`, and what its help says of them, from another function.

    Args:
        function: gets signature, annotations and docstring.
        command: has them.
        hints: annotations that replace those of the command, by the names of its parameters.
    """
    signature = inspect.signature(command)
    parameters = [
        each.replace(annotation=_quiet(hints.get(name, each.annotation), each.default))
        for name, each in signature.parameters.items()
    ]
    function.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]  # inspect's own way
    function.__annotations__ = {each.name: each.annotation for each in parameters}
    # tyro keeps the line breaks of a function's docstring: describe each argument in one line
    function.__doc__ = re.sub(r"\n {8}(?=\S)", " ", inspect.cleandoc(command.__doc__ or ""))


def _quiet(hint: Any, default: Any) -> Any:
    """The annotation, such that the help leaves out "(default: None)", and "(default: True)" of a flag `--no-...`."""
    return Annotated[hint, tyro.conf.arg(help_behavior_hint="")] if default is None or default is True else hint

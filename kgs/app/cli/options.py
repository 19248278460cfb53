"""Types of options that several commands share."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeVar

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from kgs._support.errors import DataError

Value = TypeVar("Value")
QUIET = tyro.conf.arg(help_behavior_hint="")  # the help leaves out "(default: None)" or False
IfGiven = Annotated[Value | None, QUIET]
Flag = Annotated[bool, QUIET]
Open = Annotated[bool, tyro.conf.arg(name="open", help_behavior_hint="")]

EMPTY = Path()  # what "" on a command line becomes: this object. An equal one is the current folder.


def _read_input(words: list[str]) -> Path:
    path = _read_output(words)
    if path is not EMPTY and not path.exists():
        raise DataError(path, "", "a file or folder", "none")
    return path


def _read_output(words: list[str]) -> Path:
    return Path(words[0]) if words[0] else EMPTY


def _constructor(read: Callable[[list[str]], Path]) -> PrimitiveConstructorSpec[Path]:
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH",
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, Path),
        str_from_instance=lambda path: [str(path)],
    )


Out = Annotated[Path, _constructor(_read_output), tyro.conf.arg(aliases=("-o",))]
PATHS = ConstructorRegistry()  # every other path of a command is one that is read


@PATHS.primitive_rule
def _path(type_info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Path] | None:
    return _constructor(_read_input) if type_info.type is Path else None

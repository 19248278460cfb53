"""Kinds of options that several commands have, and which of those of a fit a newcomer is shown."""

import inspect
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

# All options work; these alone of FitConfig, and all but these of a command's own, stand in the short help.
_OF_A_FIT = ("steps", "drop", "refine_poses", "seed", "device")
_RARE = ("downscale", "lpips_weights")


def has_short_help(command: Callable[..., Any]) -> bool:
    """Whether a command has so many options that `--help` shows some of them, and `--help-all` all."""
    return "config" in inspect.signature(command).parameters


def short(command: Callable[..., Any], config: FitConfig) -> Callable[..., Any]:
    """The same command to tyro, for its help: without what few people need, with the numbers of `config`."""
    hints = get_type_hints(FitConfig, include_extras=True)
    shown = {name: hint if name in _OF_A_FIT else Annotated[hint, tyro.conf.Suppress] for name, hint in hints.items()}
    kind: type[Any] = make_dataclass("Shown", [(entry.name, shown[entry.name]) for entry in fields(FitConfig)])
    kind.__doc__ = FitConfig.__doc__

    def shortened(**_: Any) -> None:
        """Never called: tyro prints the help and exits."""

    whole = inspect.signature(command)
    rare = {name: Annotated[command.__annotations__[name], tyro.conf.Suppress] for name in _RARE}
    shortened.__annotations__ = command.__annotations__ | rare | {"config": Annotated[kind, tyro.conf.arg(name="")]}
    shortened.__doc__ = command.__doc__
    parameters = [each.replace(annotation=shortened.__annotations__[name]) for name, each in whole.parameters.items()]
    shortened.__signature__ = whole.replace(parameters=parameters)  # type: ignore[attr-defined]  # inspect's own way
    return partial(shortened, config=kind(**{entry.name: getattr(config, entry.name) for entry in fields(FitConfig)}))

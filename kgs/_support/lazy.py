"""Public names that a package loads on first use: `import kgs` takes milliseconds, and torch seconds."""

import sys
from importlib import import_module

TYPE_CHECKING = False  # type checkers take it as True; importing `typing` would cost more than all the rest here
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any


def lazy_names(
    package: str, homes: dict[str, tuple[str, ...]]
) -> "tuple[Callable[[str], Any], Callable[[], list[str]]]":
    """The functions `__getattr__` and `__dir__` of a package (PEP 562).

    For type checkers the package imports the same names under `if TYPE_CHECKING`.

    Args:
        package: its `__name__`.
        homes: the public names of each module, by the full name of the module. Modules of the package itself are
            attributes, too.

    Returns:
        `__getattr__`, which imports a name's module and returns the name, and `__dir__`. Where a package of an extra
        is missing, the ModuleNotFoundError names the extra.

    Examples:
        >>> __getattr__, __dir__ = lazy_names("kgs", {"kgs.drop": ("DropGaussian", "drop_gaussian")})
        >>> __getattr__("DropGaussian").__name__
        'DropGaussian'
    """
    modules = {name: module for module, names in homes.items() for name in names}

    def load(module: str) -> "Any":
        try:
            return import_module(module)
        except ModuleNotFoundError as error:
            from .extras import missing

            if (error.name or "kgs").partition(".")[0] == "kgs":
                raise
            raise ModuleNotFoundError(missing(error.name or ""), name=error.name) from error

    def __getattr__(name: str) -> "Any":
        if name in modules:
            return getattr(load(modules[name]), name)
        if f"{package}.{name}" in homes:
            return import_module(f"{package}.{name}")
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    def __dir__() -> list[str]:
        return sorted({*vars(sys.modules[package]), *modules})

    return __getattr__, __dir__

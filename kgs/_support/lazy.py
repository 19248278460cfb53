"""Public names that a package loads on first use: `import kgs` takes milliseconds, and torch seconds."""

import lazy_loader

TYPE_CHECKING = False  # type checkers take it as True; importing `typing` would cost more than all the rest here
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any


def public_names(package: str, file: str) -> "tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]":
    """`__getattr__`, `__dir__` and `__all__` of a package, from its stub `__init__.pyi`.

    The stub is what type checkers read: public names are written there, and nowhere else (PEP 562; SPEC 1 of Scientific
    Python).

    Args:
        package: its `__name__`.
        file: its `__file__`.

    Returns:
        Of these, `__getattr__` imports the module of a name, and returns the name. Where a package of an extra is
        missing, the ModuleNotFoundError names the extra.

    Examples:
        >>> import kgs
        >>> __getattr__, __dir__, __all__ = public_names("kgs", kgs.__file__)
        >>> __getattr__("DropGaussian").__name__
        'DropGaussian'
    """
    load, names, public = lazy_loader.attach_stub(package, file)

    def __getattr__(name: str) -> "Any":
        try:
            return load(name)
        except ModuleNotFoundError as error:
            from .extras import missing

            if (error.name or "kgs").partition(".")[0] == "kgs":
                raise
            raise ModuleNotFoundError(missing(error.name or ""), name=error.name) from error

    return __getattr__, names, public

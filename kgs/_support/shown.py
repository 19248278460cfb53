"""How containers of tensors are printed: by shapes, since their numbers fill a screen. What is None is left out."""

from dataclasses import fields
from typing import Any

from torch import Tensor


class ShownByShapes:
    """Base of a dataclass (with `repr=False`) whose tensors `print` shows as their shapes."""

    def __repr__(self) -> str:
        values = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        shown = [f"{name}={_shown(value)}" for name, value in values.items() if value is not None]
        return f"{type(self).__name__}({', '.join(shown)})"


def _shown(value: Any) -> str:
    if isinstance(value, Tensor):
        return str(tuple(value.shape))
    text = repr(value)
    return text if len(text) <= 80 or isinstance(value, ShownByShapes) else f"{text[:77]}..."

"""What is refused: the class of the error, and what its fields say."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest


@contextmanager
def refused(kind: type[Exception], **fields: Any) -> Iterator[pytest.ExceptionInfo[Exception]]:
    """The block raises an error of this very class, with these fields: `name`, or `path` and `key`, and others."""
    with pytest.raises(kind) as caught:
        yield caught
    assert type(caught.value) is kind
    assert {name: getattr(caught.value, name) for name in fields} == fields

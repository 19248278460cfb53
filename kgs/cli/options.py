"""Kinds of options that several commands have."""

from pathlib import Path
from typing import Annotated

import tyro

EXISTS = "a file or folder that is there"  # marks paths that are looked for before torch is loaded
Existing = Annotated[Path, EXISTS]
Out = Annotated[Path, tyro.conf.arg(aliases=("-o",))]

"""Sizes of tiles and of chunks change the time of a render, not its image, but for rounding."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from kgs.bench.precision import DEFAULT, EXACT, SCENES

SHAPES: dict[str, list[dict[str, Any]]] = {
    "tiles 4 to 16": [{"tile_size": t} for t in (4, 8, 16)],
    "tiles 4 to 64": [{"tile_size": t} for t in (4, 8, 16, 32, 64)],
    "chunks 4 to 256": [{"chunk_size": k} for k in (4, 16, 64, 256)],
}
BOUNDS = {"needles": (2e-5, 2e-4)}  # of tiles to 16 and to 64 pixels, whose rounding grows with the square of the side


@pytest.mark.parametrize(("count", "size"), [(300, 48), pytest.param(3000, 96, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", SCENES)
def test_tiles_and_chunks_do_not_change_the_image(
    name: str, count: int, size: int, record_property: Callable[[str, object], None]
) -> None:
    scene, found = SCENES[name](count, size), {}
    for start, label in ((EXACT, "exact"), (DEFAULT, "default")):
        for shape, changes in SHAPES.items():
            images = torch.stack([scene.image(replace(start, **change)) for change in changes])
            found[f"{shape}, {label}"] = float((images.amax(0) - images.amin(0)).max())
    record_property("flatness", {"name": name, "trials": count, **found})
    small, large = BOUNDS.get(name, (3e-6, 5e-5))
    assert found["tiles 4 to 16, exact"] <= small
    assert found["tiles 4 to 64, exact"] <= large
    assert found["chunks 4 to 256, exact"] == found["chunks 4 to 256, default"] == 0

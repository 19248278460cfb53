"""Held-out quality against training time: one knob of the fit at a time, on the study's grid."""

from __future__ import annotations

from pathlib import Path

__all__ = ["training"]


def training(
    *,
    out: Path,
    quick: bool = False,
    processes: int | None = None,
    scheduler: str | None = None,
) -> int:
    """Test PSNR against time, one knob of the fit at a time (hours; goes on where it stopped).

    For example:
      kgs bench training -o training
      KGS_DATA=SCENES kgs bench training -o training --processes 2

    Writes training.jsonl, training.csv, training.md and training.png. With KGS_DATA, a folder of scenes, also on fern.

    Args:
        out: folder for the results; cells that its training.jsonl has are not repeated.
        quick: two tiny cells, to see that it works.
        processes: fits at a time, one per core unless given; the seconds of a fit hold for that many at a time.
        scheduler: address of a Dask scheduler whose workers run the cells instead.
    """
    from .study.grid import run_grid
    from .study.knobs import fit_cell, knob_cells, write_knobs

    cells = knob_cells(quick)
    rows = run_grid(cells, fit_cell, out / "training.jsonl", scheduler=scheduler, processes=processes)
    if rows:
        print(write_knobs(rows, out))
    return int(len(rows) < len(cells))

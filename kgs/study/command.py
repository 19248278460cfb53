"""`kgs study`: what DropGaussian is worth."""

import os
import sys
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import tyro

from kgs._support.errors import ArgumentError, DataError, quoted
from kgs.app.cli.options import IfGiven, Out
from kgs.app.cli.tools import check_installed, load_tools
from kgs.app.files.results import Results
from kgs.fit.config import FitConfig


def study(
    *,
    out: Out,
    preset: Literal["quick", "cpu", "field", "paper", "guard"] = "quick",
    processes: IfGiven[int] = None,
    scheduler: IfGiven[str] = None,
    lpips_weights: IfGiven[Path] = None,
    report_only: bool = False,
    scenes: IfGiven[tuple[str, ...]] = None,
    methods: IfGiven[tuple[str, ...]] = None,
    views: IfGiven[tuple[int, ...]] = None,
    seeds: IfGiven[tuple[int, ...]] = None,
    table: IfGiven[int] = None,
    steps: IfGiven[int] = None,
    list_cells: Annotated[bool, tyro.conf.arg(name="list")] = False,
) -> int:
    """Compare fits with and without DropGaussian, its schedules and rivals, over scenes and seeds.

    For example:
      kgs study -o study
      KGS_DATA=SCENES kgs study -o study-field --preset field --scenes llff/fern --seeds 0 --list

    Writes sparse.jsonl, a line per finished fit, and the report, also when it is interrupted; the same
    command goes on where it stopped. For many machines: `dask scheduler` on one, `dask worker ADDRESS --nthreads 1` on
    each, and --scheduler; docs/sparse-views.md has more on it.

    Args:
        out: folder for the results; fits that its JSONL file has are not repeated.
        preset: quick takes minutes on the built-in scene; cpu hours on the six scenes of KGS_DATA; field hours on the
            same and more in full size; paper is the paper's 10 000 steps on every scene there in the size of published
            tables, for a large machine; guard tells in about 25 minutes on two cores, with KGS_DATA, whether a change
            of the code has changed the fits of eight scenes: guard.md has them beside stored ones, with the noise of
            each.
        processes: fits at a time, one per core unless given; the seconds of a fit hold for that many at a time.
        scheduler: address of a Dask scheduler whose workers run the fits instead; they find scenes and weights under
            the same paths.
        lpips_weights: folder with VGG16 and LPIPS weights (npz); without it LPIPS is left out, also of fits that are
            done.
        report_only: fit nothing; write the report of the fits that are done.
        scenes: only the fits of these scenes, as --list names them. The report is of all that are done, as with the
            next four.
        methods: only these methods, as "auto" or "progressive 0.2".
        views: only fits of so many views.
        seeds: only these seeds; guard has 0 unless they are given, and with 0 1 2 all that its stored fits need.
        table: only what a table of the paper has, of --preset paper. 1: LLFF with 3, 6 and 9 views; 2: Mip-NeRF 360
            with 12 and 24; 3: Blender with 8; 4: rates and schedules; 5: selected Gaussians dropped; 6: an L1 penalty;
            the last three on LLFF with 3 views.
        steps: of every fit, in place of the preset's number. Fits of another number are others, and need a folder of
            their own.
        list_cells: fit nothing and write nothing; say which fits the preset has, and which of them are done.

    Raises:
        DataError: scenes are missing, or `out` holds the study of another preset or number of steps, whose report would
            be overwritten.
        ValueError: the preset has no such fits, `table` is not of this preset, or `steps` is out of its range.
    """
    from kgs.metrics.weights import weight_files

    if table is not None and preset != "paper":
        raise ArgumentError("table", "the preset 'paper', which has the tables", quoted(preset))
    FitConfig(steps=steps)
    if lpips_weights is not None:
        weight_files(lpips_weights)
    check_installed("pandas", "scipy", "distributed", "matplotlib", "jinja2")
    load_tools()

    from . import guard, presets
    from .cells import sparse_cell
    from .grid import finished_rows, read_rows, run_grid
    from .published import cells_of_table
    from .report import write_report

    data = Path(os.environ["KGS_DATA"]) if os.environ.get("KGS_DATA") else None
    cells = presets.sparse_cells(preset, data)
    path = out / "sparse.jsonl"
    write = guard.write_guard if preset == "guard" else write_report
    if data is not None:
        for setting in presets.too_few_photos(preset, data):
            print(f"left out: {setting}")
    same = f"--preset {preset}"
    if steps is not None:
        cells = presets.with_steps(cells, steps)
        same += f" --steps {steps}"
    if preset == "guard" and seeds is None:
        seeds = (0,)
    chosen = cells if table is None or data is None else cells_of_table(cells, table, data)
    chosen = presets.select(chosen, scenes=scenes, methods=methods, views=views, seeds=seeds)
    if list_cells:
        done = [row["cell"] for row in finished_rows(chosen, path)]
        for cell in chosen:
            print(f"{'done' if cell in done else 'to do':>5}: {presets.name_of(cell)}")
        print(f"{len(done)} of {len(chosen)} are done")
        return 0
    if (report_only or read_rows(path)) and not finished_rows(cells, path):
        own = "give each preset and number of steps its own folder"
        raise DataError(path, "", f"cells of {same}", "none", advice=own)
    work = partial(
        sparse_cell,
        data=None if data is None else os.path.abspath(data),
        lpips_weights=None if lpips_weights is None else os.path.abspath(lpips_weights),
    )
    with Results.open(out, "study", marks=("sparse.jsonl",)) as results:
        results.begin()
        try:
            if not report_only:
                run_grid(chosen, work, path, scheduler=scheduler, processes=processes, name=presets.name_of)
        finally:
            rows = finished_rows(cells, path)
            if rows and not isinstance(sys.exception(), ValueError):  # then no cell was done
                folder = "" if preset == "quick" or data is None else "KGS_DATA=SCENES "
                options = same if lpips_weights is None else f"{same} --lpips-weights WEIGHTS"
                with results.stage(keep=True) as new:
                    text = write(rows, new, f"{folder}kgs study {options} -o OUT", len(cells))
                if preset == "guard":
                    print(text)
    return int(len(finished_rows(chosen, path)) < len(chosen))

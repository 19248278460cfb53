"""Held-out quality against training time: one knob of the fit at a time, around the default, on the study's grid."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import tyro

from kgs.backends import available
from kgs.bench.output import markdown_table, mean_sd
from kgs.bench.scenes import SYNTHETIC, check_scenes
from kgs.datasets import load_scene, synthetic_scene
from kgs.fit.config import FitConfig
from kgs.fit.run import choose_points
from kgs.study.cells import fit_and_measure
from kgs.study.grid import Cell, run_grid
from kgs.study.pairs import grouped
from kgs.study.plots import panels

# The default of each stands in FitConfig; where None means the rule there, it is the default here too.
KNOBS: dict[str, tuple[Any, ...]] = {"steps": (500, 1000), "coarse": (0.5,), "sh_degree": (0, 1)}
KNOBS |= {"max_gaussians": (5_000, 10_000), "drop": (0.0, 0.1, 0.3), "backend": ("torch",)}
HEADS = {"psnr": "PSNR [dB]", "gain": "over the default", "ssim": "SSIM", "train_psnr": "PSNR of training views"}
HEADS |= {"cpu_seconds": "CPU seconds", "gaussians": "Gaussians"}
SIZE = (126, 168)  # of the synthetic pictures


def training(*, out: Path, quick: bool = False, processes: int | None = None, scheduler: str | None = None) -> int:
    """Test PSNR against time, one knob of the fit at a time (hours; goes on where it stopped).

    For example:
      python measure.py --out training-quick --quick
      KGS_DATA=SCENES python measure.py --out training --processes 2

    Writes training.jsonl, .csv, .md and .png. With KGS_DATA, a folder of scenes, also on fern.

    Args:
        out: folder for the results; cells that its training.jsonl has are not repeated.
        quick: two tiny cells, to see that it works.
        processes: fits at a time, one per core unless given; the seconds of a fit hold for that many at a time.
        scheduler: address of a Dask scheduler whose workers run the cells instead.
    """
    cells = knob_cells(quick)
    rows = run_grid(cells, fit_cell, out / "training.jsonl", scheduler=scheduler, processes=processes)
    if rows:
        print(write_knobs(rows, out))
    return int(len(rows) < len(cells))


def knob_cells(quick: bool = False) -> list[Cell]:
    """The default, a short fit, each value of each knob and the steps of each backend; (`quick`) two tiny cells."""
    if quick:
        return [{"scene": SYNTHETIC, "seed": 0, "steps": steps} for steps in (20, 40)]
    scenes = [SYNTHETIC]
    if "KGS_DATA" in os.environ:
        check_scenes(Path(os.environ["KGS_DATA"]), ["llff/fern"])
        scenes.append("fern")
    settings: list[Cell] = [{}, {"fast": True}, *({knob: value} for knob in KNOBS for value in KNOBS[knob])]
    settings += [{"backend": backend, "steps": steps} for backend in KNOBS["backend"] for steps in KNOBS["steps"]]
    return [{"scene": scene, "seed": seed, **setting} for seed in range(3) for setting in settings for scene in scenes]


def fit_cell(cell: Cell) -> dict[str, Any]:
    """One fit of "scene" from SIFT points; "fast": half the steps, 30 % coarse; the rest are fields of FitConfig."""
    turned = {key: value for key, value in cell.items() if key not in ("scene", "fast")}
    config = FitConfig.from_dict(
        (FitConfig(steps=1000, coarse=0.3) if cell.get("fast") else FitConfig()).to_dict() | {"init": "sift"} | turned
    )
    if cell["scene"] == SYNTHETIC:
        scene = synthetic_scene(train_views=3, size=SIZE, seed=cell["seed"])
    else:
        scene = load_scene(Path(os.environ["KGS_DATA"]) / "llff" / cell["scene"], train_views=3, downscale=2)
    _, fit, stored = fit_and_measure(scene, config, choose_points(scene, config))
    test = fit.metrics["test"]
    return stored | {"psnr": test["psnr"], "ssim": test["ssim"], "train_psnr": fit.metrics["train"]["psnr"]}


def write_knobs(rows: Sequence[Mapping[str, Any]], out: Path) -> str:
    """Write training.csv, training.md (which it returns) and training.png: mean and deviation over seeds."""
    frame = pd.DataFrame([_knob(**row["cell"]) | {key: row["result"].get(key) for key in HEADS} for row in rows])
    default = frame[frame.knob == "default"].set_index(["scene", "seed"]).psnr
    frame["gain"] = frame.psnr - default.reindex(pd.MultiIndex.from_frame(frame[["scene", "seed"]])).to_numpy()
    keys = ["scene", "knob", "value"]
    table = frame.groupby(keys, sort=False)[[*HEADS]].agg(["mean", "std"])
    table.columns = [f"{c[0]}_sd" if c[1] == "std" else c[0] for c in table.columns]
    table = table.assign(n=frame.groupby(keys, sort=False).size()).reset_index()
    table.to_csv(out / "training.csv", index=False)
    digits = dict(zip(HEADS, (2, 2, 3, 1, 0, 0), strict=True))
    lines = [
        [scene, f"{knob} {value}".strip(), len(cells), *(mean_sd(cells[key], d) for key, d in digits.items())]
        for (scene, knob, value), cells in grouped(frame, *keys)
    ]
    lines.sort(key=lambda line: (line[0], line[1] != "default", str(line[1]).split()[0]))
    title = "Test views and CPU seconds of the fit, mean (standard deviation over n seeds)"
    text = markdown_table(title, ["setting", "n", *HEADS.values()], lines, first="scene")
    (out / "training.md").write_text(text, encoding="utf-8")
    curves = {knob: (knob,) if knob in available() else ("default", knob) for knob in table.knob.unique()}
    lines_of = [table[table.knob.isin(knobs)].assign(label=knob) for knob, knobs in curves.items()]
    points = pd.concat(line.sort_values("cpu_seconds") for line in [*lines_of[1:], *lines_of[:1]])
    points = points.rename(columns={"scene": "panel", "cpu_seconds": "x", "psnr": "y", "psnr_sd": "dy"})
    axes = {"xscale": "log", "xlabel": "CPU seconds of the fit", "ylabel": "test PSNR [dB]"}
    panels(points, {"default": ("black", "*")}, **axes).savefig(out / "training.png")
    return text


def _knob(scene: str, seed: int, backend: str = "", **turned: Any) -> dict[str, Any]:
    """What was turned, and how far; of a backend that is named, which has a curve of its own, the rest is "how far"."""
    knob, value = next(iter(turned.items()), ("default", ""))
    value = "" if value is True else str(value)
    value = f"{knob} {value}".strip() if backend else value
    return {"scene": scene, "seed": seed, "knob": backend or knob, "value": value}


if __name__ == "__main__":
    raise SystemExit(tyro.cli(training) or 0)

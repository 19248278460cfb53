"""The command `kgs bench`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from kgs.options import alias

__all__ = ["bench"]


def bench(
    what: Literal["speed", "precision", "training", "study", "starts", "extremes"],
    /,
    *,
    out: Annotated[Path, alias("-o")],
    quick: bool = False,
    device: str = "cpu",
    processes: int | None = None,
    preset: Literal["quick", "cpu", "paper"] | None = None,
    scheduler: str | None = None,
    lpips_weights: Path | None = None,
) -> int:
    """Measure this machine and write the figures as tables, CSV, JSON and plots.

    Args:
        what: what to measure.
            speed: time and memory of rendering and of training steps.
            precision: errors of images, gradients and footprints against time.
            training: test PSNR against time, one knob of the fit at a time (hours, goes on where it stopped).
            study: DropGaussian on and off, its schedules and rivals, and the starts (goes on where it stopped).
            starts: depth errors, completeness and times of first points (20 minutes).
            extremes: errors, bounds and times of stiff and extreme cases; exit code 1 where a bound is missed.
            With KGS_DATA, a folder of scenes, training, study and starts measure on real ones.
        out: folder for the results.
        quick: less of it, in about a minute; for study its preset of that name.
        device: cpu, cuda, ... (speed).
        processes: fits at a time; one a core unless given (training, study).
        preset: study: quick, the default, takes minutes on the built-in scene; cpu hours on the five scenes of
            KGS_DATA; paper is the paper's 10 000 steps on every scene there in the size it has, for a large machine.
        scheduler: training, study: address of a Dask scheduler whose workers run the cells.
        lpips_weights: study: folder with VGG16 and LPIPS weights (npz); without it LPIPS is left out.

    Raises:
        ValueError: `quick` together with another preset.
    """
    if what == "speed":
        from .speed import speed

        speed(out=out, quick=quick, device=device)
    elif what == "precision":
        from .precision import precision

        precision(out=out, quick=quick)
    elif what == "training":
        from .training import training

        return training(out=out, quick=quick, processes=processes, scheduler=scheduler)
    elif what == "study":
        from .study import study

        if quick and preset not in (None, "quick"):
            raise ValueError(f"preset: expected none but quick together with --quick, got {preset!r}")
        return study(
            out=out,
            preset=preset or "quick",
            processes=processes,
            scheduler=scheduler,
            lpips_weights=lpips_weights,
        )
    elif what == "starts":
        from .starts import starts

        starts(out=out, quick=quick)
    else:
        from .extremes import extremes

        return extremes(out=out, quick=quick)
    return 0

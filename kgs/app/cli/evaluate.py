"""`kgs eval`: measures a fit again."""

from pathlib import Path

from kgs._support.errors import printable
from kgs.app.console import as_line, say, say_next
from kgs.app.files.results import Results
from kgs.fit.config import Backend

from .checks import check_results
from .options import IfGiven
from .tools import load_tools


def evaluate(
    out: Path, /, *, lpips_weights: IfGiven[Path] = None, device: str = "auto", backend: Backend = "auto"
) -> None:
    """Measure a fit again, and update its metrics.json and its page.

    Measures that are not taken again stay as they are.

    For example:
      kgs eval fern-3
      kgs eval fern-3 --lpips-weights weights

    Args:
        out: the folder of the results of kgs fit.
        lpips_weights: folder with the weights of VGG16 and LPIPS (npz). Unless given: LPIPS is not measured.
        device: auto: a GPU if kgs has kernels for it, else the CPU. Or cpu, cuda, cuda:1, ...
        backend: auto: that of the fit. kgs fit --help-all describes the others.
    """
    from kgs.metrics.weights import weight_files

    if lpips_weights is not None:
        weight_files(lpips_weights)
    check_results(out)
    with Results.open(out, "fit", beside=["photos"]) as results:
        torch_device = load_tools(device, backend, "jinja2")

        from kgs._support.json_files import read_json, write_json
        from kgs.app.page.fit_page import PAGE, write_own_page
        from kgs.app.saved_fit import load_fit
        from kgs.fit.measures import measure_again
        from kgs.metrics.evaluate import as_text
        from kgs.metrics.lpips import Lpips

        lpips = None if lpips_weights is None else Lpips.load(lpips_weights).to(torch_device)
        request, fit = load_fit(out, torch_device, backend, say)
        metrics = measure_again(fit, out / "metrics.json", lpips)
        with results.stage(keep=True) as new:
            write_json(new / "metrics.json", metrics)
            write_own_page(new, out, fit.annotated(metrics=metrics), request, read_json(out / "config.json"))
    say(as_text(metrics))
    say(f"{printable(out / 'metrics.json')} and {printable(out / PAGE)} are up to date")
    say_next(f"open {as_line(out / PAGE)} in a browser")

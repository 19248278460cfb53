"""`kgs eval`: measures a fit again."""

from kgs.errors import printable
from kgs.fit.config import Backend
from kgs.io.console import as_line, say, say_next

from .inputs import load
from .options import Existing


def evaluate(
    out: Existing, /, *, lpips_weights: Existing | None = None, device: str = "cpu", backend: Backend = "auto"
) -> None:
    """Measure a fit again and bring its metrics.json and page up to date; what is not measured stays as it is.

    For example:
      kgs eval fern-3
      kgs eval fern-3 --lpips-weights weights

    Args:
        out: the output folder of `kgs fit`.
        lpips_weights: folder with VGG16 and LPIPS weights (npz); without it LPIPS is not measured.
        device: cpu, cuda, ...
        backend: auto: that of the fit.
    """
    from kgs.fit.saved import load_fit
    from kgs.json_files import read_json, write_json
    from kgs.machine import check_tools
    from kgs.metrics.evaluate import as_text, measure_again
    from kgs.metrics.lpips import Lpips
    from kgs.page.fit_page import PAGE, refresh_page

    check_tools(device, backend, "jinja2")
    lpips = None if lpips_weights is None else Lpips.load(lpips_weights).to(device)
    saved, path = load_fit(out, device), out / "metrics.json"
    saved = saved if backend == "auto" else saved._replace(backend=backend)
    scene = saved.placed(load(saved.request, out))
    metrics = measure_again(path, read_json(path), scene, lambda c: saved.render(c, scene.background), lpips)
    write_json(path, metrics)
    refresh_page(out, saved, scene, metrics)
    say(as_text(metrics))
    say(f"{printable(path)} and {printable(out / PAGE)} are up to date")
    say_next(f"open {as_line(out / PAGE)} in a browser")

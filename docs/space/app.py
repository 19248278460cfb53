"""The web page: photos in, a page to look around in out. What a visitor may do is in `jobs.py`."""

import html
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

folder = tempfile.TemporaryDirectory(prefix="kgs-space-")  # removed at the end
ROOT = Path(folder.name)
os.environ["GRADIO_TEMP_DIR"] = str(ROOT / "uploads")  # where gradio puts uploads and downloads
os.environ.setdefault("GRADIO_ANALYTICS_ENABLED", "False")

import gradio as gr  # noqa: E402, it reads the two lines above
from jobs import Limits, Refused, Workshop  # noqa: E402

LIMITS = Limits()
ABOUT = f"""
# Photos in, page out

Upload {LIMITS.photos[0]} to {LIMITS.photos[1]} photos of something that does not move, with a step to the side between
them, as your camera wrote them. You get a page in which you can look around: Gaussian splatting by kgs.

Keep this page open: what nobody waits for is stopped. A job takes some minutes, {LIMITS.seconds / 60:.0f} at most.
Photos and results are deleted from this server after about {LIMITS.kept / 60:.0f} minutes.
"""
workshop = Workshop(ROOT, LIMITS)


def framed(page: Path) -> str:
    """The page in a frame that can run its viewer, and reach nothing outside of itself."""
    text = html.escape(page.read_text(encoding="utf-8"))
    return f'<iframe sandbox="allow-scripts" srcdoc="{text}" style="width: 100%; height: 85vh; border: 0"></iframe>'


def make(photos: list[str] | None) -> Iterator[tuple[str, list[str], str]]:
    """What is shown while a visitor waits, and in the end: text, files and the page."""
    try:
        job = workshop.start([Path(photo) for photo in photos or []])
    except Refused as reason:
        yield str(reason), [], ""
        return
    try:
        while not (look := workshop.look(job)).done:
            yield look.text, [], ""
            time.sleep(1)
        pages = [framed(path) for path in look.results if path.suffix == ".html"]
        yield look.text, [str(path) for path in look.results], "".join(pages)
    finally:  # also where the visitor is gone
        workshop.leave(job)


with gr.Blocks(title="kgs: photos in, page out") as app:
    gr.Markdown(ABOUT)
    chosen = gr.File(label="Photos", file_count="multiple", file_types=["image", ".heic", ".heif"])
    button = gr.Button("Make the page", variant="primary")
    said = gr.Textbox(label="What happens", lines=8, max_lines=20, interactive=False)
    files = gr.File(label="To keep: the page, the splat, the film", file_count="multiple", interactive=False)
    shown = gr.HTML()
    # jobs wait in the workshop's row: gradio's own queue lets in all that fit, and one more to be told so
    places = LIMITS.waiting + 2
    button.click(make, chosen, [said, files, shown], api_visibility="private", concurrency_limit=places)

if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())  # so that the job ends and the folder goes there, too
    app.queue(max_size=30).launch(max_file_size=LIMITS.photo_bytes, footer_links=[], ssr_mode=False, run_history=False)

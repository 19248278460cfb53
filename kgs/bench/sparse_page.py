"""The report of the study of sparse views as one page of HTML that needs nothing but itself."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence

from .output import html_table
from .sparse_plots import Plot
from .sparse_tables import Table

__all__ = ["sparse_page"]

_STYLE = """
:root { color-scheme: light dark;
  --text: #1d1d1f; --page: #ffffff; --line: #d5d5da; --stripe: #f4f4f7; --soft: #5c5c66 }
@media (prefers-color-scheme: dark) {
  :root { --text: #e8e8ec; --page: #16171a; --line: #3a3b42; --stripe: #1f2126; --soft: #a5a5b0 }
}
body { margin: 0 auto; max-width: 92rem; padding: 1rem; background: var(--page); color: var(--text);
  font: 1rem/1.5 system-ui, sans-serif }
h1 { font-size: 1.5rem; line-height: 1.2 }
h2 { margin-top: 2.5rem; font-size: 1.2rem }
figure { margin: 1.5rem 0 }
figcaption { max-width: 48rem; margin-bottom: .5rem; color: var(--soft) }
.scroll { overflow-x: auto }
table { border-collapse: collapse; font-size: .85rem; font-variant-numeric: tabular-nums }
th, td { padding: .3rem .6rem; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap }
thead th { vertical-align: bottom; white-space: normal; min-width: 3rem }
tbody th, thead th:first-child { position: sticky; left: 0; min-width: 7.5rem; max-width: 13rem;
  background: var(--page); font-weight: normal; text-align: left; white-space: normal }
tbody tr:nth-child(even) > * { background: var(--stripe) }
img { display: block; width: 100%; height: auto; border-radius: .4rem; background: #ffffff }
@media (min-width: 60rem) { tbody th { min-width: 13rem } }
"""


def sparse_page(
    title: str, findings: Sequence[str], notes: Sequence[str], tables: Sequence[Table], plots: Sequence[Plot]
) -> str:
    """The page: findings, the main table, the plots, the other tables, and how to read them.

    Args:
        title: of the page.
        findings: a sentence each.
        notes: the same, for the end.
        tables: the main one first.
        plots: PNG files; their bytes become part of the page.
    """
    parts = [
        "<!DOCTYPE html>",
        '<html lang="en">',
        f'<head><meta charset="utf-8"><title>{html.escape(title)}</title>',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<style>{_STYLE}</style></head>",
        f"<body><h1>{html.escape(title)}</h1>",
        _list(findings),
        *(html_table(*table) for table in tables[:1]),
        *(["<h2>Plots</h2>", *map(_figure, plots)] if plots else []),
        *(["<h2>More tables</h2>", *(html_table(*table) for table in tables[1:])] if tables[1:] else []),
        "<h2>How to read this</h2>",
        _list(notes),
        "</body></html>",
        "",
    ]
    return "\n".join(parts)


def _list(sentences: Sequence[str]) -> str:
    return f"<ul>{''.join(f'<li>{html.escape(sentence)}</li>' for sentence in sentences)}</ul>" if sentences else ""


def _figure(plot: Plot) -> str:
    caption = html.escape(plot.caption)
    content = plot.path.read_bytes()
    data = base64.b64encode(content).decode("ascii")
    width = int.from_bytes(content[16:20])  # of the PNG, where it always stands
    size = f"max-width: {width}px; min-width: min({width}px, 38rem)"
    image = f'<img alt="{caption}" style="{size}" src="data:image/png;base64,{data}">'
    return f'<figure><figcaption>{caption}</figcaption><div class="scroll">{image}</div></figure>'

"""Numbers, tables and reports of the study as text."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import pandas as pd

from kgs.bench.output import markdown_table


def signed(value: float, decimals: int) -> str:
    """As "+0.31"; no "-0.00"."""
    return f"{round(value, decimals) + 0.0:+.{decimals}f}"


def interval(limits: tuple[float, float], decimals: int) -> str:
    """As "[-0.20, +0.82]"."""
    low, high = (signed(limit, decimals) for limit in limits)
    return f"[{low}, {high}]"


def counts(values: Iterable[str]) -> str:
    """As "200 a; 25 b", the most frequent first."""
    return "; ".join(f"{count} {value}" for value, count in Counter(values).most_common())


def table_of(lines: Sequence[Mapping[str, str]]) -> pd.DataFrame:
    """A table of text, "-" where a line has nothing; columns without anything are left out."""
    table = pd.DataFrame(list(lines)).fillna("-")
    return table.loc[:, (table != "-").any()]


def document(title: str, sentences: Iterable[str], tables: Mapping[str, pd.DataFrame]) -> str:
    """A report in Markdown: the title, a list of sentences, and the tables below their titles."""
    text = "\n".join([f"# {title}", "", *(f"- {sentence}" for sentence in sentences), "", ""])
    for name, table in tables.items():
        text += markdown_table(name, table.columns[1:], table.to_numpy().tolist(), table.columns[0])
    return text

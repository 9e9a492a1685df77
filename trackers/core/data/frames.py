"""Tables for notebooks, terminals and pandas: HTML of recordings and estimates, aligned lines, frames of pandas."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput

if TYPE_CHECKING:
    import pandas


def html_table(caption: str, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A small HTML table under a caption, by polars."""
    return frame_html(caption, pl.DataFrame(list(rows), list(head), orient="row", infer_schema_length=None))


def recording_html(recording: Any) -> str:
    """Sensors, inputs and truth of a `Recording`, with their columns and how many rows have them."""
    rows = [(k, "sensor", r.values.shape[1], int(r.seen.any(axis=1).sum())) for k, r in recording.readings.items()]
    rows += [(k, "input", int(np.prod(x.shape[1:], dtype=int)), len(recording)) for k, x in recording.inputs.items()]
    rows += [(k, "truth", x.shape[1], int(known.sum())) for k, (x, known) in recording.truth.items()]
    return html_table(repr(recording), ("name", "", "columns", "rows"), rows)


def frame_html(caption: str, table: pl.DataFrame) -> str:
    """The first and last rows of a table under a caption."""
    return f"<div>{escape(caption)}{table._repr_html_()}</div>"


def estimates_html(estimates: Any) -> str:
    """The table of `Estimates`; no rows after a run of a bare batch."""
    return frame_html(repr(estimates), pl.DataFrame() if estimates.times is None else estimates.to_polars())


def text_lines(cells: Sequence[Sequence[str]], sides: str) -> list[str]:
    """Rows in aligned columns; `sides`: `<` or `>` for each."""
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ("  ".join(f"{x:{side}{n}}" for x, side, n in zip(row, sides, widths, strict=True)) for row in cells)
    return [line.rstrip() for line in lines]


def to_pandas(table: pl.DataFrame) -> pandas.DataFrame:
    """The table as a pandas frame; raises UnusableInput where pandas is not installed."""
    try:
        import pandas
    except ModuleNotFoundError:
        raise UnusableInput("to_pandas: pandas is not installed; pip install pandas, or use to_polars()") from None
    return pandas.DataFrame({name: table[name].to_list() for name in table.columns})

"""Columns of tables as arrays: numbers, values with their mask, rows by tag, runs of equal keys, required columns."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import polars as pl

from trackers.core.errors import UnusableInput

NUMERIC_ENDINGS = ("_s", "_m", "_m2", "_rad", "nis", "nis_dof")
"""Endings of the names of numeric columns in tables of estimates and of truth."""


def float_column(frame: pl.DataFrame, name: str) -> np.ndarray:
    """The column as float64 (n,), NaN where a value is missing; all NaN if the table has no such column."""
    if name not in frame.columns:
        return np.full(len(frame), np.nan)
    return frame[name].cast(pl.Float64).fill_null(np.nan).to_numpy()


def values_of(table: pl.DataFrame, columns: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """The columns as values (n, m), zero where one is missing, and the mask (n, m) of the values present."""
    values = table.select(pl.col(columns).cast(pl.Float64).fill_null(np.nan)).to_numpy()
    seen = np.isfinite(values)
    return np.where(seen, values, 0.0), seen


def by_tag(table: pl.DataFrame) -> Iterator[tuple[str, pl.DataFrame]]:
    """Each tag with its rows, in order of first appearance."""
    for (tag,), part in table.group_by(["tag"], maintain_order=True):
        yield str(tag), part


def run_starts(rows: pl.DataFrame, keys: list[str]) -> np.ndarray:
    """Start indices (g + 1,) of the g runs of equal `keys` in sorted rows; the last entry is the number of rows."""
    if len(rows) == 0:
        return np.zeros(1, int)
    group = rows.select(pl.struct(keys).rle_id()).to_series().to_numpy()
    return np.concatenate([[0], np.flatnonzero(np.diff(group)) + 1, [len(rows)]])


def require_columns(frame: pl.DataFrame, columns: list[str], what: str) -> None:
    """Raises UnusableInput for a missing column, text in a numeric one, or numbers in `status`; `what`: the table."""
    missing = [name for name in columns if name not in frame.columns]
    if missing:
        raise UnusableInput(
            f"{what}: no column {', '.join(missing)}; found {', '.join(frame.columns) or 'none'}; "
            f"expected {', '.join(columns)}; give the table written by `trackwright track` or the truth of a recording"
        )
    text = [name for name in frame.columns if name.endswith(NUMERIC_ENDINGS) and not _is_numeric(frame.schema[name])]
    if text:
        raise UnusableInput(
            f"{what}: column {text[0]} holds {frame.schema[text[0]]}; expected numbers; convert the column"
        )
    if _is_numeric(frame.schema.get("status", pl.String())):
        raise UnusableInput(
            f"{what}: column status holds {frame.schema['status']}; expected words such as ok, lost, waiting; "
            "write the words or leave the column out"
        )


def _is_numeric(kind: pl.DataType) -> bool:
    return kind.is_numeric() or kind == pl.Null

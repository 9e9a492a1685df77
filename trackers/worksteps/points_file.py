"""Fastening points from a table file with columns `name, x_m, y_m` and optionally `z_m`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.input_file import LARGEST_NUMBER
from trackwright.trackers.recordings.table_file import SUFFIXES, TableFile, read_table_file
from trackwright.trackers.worksteps.decisions import FasteningPoints

_REQUIRED, _HEIGHT = ("name", "x_m", "y_m"), "z_m"
_EXPECTED = "expected name, x_m, y_m and optionally z_m"


def read_points(path: Path) -> FasteningPoints:
    """The fastening points of a `.csv`, `.csv.gz` or `.parquet` file; raises UnusableInput for unusable ones."""
    if not path.is_file():
        raise UnusableInput(f"{path}: no such file; {_EXPECTED} in a {', '.join(SUFFIXES)} file; check the path")
    file = read_table_file(path)
    columns = file.frame.columns
    missing = [c for c in _REQUIRED if c not in columns]
    strange = [c for c in columns if c not in (*_REQUIRED, _HEIGHT)]
    if missing or strange:
        fault = f"no column {missing[0]}" if missing else f"unknown column {strange[0][:30]!r}"
        raise UnusableInput(
            f"{path}: {fault}, found {', '.join(c[:30] for c in columns[:8])}; {_EXPECTED}, metres; rename or remove it"
        )
    names = _names(file)
    axes = [*_REQUIRED[1:], *([_HEIGHT] if _HEIGHT in columns else [])]
    points = FasteningPoints(tuple(names), np.stack([_metres(file, axis) for axis in axes], axis=1))
    if len(names) > 1 and points.spacing() == 0:
        distance = np.linalg.norm(points.positions[:, None] - points.positions, axis=-1)
        one, other = np.argwhere(np.triu(distance == 0, 1))[0]
        raise UnusableInput(
            f"{path}: points '{names[one]}' and '{names[other]}' have the same position; expected different positions; "
            f"remove one{'' if _HEIGHT in columns else ' or give z_m'}"
        )
    return points


def _names(file: TableFile) -> list[str]:
    names = [("" if n is None else str(n)).strip() for n in file.frame["name"].cast(pl.String).to_list()]
    for row, name in enumerate(names):
        if not name:
            raise UnusableInput(f"{file.location(row, 'name')}: empty, expected a name")
        first = names.index(name)
        if first < row:
            raise UnusableInput(
                f"{file.location(row, 'name')}: '{name[:40]}' is a duplicate of row {first + 1}; "
                "expected unique names; "
                "rename one"
            )
    return names


def _metres(file: TableFile, column: str) -> np.ndarray:
    found = file.frame[column]
    texts = found.cast(pl.String).to_list()
    metres = found.str.strip_chars().cast(pl.Float64, strict=False) if found.dtype == pl.String else found
    if not (metres.dtype.is_numeric() or metres.dtype == pl.Null):
        raise UnusableInput(f"{file.path}: column {column} has type {metres.dtype}, expected numbers in metres")
    values = metres.cast(pl.Float64).fill_null(np.nan).to_numpy()
    wrong = np.flatnonzero(~(np.abs(values) <= LARGEST_NUMBER))
    if len(wrong):
        row = int(wrong[0])
        text = "empty" if not (texts[row] or "").strip() else repr(texts[row][:40])
        raise UnusableInput(
            f"{file.location(row, column)}: {text}, expected a finite number, m, at most {LARGEST_NUMBER:g}; "
            "correct the cell"
        )
    return values

"""Data inside a page: which rows of many, arrays as base64, JSON that no text can leave, and the script of plotly."""

from __future__ import annotations

import base64
import json
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

MOST_ROWS, MOST_TRACKS, MOST_POINTS, MOST_EVENTS = 25_000, 300, 12_000, 1_000
"""The most estimates, tracks, residuals and events of a page, over all its recordings."""


def packed(values: np.ndarray, kind: str = "f4") -> dict[str, str]:
    """An array (n,) as plotly.js takes typed arrays: its kind, as `f4`, and its bytes in base64."""
    with np.errstate(over="ignore", invalid="ignore"):
        array = np.ascontiguousarray(values, np.dtype(kind).newbyteorder("<"))
    return {"dtype": kind, "bdata": base64.b64encode(array.tobytes()).decode("ascii")}


def rounded(value: float | None, digits: int = 4) -> float | None:
    """The number with so many significant digits; None for one that is not finite, which JSON does not have."""
    return None if value is None or not np.isfinite(value) else float(f"{value:.{digits}g}")


def script_json(content: Any) -> str:
    """The content as JSON for a `<script type="application/json">`, which a `</script>` in a text does not end."""
    return json.dumps(content, allow_nan=False, separators=(",", ":"), ensure_ascii=False).replace("<", "\\u003c")


def plotting_script() -> str:
    """The source of plotly.js in the installed package `plotly`, which takes half a second to import and is not."""
    spec = find_spec("plotly")
    assert spec is not None
    assert spec.origin is not None
    return (Path(spec.origin).parent / "package_data" / "plotly.min.js").read_text(encoding="utf-8")


def drawn_tracks(worst_first: list[int], most: int) -> list[int]:
    """The numbers of the tracks that are drawn, ascending: all, or evenly over the ranks from the worst to the best."""
    if len(worst_first) <= most:
        return sorted(worst_first)
    return sorted({worst_first[k] for k in np.linspace(0, len(worst_first) - 1, most).round().astype(int)})


def drawn_rows(lengths: np.ndarray, weight: np.ndarray, most: int) -> np.ndarray:
    """The rows that are drawn, ascending: all, or the first, the last and those with the largest weight of each block.

    Blocks of equal length; `lengths` (g,): rows of each track; `weight` (n,): the size of the error, NaN as zero. About
    `most` rows, two of each block at least.
    """
    n = int(lengths.sum())
    if n <= most:
        return np.arange(n)
    size = -(-2 * n // max(most - 2 * len(lengths), 2))
    first = np.cumsum(lengths) - lengths
    within = np.arange(n) - np.repeat(first, lengths)
    begins = np.flatnonzero(within % size == 0)
    block = np.repeat(np.arange(len(begins)), np.diff(np.append(begins, n)))
    order = np.lexsort((-np.nan_to_num(weight), block))
    return np.unique(np.concatenate([begins, order[begins], first + lengths - 1]))

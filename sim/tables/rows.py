"""The columns that every table of a simulated world begins with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import polars as pl


def named(index: np.ndarray, names: Sequence[str]) -> pl.Series:
    """The name that each number of `index` (n,) stands for."""
    return pl.Series(index).replace_strict(range(len(names)), list(names), return_dtype=pl.String)


def every_row(times: np.ndarray, tags: Sequence[str]) -> dict[str, Any]:
    """`t_s` and `tag` of a table with a row for every tag and time, tag after tag."""
    return {"t_s": np.tile(times, len(tags)), "tag": named(np.repeat(np.arange(len(tags)), len(times)), tags)}

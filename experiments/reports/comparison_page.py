"""The page of a comparison of runs: its tables and figures in one file."""

from __future__ import annotations

import base64
import shlex
from collections.abc import Sequence
from pathlib import Path

from experiments.reports.comparison import Table
from experiments.reports.pages import page, write_page


def write_comparison(
    path: Path, runs: Sequence[str], tables: Sequence[Table], figures: Sequence[Path], command: Sequence[str]
) -> Path:
    """Writes the page whole or not at all; returns the path. Raises UnusableInput where it can't be written."""
    drawn = [
        (f"data:image/png;base64,{base64.b64encode(figure.read_bytes()).decode()}", _words(figure))
        for figure in figures
    ]
    text = page(
        "comparison.html",
        title=" and ".join(runs) if len(runs) == 2 else f"{len(runs)} runs: {', '.join(runs)}",
        tables=tables,
        figures=drawn,
        words=shlex.join(["trackwright", *command[1:]]),
    )
    return write_page(path, text)


def _words(figure: Path) -> str:
    """What a figure shows, by the end of its name."""
    return figure.stem.rpartition("-")[2].replace("_", " ")

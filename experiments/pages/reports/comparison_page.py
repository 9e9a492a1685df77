"""The page of a comparison of runs: its tables and figures in one file."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from trackwright.experiments.pages.reports.comparison import Table
from trackwright.experiments.pages.reports.pages import page, write_page


def write_comparison(
    path: Path,
    runs: Sequence[str],
    tables: Sequence[Table],
    charts: Sequence[tuple[str, str]],
    command: Sequence[str],
    playback: str | None = None,
) -> Path:
    """Writes the page whole or not at all; returns the path. Raises UnusableInput where it can't be written.

    `charts`: the address of each image, and words for the blind. `playback`: the name of a page beside it that plays
    the runs back.
    """
    text = page(
        "comparison.html",
        title=" and ".join(runs) if len(runs) == 2 else f"{len(runs)} runs: {', '.join(runs)}",
        tables=tables,
        charts=charts,
        playback=playback,
        words=shlex.join(["trackwright", *command[1:]]),
    )
    return write_page(path, text)

"""Comparison of runs: what `evaluate` does with several, and `track` with several trackers."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

COMPARISON = "comparison.html"
"""The page that `track` writes where it ran several trackers."""


def print_comparison(
    folders: Sequence[Path],
    out: Path,
    kind: str | None,
    metrics: Sequence[str] = (),
    json: bool = False,
    page: bool = True,
    playback: str | None = None,
) -> None:
    """Prints the comparison of the runs in these folders and writes it as a page with figures beside it.

    `kind`: the ending of the figures, png or pdf; None for none. `page`: whether it is written. `playback`: another
    page beside it, which it names.
    """
    # Reading errors of tracks and drawing take a second to import, which the help need not wait for.
    from trackwright.experiments.cli.console import output_folder
    from trackwright.experiments.pages.charts.comparison import comparison_charts, plot_comparison
    from trackwright.experiments.pages.reports.comparison import (
        SHOWN,
        comparison,
        comparison_text,
        lone_subjects,
        write_comparison,
    )
    from trackwright.experiments.pages.reports.runs import read_runs
    from trackwright.experiments.text.terminal import notice
    from trackwright.trackers.recordings.atomic import json_text

    runs, notices = read_runs(folders)
    tables, contrasts = comparison(runs, metrics or SHOWN)
    for text in (*notices, *lone_subjects(runs)):
        notice(f"notice: {text}")
    if json:
        differences = [contrast._asdict() | {"difference": contrast.difference._asdict()} for contrast in contrasts]
        shown = [dict(zip(table._fields[:-1], table[:-1], strict=True)) for table in tables]
        print(json_text({"tables": shown, "contrasts": differences}), end="")
    else:
        print(comparison_text(tables), end="")
    output_folder(out.parent)
    written = [] if kind is None else plot_comparison(out, runs, contrasts, kind)
    if page:
        charts = comparison_charts(runs, contrasts)
        written.insert(0, write_comparison(out, [run.name for run in runs], tables, charts, sys.argv, playback))
    if written and not json:
        print(f"wrote {', '.join([str(written[0]), *(path.name for path in written[1:])])}")

"""`trackwright report`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro

from experiments.cli.console import notice, output_folder
from experiments.reports.comparison import SHOWN, comparison_text, pairs, write_comparison
from trackers.core.errors import UnusableInput


def report(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path = Path("out/comparison.html"),
    figures: tuple[str, ...] = SHOWN,
) -> int:
    """Compare two runs: prints their metrics side by side and writes them as one page.

    Args:
        runs: two folders of `study`, or two of `track` after `evaluate`.
        out: the page to write.
        figures: the metrics to show, by their names in results.json or evaluation.json.
    """
    if len(runs) != 2:
        raise UnusableInput(f"report: found {len(runs)} folders; expected two runs to compare")
    found, alone = pairs(*runs)
    known = {p.metric for p in found}
    shown = [p for p in found if p.metric in figures]
    if not shown:
        raise UnusableInput(f"--figures {' '.join(figures)}: not in both runs; they have {', '.join(sorted(known))}")
    for text in alone:
        notice(f"notice: {text}")
    print(comparison_text(runs, shown), end="")
    output_folder(out.parent)
    print(f"wrote {write_comparison(out, runs, shown, sys.argv)}")
    return 0

"""`trackwright report`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro

from experiments.cli.console import notice
from experiments.reports.comparison import pairs
from experiments.reports.comparison_page import SHOWN, comparison_text, write_comparison
from trackers.core.errors import UnusableInput


def report(
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path = Path("out/comparison.html"),
    figures: tuple[str, ...] = SHOWN,
) -> int:
    """Compare two runs: prints their figures side by side and writes them as one page.

    Args:
        runs: two folders that `study` wrote, or two that `track` wrote and `evaluate` judged.
        out: the page to write.
        figures: which figures to show, by the names in results.json or evaluation.json; others stay in those files.
    """
    if len(runs) != 2:
        raise UnusableInput(f"report: found {len(runs)} folders; expected two runs to compare")
    found, alone = pairs(*runs)
    known = {p.figure for p in found}
    shown = [p for p in found if p.figure in figures]
    if not shown:
        raise UnusableInput(
            f"--figures {' '.join(figures)}: neither run has them; they have {', '.join(sorted(known))}"
        )
    for text in alone:
        notice(f"notice: {text}")
    print(comparison_text(runs, shown), end="")
    print(f"wrote {write_comparison(out, runs, shown, sys.argv)}")
    return 0

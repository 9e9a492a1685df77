"""`trackwright report`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from experiments.cli.arguments import File, Folders
from experiments.cli.console import notice, output_folder
from experiments.reports.comparison import SHOWN, comparison_text, pairs, write_comparison
from trackers.core.errors import UnusableInput


def report(
    runs: Folders,
    *,
    out: File = Path("out/comparison.html"),
    metrics: Annotated[tuple[str, ...], "METRIC"] = SHOWN,
) -> int:
    """Compare two runs: print their metrics and write them as a page.

    Args:
        runs: two output folders of `study`, or two of `track` with the evaluation.json of `evaluate`.
        out: the page to write.
        metrics: names of the metrics to show, as in results.json or evaluation.json.
    """
    if len(runs) != 2:
        raise UnusableInput(f"report: found {len(runs)} folders; expected two to compare")
    compared, notices = pairs(*runs)
    known = {p.metric for p in compared}
    shown = [p for p in compared if p.metric in metrics]
    if not shown:
        raise UnusableInput(
            f"--metrics {' '.join(metrics)}: not in both runs; expected names among {', '.join(sorted(known))}"
        )
    for text in notices:
        notice(f"notice: {text}")
    print(comparison_text(runs, shown), end="")
    output_folder(out.parent)
    print(f"wrote {write_comparison(out, runs, shown, sys.argv)}")
    return 0

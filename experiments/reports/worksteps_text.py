"""What tracks say of points of work, as text for people."""

from __future__ import annotations

import numpy as np
from rich.table import Table

from experiments.cli.console import compact_table, rendered
from trackers.worksteps.decisions import LEVEL
from trackers.worksteps.metrics import Share, Workstep
from trackers.worksteps.tracks import WorkReport

SHOWN_POINTS = 20
"""More points than this are not listed; those with most wrong releases are."""

SURE = 0.95
"""Claims from here on are summed up in a sentence."""


def to_text(report: WorkReport, width: int = 120) -> str:
    """A table of the points with the share of rows released rightly, wrongly or not, and sentences on the whole."""
    return rendered(width, _table(report), *_sentences(report))


def _table(report: WorkReport) -> Table:
    table = compact_table(
        f"Right place? Released from {LEVEL:.0%} on, within {report.tolerance:g} m; % of rows at work [95 %]"
    )
    table.add_column("point", overflow="fold")
    for name in ("n", "visits", "right", "wrong", "missed", "named right"):
        table.add_column(name, justify="right", no_wrap=True)
    listed = sorted(report.by_point.items(), key=lambda item: -item[1].wrong.value)[:SHOWN_POINTS]
    shown = {name for name, _ in listed}
    for name, w in report.by_point.items():
        if name in shown:
            table.add_row(name, *_cells(w))
    if len(report.by_point) > 1:
        table.add_row(f"all {len(report.by_point)}", *_cells(report.overall), style="bold")
    return table


def _cells(w: Workstep) -> list[str]:
    return [str(w.right.n), str(w.visits_right.n), *(_percent(s) for s in (w.right, w.wrong, w.missed, w.named))]


def _sentences(report: WorkReport) -> list[str]:
    w, said = report.overall, []
    said.append("Rows of one visit are alike: intervals count visits, not rows.")
    if len(report.by_point) > SHOWN_POINTS:
        said.append(f"Of {len(report.by_point)} points the {SHOWN_POINTS} with most wrong releases are listed.")
    absent = len(report.points.names) - len(report.by_point)
    if absent:
        said.append(f"At {absent} of {len(report.points.names)} points the tool never was.")
    said.append(
        f"Of {w.visits_right.n} visits {_percent(w.visits_right)} % were released at the right point at least once, "
        f"{_percent(w.visits_wrong)} % at a wrong one."
    )
    if w.false.n:
        said.append(f"Of {w.false.n} releases {_percent(w.false)} % were at a point where the tool was not.")
    if w.elsewhere:
        said.append(f"Of {w.elsewhere} rows at no point {_percent(w.released_elsewhere)} % were released.")
    if report.calibrated is None:
        said.append("No covariance is reported: estimates were taken as exact, so that probabilities mean little.")
        return said
    said.append(f"The named point was claimed with {w.claimed:.1%} on average and was right in {w.named.value:.1%}.")
    if w.claimed < w.named.low:
        said.append("Less was claimed than is true: covariances are too large, and tuned ones would release more.")
    if w.claimed > w.named.high:
        said.append("More was claimed than is true: covariances are too small, and releases less sure than they look.")
    sure = [b for b in report.calibrated if b.low >= SURE and b.right.n]
    if sure:
        n = [b.right.n for b in sure]
        claimed = np.average([b.claimed for b in sure], weights=n)
        right = np.average([b.right.value for b in sure], weights=n)
        said.append(f"Where {SURE:.0%} or more was claimed ({sum(n)} rows, {claimed:.1%} on average) {right:.1%} were.")
    return said


def _percent(s: Share) -> str:
    return "–" if np.isnan(s.value) else f"{100 * s.value:.1f} [{100 * s.low:.1f}, {100 * s.high:.1f}]"

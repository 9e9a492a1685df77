"""Unlock decisions at fastening points, as a table and sentences."""

from __future__ import annotations

import numpy as np
from rich.table import Table

from trackwright.experiments.text.tables import compact_table, rendered
from trackwright.trackers.worksteps.decisions import LEVEL
from trackwright.trackers.worksteps.metrics import Share, UnlockMetrics
from trackwright.trackers.worksteps.tracks import WorkstepReport

SHOWN_POINTS = 20
"""Longest list of points; beyond that, those with most wrong unlock decisions are listed."""

SURE = 0.95
"""Predicted probability from which on the calibration is summarised in a sentence."""


def to_text(report: WorkstepReport, width: int = 120) -> str:
    """A table of unlock decisions by fastening point, and a summary."""
    return rendered(width, _table(report), *_sentences(report))


def _table(report: WorkstepReport) -> Table:
    title = f"Unlock decisions at {LEVEL:.0%} and within {report.tolerance:g} m; % of rows at a fastening point [95 %]"
    table = compact_table(title, ["point"], ["n", "visits", "right", "wrong", "missed", "named right"])
    listed = sorted(report.by_point.items(), key=lambda item: -item[1].wrong.value)[:SHOWN_POINTS]
    shown = {name for name, _ in listed}
    for name, w in report.by_point.items():
        if name in shown:
            table.add_row(name, *_cells(w))
    if len(report.by_point) > 1:
        table.add_row(f"all {len(report.by_point)}", *_cells(report.overall), style="bold")
    return table


def _cells(w: UnlockMetrics) -> list[str]:
    return [str(w.right.n), str(w.visits_right.n), *(_percent(s) for s in (w.right, w.wrong, w.missed, w.named))]


def _sentences(report: WorkstepReport) -> list[str]:
    w, sentences = report.overall, []
    sentences.append("Rows of one visit are correlated: the intervals count visits, not rows.")
    if len(report.by_point) > SHOWN_POINTS:
        sentences.append(
            f"Of {len(report.by_point)} points, the {SHOWN_POINTS} with most wrong unlock decisions are listed."
        )
    absent = len(report.points.names) - len(report.by_point)
    if absent:
        sentences.append(f"The tool was never at {absent} of the {len(report.points.names)} points.")
    sentences.append(
        f"Of {w.visits_right.n} visits, {_percent(w.visits_right)} % were unlocked at the right point at least once, "
        f"{_percent(w.visits_wrong)} % at a wrong one."
    )
    if w.false.n:
        sentences.append(
            f"Of {w.false.n} unlock decisions, {_percent(w.false)} % named a point where the tool was not."
        )
    if w.elsewhere:
        sentences.append(
            f"Of {w.elsewhere} rows away from all points, {_percent(w.released_elsewhere)} % were unlocked."
        )
    if report.calibrated is None:
        sentences.append(
            "The tracks have no covariance: estimates were taken as exact, so the probabilities are not calibrated."
        )
        return sentences
    sentences.append(
        f"The most probable point had a mean probability of {w.claimed:.1%} and was right in {w.named.value:.1%}."
    )
    if w.claimed < w.named.low:
        sentences.append(
            "The probabilities are underconfident: covariances are too large, and tuning them would unlock more rows."
        )
    if w.claimed > w.named.high:
        sentences.append("The probabilities are overconfident: covariances are too small, decisions more often wrong.")
    sure = [b for b in report.calibrated if b.low >= SURE and b.right.n]
    if sure:
        n = [b.right.n for b in sure]
        claimed = np.average([b.claimed for b in sure], weights=n)
        right = np.average([b.right.value for b in sure], weights=n)
        sentences.append(
            f"At probabilities of {SURE:.0%} or more ({sum(n)} rows, {claimed:.1%} on average), {right:.1%} were right."
        )
    return sentences


def _percent(s: Share) -> str:
    return "–" if np.isnan(s.value) else f"{100 * s.value:.1f} [{100 * s.low:.1f}, {100 * s.high:.1f}]"

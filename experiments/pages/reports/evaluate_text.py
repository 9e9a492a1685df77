"""What `evaluate` prints beside the error metrics: absolute and relative pose errors, and unlock decisions."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from rich.table import Table

from trackwright.experiments.text.tables import compact_table, rendered
from trackwright.experiments.text.wording import fixed, length_unit
from trackwright.trackers.exchange.estimates import ComparedTrack
from trackwright.trackers.exchange.pose_errors import Statistics, TrajectoryErrors
from trackwright.trackers.worksteps.decisions import LEVEL
from trackwright.trackers.worksteps.metrics import Share, UnlockMetrics
from trackwright.trackers.worksteps.tracks import WorkstepReport

SHOWN_TRACKS = 10
"""The most tracks listed: those with the largest APE."""

_STATISTICS = ("rmse", "mean", "median", "std", "min", "max")
_DEGREES = 180 / math.pi


def pose_errors_text(compared: Sequence[ComparedTrack], align: str, width: int, fitted_offset: bool = False) -> str:
    """The errors of each track, a row for each kind of error, and what was done to the estimates before.

    `fitted_offset`: whether the time offset is the one that fits best.
    """
    worst = sorted(compared, key=lambda track: -track.errors.ape_m["rmse"])[:SHOWN_TRACKS]
    several = len(compared) > 1
    unit = length_unit(worst[0].errors.ape_m["rmse"])
    table = compact_table(
        "Absolute and relative pose errors", ["tag", "error"] if several else ["error"], ["unit", "n", *_STATISTICS]
    )
    for track in worst:
        for k, (label, name, factor, errors) in enumerate(_rows(track.errors, unit.name, unit.factor)):
            shown = unit.digits + 1 if name == unit.name else 3
            cells = [fixed(errors[key] * factor, shown) for key in _STATISTICS]
            head = [track.tag if k == 0 else "", label] if several else [label]
            table.add_row(*head, name, str(errors["n"]), *cells)
    return rendered(width, table, *_pose_notes(compared, align, fitted_offset))


def _rows(errors: TrajectoryErrors, unit: str, factor: float) -> Iterator[tuple[str, str, float, Statistics]]:
    """Of each error: its name, its unit, the factor to it, and its statistics."""
    yield "APE", unit, factor, errors.ape_m
    if errors.ape_rad is not None:
        yield "APE, angle", "deg", _DEGREES, errors.ape_rad
    for step, statistics in errors.rpe_m.items():
        yield f"RPE {step}", unit, factor, statistics
        if step in errors.rpe_rad:
            yield f"RPE {step}, angle", "deg", _DEGREES, errors.rpe_rad[step]
    if errors.speed_mps is not None:
        yield "speed", "m/s", 1.0, errors.speed_mps


def _pose_notes(compared: Sequence[ComparedTrack], align: str, fitted_offset: bool) -> list[str]:
    errors = [track.errors for track in compared]
    pairs, possible = sum(e.pairs for e in errors), sum(e.possible for e in errors)
    offsets = sorted({round(e.time_offset, 4) for e in errors})
    offset = f"{offsets[0]:.12g}" if len(offsets) == 1 else f"{offsets[0]:.12g} to {offsets[-1]:.12g}"
    scales = [e.similarity.scale for e in errors]
    scale = "" if all(s == 1.0 for s in scales) else f", scale {min(scales):.6g} to {max(scales):.6g}"
    scale = f", scale {scales[0]:.6g}" if scale and len(scales) == 1 else scale
    notes = [
        f"As evo: {pairs} of {possible} poses have a true pose within {errors[0].tolerance:g} s; time offset {offset} "
        f"s; alignment {align}{scale}.",
        "The errors in the first table are of all rows, at the time of each, by the truth interpolated there.",
    ]
    if fitted_offset:
        notes.append(
            "The time offset is the one that fits best: a delay of the estimates, as a filter has, is part of it and "
            "does not count as error. The offset of the clocks alone is that of a smoothed track (`track --smooth`)."
        )
    if any(e.planar for e in errors):
        notes.append("APE and RPE are horizontal: a height is unknown.")
    if any(e.speed_mps is not None for e in errors):
        biases = [e.speed_mps["bias"] for e in errors if e.speed_mps is not None]
        notes.append(f"Speed: horizontal, over 0.5 s; mean error {sum(biases) / len(biases):+.4f} m/s.")
    if len(compared) > SHOWN_TRACKS:
        notes.append(f"At most {SHOWN_TRACKS} tracks are listed, those with the largest APE.")
    return notes


SHOWN_POINTS = 20
"""Longest list of points; beyond that, those with most wrong unlock decisions are listed."""

SURE = 0.95
"""Predicted probability from which on the calibration is summarised in a sentence."""


def worksteps_text(report: WorkstepReport) -> str:
    """A table of unlock decisions by fastening point, and a summary."""
    return rendered(120, _table(report), *_sentences(report))


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

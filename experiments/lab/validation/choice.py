"""Which tracker suits which readings, on real recordings, and the order of `trackers.catalogue.PREFERENCE`.

Every tracker runs with its default levels on every recording with truth that it fits. The recordings are not part of
this repository: TRACKWRIGHT_RECORDINGS names their folder, default `../shared/recordings`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from trackwright.experiments.cli.runtime import keep_programs
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table, shown
from trackwright.experiments.lab.subprocesses import required_recordings
from trackwright.experiments.lab.validation.sites import SEEN_BY_DEFAULTS
from trackwright.trackers.catalogue import PREFERENCE, TRACKERS, build
from trackwright.trackers.evaluation.evaluate import evaluate
from trackwright.trackers.recordings.folder import RecordingFolder, read_recordings

CLEAR = 0.95
"""Ratio of the errors of two trackers below which the first is better; above it the simpler one is preferred."""

LEAST_SHARE = 0.9
"""Share of its rows for which a tracker has an estimate, from which a recording decides about it."""

# fmt: off
SIMPLEST_FIRST = (
    # One row or a window at a time, without a filter.
    "das", "trilateration", "trilateration-compensated", "multilateration", "moving-average", "median",
    # One Kalman filter, by the size of its state; several models; chains; an IMU; grids; particles.
    "fix-kf", "fix-singer", "beam", "direct", "cascade", "bearings", "uwb", "tdoa", "fusion", "body", "imm",
    "fix-mirror", "mhk", "mhk-stamped", "uwb-imu", "tdoa-imu", "line-grid", "line-pf", "floor-pf",
)
# fmt: on
"""Every tracker of the catalogue, the simplest first: of two with equal errors the earlier one is preferred."""


class Figure(NamedTuple):
    """A tracker on a recording: horizontal RMSE, m, or that of directions, rad, and the share inside the 95 % ellipse.

    `inside`: None without a covariance over the floor. `share`: of its rows, those with an estimate. `fitted`: whether
    the default levels of the tracker were fitted on the truth of the recording.
    """

    recording: str
    tracker: str
    rmse: float
    inside: float | None
    share: float
    fitted: bool


def choice(*, output: Output = DEFAULTS) -> int:
    """Every tracker on every real recording that it fits, and the order that follows from their errors.

    1 where the catalogue has another order. With `--small` the first two recordings alone.
    """
    keep_programs()
    folders = [path.parent for path in sorted(required_recordings().glob("*/rig.toml"))]
    figures = []
    for folder in read_recordings(folders[: 2 if output.small else None]):
        for figure in figures_of(folder):
            shown([{"recording": figure.recording, "tracker": figure.tracker, "": _cell(figure)}])
            figures.append(figure)
    output.publish("validation choice", *tables(figures))
    if output.small:
        return 0
    other = [kind for kind, names in PREFERENCE.items() if order_of(figures, tuple(names)) != tuple(names)]
    for kind in other:
        order = ", ".join(order_of(figures, tuple(PREFERENCE[kind])))
        print(f"choice: PREFERENCE of {kind}: {', '.join(PREFERENCE[kind])}; measured: {order}", file=sys.stderr)
    return int(bool(other))


def figures_of(folder: RecordingFolder) -> Iterator[Figure]:
    """The figures of every tracker of the catalogue that fits a recording with truth; none without truth."""
    if "truth" not in folder.tables:
        return
    for name, spec in TRACKERS.items():
        if spec.missing(folder) is None:
            metrics = evaluate(build(name, folder).run(folder), folder).overall
            rmse = metrics["rmse_direction_rad" if spec.bearing_only else "rmse_m"]
            share = 1.0 - metrics["n_no_estimate"] / metrics["n_rows"]
            fitted = folder.name in SEEN_BY_DEFAULTS.get(name, ())
            yield Figure(folder.name, name, rmse, metrics["coverage_95"], share, fitted)


def beside(figures: Sequence[Figure], first: str, second: str) -> tuple[float, tuple[str, ...]]:
    """The errors of one tracker over those of another, and the recordings: the levels of neither were fitted on these.

    The geometric mean of the ratios.
    """
    decides: dict[str, dict[str, float]] = {first: {}, second: {}}
    for figure in figures:
        if figure.tracker in decides and not figure.fitted and figure.share >= LEAST_SHARE:
            decides[figure.tracker][figure.recording] = figure.rmse
    a, b = decides[first], decides[second]
    common = tuple(name for name in a if name in b)
    return float(np.exp(np.mean([np.log(a[k] / b[k]) for k in common]))) if common else 1.0, common


def order_of(figures: Sequence[Figure], names: Sequence[str]) -> tuple[str, ...]:
    """The trackers by preference: each time the simplest one of those left that none of these clearly beats.

    Those that no recording fits are last.
    """
    measured = {figure.tracker for figure in figures}
    left, order = sorted(names, key=lambda name: (name not in measured, SIMPLEST_FIRST.index(name))), []
    while left:
        unbeaten = (
            name for name in left if all(beside(figures, other, name)[0] >= CLEAR for other in left if other != name)
        )
        order.append(next(unbeaten, left[0]))
        left.remove(order[-1])
    return tuple(order)


def tables(figures: Sequence[Figure]) -> list[Table]:
    """The figures of all kinds of readings of which there are recordings, each with the first choice beside others."""
    result = []
    for kind, names in PREFERENCE.items():
        of_kind = {(figure.recording, figure.tracker): figure for figure in figures if figure.tracker in names}
        if of_kind:
            order = order_of(figures, tuple(names))
            listed = ", ".join(f"`{name}`" for name in order)
            title = kind[0].upper() + kind[1:]
            result.append(Table(_by_recording(of_kind, order), title, f"Order: {listed}."))
            if len(order) > 1:
                result.append(Table(_beside_others(figures, order), f"{title}: `{order[0]}` beside the others"))
    return result


def _by_recording(figures: Mapping[tuple[str, str], Figure], order: Sequence[str]) -> list[Row]:
    recordings = dict.fromkeys(recording for recording, _ in figures)
    return [
        {"recording": r, **{f"`{name}`": _cell(figures[r, name]) if (r, name) in figures else "" for name in order}}
        for r in recordings
    ]


def _beside_others(figures: Sequence[Figure], order: Sequence[str]) -> list[Row]:
    rows = []
    for name in order[1:]:
        ratio, names = beside(figures, order[0], name)
        decide = ", ".join(names) or "none: the simpler one"
        shown = f"{ratio:.2f}" if names else ""
        rows.append({"beside": f"`{name}`", "ratio of errors": shown, "recordings that decide": decide})
    return rows


def _cell(figure: Figure) -> str:
    directions = TRACKERS[figure.tracker].bearing_only
    error = f"{np.degrees(figure.rmse):.1f}°" if directions else f"{100 * figure.rmse:.1f} cm"
    inside = "" if figure.inside is None else f", {100 * figure.inside:.0f} %"
    rows = f" ({100 * figure.share:.0f} % of the rows)" if figure.share < 0.985 else ""
    return f"{error}{inside}{rows}{'*' if figure.fitted else ''}"

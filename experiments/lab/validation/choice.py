"""Which tracker suits which readings, on real recordings: `python -m trackwright.experiments.lab.validation.choice`.

Every tracker runs with its default levels on every recording with truth that it fits. The command writes the figures
and the order that they imply to docs/which-tracker.md, and ends with exit code 1 where `trackers.catalogue.PREFERENCE`
has another order. The recordings are not part of this repository: TRACKWRIGHT_RECORDINGS names their folder, default
`../shared/recordings`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from trackwright.experiments.cli.main import run_alone
from trackwright.experiments.cli.runtime import keep_programs, set_flags
from trackwright.experiments.lab.bench.timing import replace_tables
from trackwright.experiments.lab.subprocesses import REPOSITORY, required_recordings
from trackwright.experiments.lab.validation.folds import SEEN_BY_DEFAULTS
from trackwright.experiments.text.tables import markdown
from trackwright.trackers.catalogue import PREFERENCE, TRACKERS, build
from trackwright.trackers.evaluation.evaluate import evaluate
from trackwright.trackers.recordings.folder import RecordingFolder, read_recordings

PAGE = REPOSITORY / "docs" / "which-tracker.md"
MODULE = "trackwright.experiments.lab.validation.choice"

CLEAR = 0.95
"""Ratio of the errors of two trackers below which the first is better; above it the simpler one is preferred."""

LEAST_SHARE = 0.9
"""Share of its rows for which a tracker has an estimate, from which a recording decides about it."""

# fmt: off
SIMPLEST_FIRST = (
    # One row or a window at a time, without a filter.
    "das", "trilateration", "trilateration-compensated", "multilateration", "moving-average", "median",
    # One Kalman filter, by the size of its state; several models; chains; an IMU; grids; particles.
    "fix-kf", "fix-singer", "beam", "direct", "cascade", "bearings", "uwb", "imm", "fix-mirror", "mhk", "mhk-stamped",
    "uwb-imu", "line-grid", "line-pf", "floor-pf",
)
# fmt: on
"""Every tracker of the catalogue, the simplest first: of two with equal errors the earlier one is preferred."""


INTRODUCTION = """`python -m {module}`, {seconds:.0f} s: every tracker on every real recording that it fits,
with its default levels. Each cell: horizontal RMSE, or that of the direction, and the share of the truth inside the
95 % ellipse.

A tracker is preferred to a simpler one where the geometric mean of the ratios of their errors is below {clear:g}. A
recording decides between two trackers unless default levels of one of them were fitted on its truth (marked by \\*), or
one has estimates for less than {least:.0f} % of its rows. All other levels were set by hand with these recordings at
hand. Trackers without a known path do not use that of ngbui-line.
"""


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


class Beside(NamedTuple):
    """Two trackers on the recordings that decide between them: the geometric mean of the ratios of their errors."""

    ratio: float
    recordings: tuple[str, ...]


def main(*, page: Path | None = None) -> int:
    """Measure every tracker on every recording that it fits, write the tables, and return 1 where the order differs.

    Args:
        page: the page whose tables are replaced; default docs/which-tracker.md.
    """
    set_flags()
    keep_programs()
    root = required_recordings()
    began = time.monotonic()
    figures = []
    for folder in read_recordings([path.parent for path in sorted(root.glob("*/rig.toml"))]):
        for figure in figures_of(folder):
            print(f"{figure.recording:20}{figure.tracker:28}{_cell(figure)}", flush=True)
            figures.append(figure)
    replace_tables(page or PAGE, MODULE, written(figures, time.monotonic() - began))
    other = [kind for kind, names in PREFERENCE.items() if order_of(figures, names) != names]
    for kind in other:
        found = ", ".join(order_of(figures, PREFERENCE[kind]))
        print(f"choice: PREFERENCE of {kind}: {', '.join(PREFERENCE[kind])}; measured: {found}", file=sys.stderr)
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


def beside(figures: Sequence[Figure], first: str, second: str) -> Beside:
    """The errors of one tracker over those of another, on the recordings on which the levels of neither were fitted."""
    decides: dict[str, dict[str, float]] = {first: {}, second: {}}
    for one in figures:
        if one.tracker in decides and not one.fitted and one.share >= LEAST_SHARE:
            decides[one.tracker][one.recording] = one.rmse
    a, b = decides[first], decides[second]
    common = tuple(name for name in a if name in b)
    return Beside(float(np.exp(np.mean([np.log(a[k] / b[k]) for k in common]))) if common else 1.0, common)


def order_of(figures: Sequence[Figure], names: Sequence[str]) -> tuple[str, ...]:
    """The trackers by preference: each time the simplest one of those left that none of these clearly beats.

    Those that no recording fits are last.
    """
    measured = {one.tracker for one in figures}
    left, found = sorted(names, key=lambda name: (name not in measured, SIMPLEST_FIRST.index(name))), []
    while left:
        unbeaten = (
            one for one in left if all(beside(figures, other, one).ratio >= CLEAR for other in left if other != one)
        )
        found.append(next(unbeaten, left[0]))
        left.remove(found[-1])
    return tuple(found)


def written(figures: Sequence[Figure], seconds: float) -> str:
    """The tables of all kinds of readings of which there are recordings, in Markdown."""
    parts = [INTRODUCTION.format(module=MODULE, seconds=seconds, least=100 * LEAST_SHARE, clear=CLEAR)]
    for kind, names in PREFERENCE.items():
        own = {(one.recording, one.tracker): one for one in figures if one.tracker in names}
        if own:
            parts.append(_section(kind, order_of(figures, names), own, figures))
    return "\n".join(parts)


def _section(kind: str, order: Sequence[str], own: Mapping[tuple[str, str], Figure], figures: Sequence[Figure]) -> str:
    """The figures of a kind of readings, and the first choice beside each other tracker."""
    rows = [["recording", *(f"`{name}`" for name in order)]]
    for recording in dict.fromkeys(name for name, _ in own):
        cells = [own.get((recording, name)) for name in order]
        rows.append([recording, *("" if one is None else _cell(one) for one in cells)])
    parts = [f"### {kind[0].upper()}{kind[1:]}\n", f"Order: {', '.join(f'`{name}`' for name in order)}.\n"]
    parts.append(markdown(rows, range(1, len(order) + 1)))
    if len(order) > 1:
        rows = [[f"`{order[0]}` beside", "ratio of errors", "recordings that decide"]]
        for name in order[1:]:
            ratio, names = beside(figures, order[0], name)
            rows.append([f"`{name}`", f"{ratio:.2f}" if names else "", ", ".join(names) or "none: the simpler one"])
        parts.append(markdown(rows, [1]))
    return "\n".join(parts)


def _cell(one: Figure) -> str:
    directions = TRACKERS[one.tracker].bearing_only
    error = f"{np.degrees(one.rmse):.1f}°" if directions else f"{100 * one.rmse:.1f} cm"
    inside = "" if one.inside is None else f", {100 * one.inside:.0f} %"
    rows = f" ({100 * one.share:.0f} % of the rows)" if one.share < 0.985 else ""
    return f"{error}{inside}{rows}{'*' if one.fitted else ''}"


if __name__ == "__main__":
    run_alone(main, f"python -m {MODULE}")

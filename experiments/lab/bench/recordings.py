"""Running time per row of every tracker that fits a real recording, beside the same filter in NumPy and in filterpy."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from trackwright.experiments.lab.bench.loops import model_of, state_after
from trackwright.experiments.lab.bench.timing import clocked, turns
from trackwright.experiments.lab.benchmark.adapters import with_filterpy
from trackwright.experiments.lab.benchmark.adapters.plain import filtered
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table, shown
from trackwright.experiments.lab.subprocesses import required_recordings
from trackwright.trackers.catalogue import TRACKERS
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.recordings.folder import read_recording

RECORDINGS = (
    "starloc-fast-s1",
    "iasl-drone-1",
    "labyrinth",
    "ngbui-line-1-1",
    "tiers-1tag-01",
    "ble51-walk-u1-r1",
    "ble51-uca-x0y2",
)
"""One recording of each kind."""

AGREEMENT_M = 1e-5
"""Largest median distance of the positions of a loop, in double precision, and of ours in single, for one filter."""

ROUNDS = 5
LOOP_ROWS = 1000
"""Rows of a loop, whose time per row does not depend on their number."""

Runs = dict[str, tuple[Callable[[], Any], int]]
"""Runs and their numbers of rows, by name."""


def recordings(
    *,
    recordings: tuple[str, ...] = RECORDINGS,
    trackers: tuple[str, ...] = (),
    smooth: bool = False,
    output: Output = DEFAULTS,
) -> int:
    """Running time per row of every tracker that fits a real recording, beside the same filter in NumPy and filterpy.

    Processor time of `tracker.run` of a compiled program, tables read and rows cut before. A loop is written for
    ranges, fixes and bearings with constant velocity, and for ranges with an IMU in fifteen states; it begins after a
    quarter of the rows from our estimate there (filterpy: extra peers). 1 where a loop's positions are not ours.

    Args:
        recordings: folders of TRACKWRIGHT_RECORDINGS.
        trackers: names of trackers; by default all that fit.
        smooth: also the smoothed estimates.
    """
    root = required_recordings()
    rounds, chosen = output.rounds(ROUNDS), recordings[:1] if output.small else recordings
    rows = shown(row for name in chosen for row in measured(root / name, trackers, smooth, rounds))
    output.publish("bench recordings", Table(rows))
    others = [f"{row['tracker']} on {row['recording']}" for row in rows if (row["difference m"] or 0.0) > AGREEMENT_M]
    if others:
        print(
            f"bench: positions of the NumPy loop differ by more than {AGREEMENT_M} m, median: {', '.join(others)}; "
            "expected those of the tracker",
            file=sys.stderr,
        )
    return int(bool(others))


def measured(path: Path, names: tuple[str, ...], smooth: bool, rounds: int) -> Iterator[Row]:
    """The results of every tracker, or of those named, that fits a recording."""
    folder = read_recording(path)
    for name, spec in TRACKERS.items():
        if (names and name not in names) or spec.missing(folder) is not None:
            continue
        batches = spec.batches([folder], name)
        each = [[t.recording for t in batch.trajectories] for batch in batches]
        rows = sum(len(recording) for group in each for recording in group)

        def run(batches: Any = batches, each: Any = each) -> list[Any]:
            return [batch.tracker.run(group) for batch, group in zip(batches, each, strict=True)]

        (first, _), estimates = clocked(run)
        runs: Runs = {"ours": (run, rows)}
        smoothed = smoother(batches, each) if smooth else None
        if smoothed is not None:
            smoothed()
            runs["smoothed"] = smoothed, rows
        runs |= loops(batches[0], each[0][0], estimates[0][0])
        seconds = np.median(turns((function for function, _ in runs.values()), rounds), axis=0)
        per_row = {k: 1e6 * s / count for (k, (_, count)), s in zip(runs.items(), seconds, strict=True)}
        cpu = {k: float(s[1]) for k, s in per_row.items()}
        yield {
            "recording": path.name,
            "tracker": name,
            "rows": rows,
            "states": estimates[0].dimension,
            "first call s": first,
            "µs/row": cpu["ours"],
            "wall µs/row": float(per_row["ours"][0]),
            "smoothed µs/row": cpu.get("smoothed"),
            "NumPy µs/row": cpu.get("NumPy"),
            "ours × faster": cpu["NumPy"] / cpu["ours"] if "NumPy" in cpu else None,
            "filterpy µs/row": cpu.get("filterpy"),
            "difference m": difference(runs["NumPy"][0](), estimates[0][0], len(each[0][0]))
            if "NumPy" in cpu
            else None,
        }


def smoother(batches: Any, recordings: Any) -> Callable[[], Any] | None:
    """A run of the smoothed trackers; None for those without a smoother."""
    try:
        trackers = [Smoothed(batch.tracker, None) for batch in batches]
    except TypeError:
        return None
    return lambda: [t.run(each) for t, each in zip(trackers, recordings, strict=True)]


def loops(batch: Any, recording: Any, estimates: Any) -> Runs:
    """The same filter in NumPy and in filterpy, for one recording; none where no loop is written.

    A mixture is its number of filters one after another.
    """
    model = model_of(batch.tracker, recording, batch.planar)
    first, last = loop_rows(len(recording))
    if model is None or not estimates.usable[first - 1]:
        return {}
    state, P = state_after(first - 1, batch.tracker, estimates)
    dts = np.diff(recording.times, prepend=recording.times[0])[:last]
    count = getattr(batch.tracker.filter, "count", 1)
    runs: Runs = {"NumPy": (lambda: [filtered(model, state, P, dts, first)[0] for _ in range(count)], last - first)}
    if importlib.util.find_spec("filterpy") and not isinstance(state, tuple):
        runs["filterpy"] = (lambda: with_filterpy.filtered(model, state, P, dts, first)), last - first
    return runs


def loop_rows(rows: int) -> tuple[int, int]:
    """The first row of a loop and the one after its last."""
    first = max(rows // 4, 1)
    return first, min(rows, first + LOOP_ROWS)


def difference(means: list[np.ndarray], estimates: Any, rows: int) -> float:
    """Median distance, m, of the positions of a loop and ours, for a recording of `rows` rows, padding beyond them.

    Where rounding to single precision changes the sign of a residual, a skewed density has another scale, and the
    estimates differ for a while.
    """
    first, last = loop_rows(rows)
    positions = np.stack([np.asarray(x, float) for x in estimates.mean.position], axis=-1)[first:last]
    return float(np.median(np.linalg.norm(means[0][:, : positions.shape[1]] - positions, axis=1)))

"""Running time per row of every tracker that fits a real recording: `python -m experiments.lab.bench.recordings`.

Processor time of `tracker.run` of a compiled program, tables read and rows cut before, beside the same filter as a
plain NumPy loop and in filterpy (extra: peers) where one is written: ranges, fixes and bearings with constant velocity,
ranges with an IMU in fifteen states. The loops begin after a quarter of the rows from our estimate there. Recordings:
TRACKWRIGHT_RECORDINGS.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from experiments.cli.main import run_alone
from experiments.cli.runtime import set_flags
from experiments.lab.bench.timing import clocked, replace_tables, turns, write_json
from experiments.lab.subprocesses import recordings_folder

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

COLUMNS = (
    "recording",
    "tracker",
    "rows",
    "states",
    "first call s",
    "us/row",
    "wall us/row",
    "smoothed us/row",
    "NumPy us/row",
    "ours x faster",
    "filterpy us/row",
    "difference m",
)


def main(
    *,
    recordings: tuple[str, ...] = RECORDINGS,
    trackers: tuple[str, ...] = (),
    smooth: bool = False,
    page: Path | None = None,
    out: Path = Path("out/bench-recordings.json"),
) -> int:
    """Measure, print a table and write the results as JSON; 1 where a loop's positions are not ours.

    Args:
        recordings: folders of TRACKWRIGHT_RECORDINGS.
        trackers: names of trackers; by default all that fit.
        smooth: also the smoothed estimates.
        page: the page whose table is replaced, as docs/performance.md.
        out: the JSON file to write.
    """
    set_flags()
    root = recordings_folder()
    if root is None:
        print("bench: left out: no folder of recordings; set TRACKWRIGHT_RECORDINGS", file=sys.stderr)
        return 0
    from experiments.lab.bench.__main__ import machine
    from experiments.text.tables import aligned

    began, host = datetime.now(UTC), machine()
    found = []
    for recording in recordings:
        for row in measured(root / recording, trackers, smooth):
            found.append(row)
            print("  ".join(f"{k} {cell(row[k])}" for k in COLUMNS if row[k] is not None), file=sys.stderr, flush=True)
    print(aligned([COLUMNS, *[[cell(row[k]) for k in COLUMNS] for row in found]], range(2, len(COLUMNS))))
    command = ["python", "-m", "experiments.lab.bench.recordings", *sys.argv[1:]]
    if page is not None:
        heading = f"{host['cpu']}, {host['cores']} cores, {began:%Y-%m-%d}, `{' '.join(command)}`."
        replace_tables(page, "experiments.lab.bench.recordings", f"{heading}\n\n{markdown(found)}\n")
    write_json(
        out,
        {
            "date": began.isoformat(timespec="seconds"),
            "command": command,
            "machine": host,
            "rows": found,
            "took_s": (datetime.now(UTC) - began).total_seconds(),
        },
    )
    print(f"Written: {out}")
    others = [f"{row['tracker']} on {row['recording']}" for row in found if (row["difference m"] or 0.0) > AGREEMENT_M]
    if others:
        print(
            f"bench: positions of the NumPy loop differ by more than {AGREEMENT_M} m, median: {', '.join(others)}; "
            "expected those of the tracker",
            file=sys.stderr,
        )
    return 1 if others else 0


def cell(value: Any) -> str:
    """A number or a text of the table; nothing for None."""
    return "" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)


def markdown(found: Sequence[Mapping[str, Any]]) -> str:
    """The rows as a Markdown table, without the columns that are for the terminal alone."""
    columns = [k for k in COLUMNS if k not in ("wall us/row", "difference m")]
    lines = [[k.replace("us/", "µs/").replace(" x ", " × ") for k in columns], ["---", "---", *["---:"] * 8]]
    lines += [[cell(row[k]) for k in columns] for row in found]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def measured(path: Path, names: tuple[str, ...], smooth: bool) -> Iterator[dict[str, Any]]:
    """The results of every tracker, or of those named, that fits a recording."""
    from trackers.catalogue import TRACKERS
    from trackers.recordings.folder import read_recording

    folder = read_recording(path)
    for name, spec in TRACKERS.items():
        if (names and name not in names) or spec.missing(folder) is not None:
            continue
        batches = spec.batches([folder], name)
        recordings = [[t.recording for t in batch.trajectories] for batch in batches]
        rows = sum(len(recording) for each in recordings for recording in each)

        def run(batches: Any = batches, recordings: Any = recordings) -> list[Any]:
            return [batch.tracker.run(each) for batch, each in zip(batches, recordings, strict=True)]

        (first, _), estimates = clocked(run)
        runs: dict[str, tuple[Callable[[], Any], int]] = {"ours": (run, rows)}
        smoothed = smoother(batches, recordings) if smooth else None
        if smoothed is not None:
            smoothed()
            runs["smoothed"] = smoothed, rows
        runs |= loops(batches[0], recordings[0][0], estimates[0][0])
        seconds = np.median(turns([function for function, _ in runs.values()], ROUNDS), axis=0)
        per_row = {k: 1e6 * s / count for (k, (_, count)), s in zip(runs.items(), seconds, strict=True)}
        cpu = {k: float(s[1]) for k, s in per_row.items()}
        yield {
            "recording": path.name,
            "tracker": name,
            "rows": rows,
            "states": estimates[0].dimension,
            "first call s": first,
            "us/row": cpu["ours"],
            "wall us/row": float(per_row["ours"][0]),
            "smoothed us/row": cpu.get("smoothed"),
            "NumPy us/row": cpu.get("NumPy"),
            "ours x faster": cpu["NumPy"] / cpu["ours"] if "NumPy" in cpu else None,
            "filterpy us/row": cpu.get("filterpy"),
            "difference m": difference(runs["NumPy"][0](), estimates[0][0], len(recordings[0][0]))
            if "NumPy" in runs
            else None,
        }


def smoother(batches: Any, recordings: Any) -> Callable[[], Any] | None:
    """A run of the smoothed trackers; None for those without a smoother."""
    from trackers.core.smoother import Smoothed

    try:
        trackers = [Smoothed(batch.tracker, None) for batch in batches]
    except TypeError:
        return None
    return lambda: [t.run(each) for t, each in zip(trackers, recordings, strict=True)]


def loops(batch: Any, recording: Any, estimates: Any) -> dict[str, tuple[Callable[[], Any], int]]:
    """The same filter in NumPy and in filterpy and their rows, for one recording; none where no loop is written.

    A mixture is its number of filters one after another.
    """
    import jax

    from experiments.lab.bench.loops import filtered, model_of, vector, with_filterpy

    model = model_of(batch.tracker, recording, batch.planar)
    first, last = loop_rows(len(recording))
    if model is None or not estimates.usable[first - 1]:
        return {}
    state = vector(jax.tree_util.tree_map(lambda x: x[first - 1], estimates.mean))
    P = np.asarray(estimates.covariance[first - 1], float)
    dts = np.diff(recording.times, prepend=recording.times[0])[:last]
    count = getattr(batch.tracker.filter, "count", 1)
    runs: dict[str, tuple[Callable[[], Any], int]] = {
        "NumPy": (lambda: [filtered(model, state, P, dts, first) for _ in range(count)], last - first)
    }
    if importlib.util.find_spec("filterpy") and not isinstance(state, tuple):
        runs["filterpy"] = (lambda: with_filterpy(model, state, P, dts, first)), last - first
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
    own = np.stack([np.asarray(x, float) for x in estimates.mean.position], axis=-1)[first:last]
    return float(np.median(np.linalg.norm(means[0][:, : own.shape[1]] - own, axis=1)))


if __name__ == "__main__":
    run_alone(main, "python -m experiments.lab.bench.recordings")

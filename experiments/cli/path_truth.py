"""`trackwright import --path`: a recording with a truth along its known path."""

from __future__ import annotations

import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import polars as pl

    from trackwright.trackers.line.truth import KnotTimes
    from trackwright.trackers.recordings.folder import RecordingFolder


def import_with_path_truth(recording: Path, out: Path) -> int:
    """Writes a recording with the truth fitted along [path] of its rig to its fixes, or positions from its ranges.

    Every tag travels once from the first to the last knot, at a constant speed on each segment, with rests at the
    knots. The knot times are fitted by least squares.
    """
    started = datetime.now(UTC)
    from trackwright.experiments.cli.console import read_with_notices
    from trackwright.experiments.cli.runtime import keep_programs, write_manifest
    from trackwright.trackers.recordings.folder import write_recording

    (folder,) = read_with_notices((recording,))
    keep_programs()
    # jax takes a second to import, which the help and a refused recording need not wait for.
    from trackwright.trackers.line.rows import fit_path_truth

    fitted, knot_times = fit_path_truth(folder)
    table = fitted.tables["truth"]
    _notice_deviation(folder, table)
    write_recording(fitted, out)
    write_manifest(out, sys.argv, {"recording": str(recording)}, started)
    print("\n".join(_knots_line(tag, times) for tag, times in knot_times.items()))
    print(f"wrote {out}: the recording with a fitted truth of {len(table)} rows; use it: evaluate … --truth {out}")
    return 0


def _knots_line(tag: str, fitted: KnotTimes) -> str:
    import numpy as np

    lengths = np.sqrt((np.diff(fitted.knots, axis=0) ** 2).sum(axis=1))
    segments = [
        f"{a:.2f}-{b:.2f} s ({n / (b - a):.2f} m/s)"
        for a, b, n in zip(fitted.departed, fitted.arrived, lengths, strict=True)
        if b > a
    ]
    return f"tag {tag}: {fitted.rms:.3f} m RMS about the path; segments {', '.join(segments)}"


def _notice_deviation(folder: RecordingFolder, table: pl.DataFrame) -> None:
    """Notice of the deviation from the recording's own truth, if it has one."""
    if "truth" not in folder.tables:
        return
    import numpy as np

    from trackwright.experiments.text.terminal import notice
    from trackwright.trackers.recordings.truth import TruePaths

    fitted = TruePaths.of_table(table, folder.name)
    for tag in sorted(folder.paths.number.keys() & fitted.number.keys()):
        times, positions = fitted.of_tag(tag)
        known, _ = folder.paths.at([tag], np.array([0, len(times)]), times)
        deviation = np.sqrt(((positions - known)[:, :2] ** 2).sum(axis=1))
        if np.isfinite(deviation).any():
            rms = np.sqrt(np.nanmean(deviation**2))
            notice(f"notice: tag {tag}: the recording's own truth is replaced; RMS deviation {rms:.3f} m")

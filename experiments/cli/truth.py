"""`trackwright truth`."""

from __future__ import annotations

import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import numpy as np
import polars as pl
import tyro

from experiments.cli.console import notice, read_with_notices
from experiments.cli.manifest import write_manifest
from trackers.core.errors import UnusableInput
from trackers.line.rows import line_trajectories, path_of, raw_positions
from trackers.line.truth import KnotTimes, knot_times
from trackers.recordings.folder import RecordingFolder, write_recording
from trackers.recordings.trajectories import known_height
from trackers.recordings.truth import interpolate_truth, truth_paths


def truth(recording: Annotated[Path, tyro.conf.Positional], out: Path) -> int:
    """Fit ground truth along a known path by least squares: writes the recording with a truth table.

    Every tag travels once from the first to the last knot of [path] in rig.toml, at a constant speed on each segment,
    with rests at the knots. The knot times are fitted to its fixes, or to positions from its ranges.

    Args:
        recording: a recording folder with [path] knots_m in rig.toml and a fixes or ranges table.
        out: the folder to write; it must not exist or be empty.
    """
    started = datetime.now(UTC)
    (folder,) = read_with_notices((recording,))
    path_of(folder)
    if not {"fixes", "ranges"} & set(folder.tables):
        raise UnusableInput(
            f"{recording}: tables {', '.join(folder.tables)}, expected fixes or ranges to fit a truth to; add one"
        )
    rows, lines = [], []
    for trajectory in line_trajectories(folder, False):
        times, measured = raw_positions(trajectory)
        known = np.isfinite(measured).all(axis=1)
        try:
            fitted = knot_times(np.asarray(folder.rig.path_knots), times[known], measured[known])
        except ValueError as problem:
            raise UnusableInput(f"{recording}: tag '{trajectory.tag}': {problem}; record for longer") from problem
        rows.append(_rows(folder, trajectory.tag, times, fitted))
        lines.append(_line(trajectory.tag, fitted))
    table = pl.concat(rows).sort("t_s", maintain_order=True)
    _compare(folder, table)
    write_recording(RecordingFolder(folder.name, None, folder.rig, folder.tables | {"truth": table}), out)
    write_manifest(out, sys.argv, {"recording": str(recording)}, started)
    print("\n".join(lines))
    print(f"wrote {out}: the recording with a fitted truth of {len(table)} rows; use it: evaluate … --truth {out}")
    return 0


def _rows(folder: RecordingFolder, tag: str, times: np.ndarray, fitted: KnotTimes) -> pl.DataFrame:
    # Rows at the knot times, too: interpolation between measurement times would cut the corners of the path.
    at = np.unique(np.concatenate([times, fitted.departed, fitted.arrived]))
    positions = fitted.positions(at)
    height = known_height(folder, tag)
    return pl.DataFrame(
        {"t_s": at, "tag": [tag] * len(at), "x_m": positions[:, 0], "y_m": positions[:, 1]}
    ).with_columns(pl.lit(height, pl.Float64).alias("z_m"))


def _line(tag: str, fitted: KnotTimes) -> str:
    lengths = np.sqrt((np.diff(fitted.knots, axis=0) ** 2).sum(axis=1))
    segments = [
        f"{a:.2f}-{b:.2f} s ({n / (b - a):.2f} m/s)"
        for a, b, n in zip(fitted.departed, fitted.arrived, lengths, strict=True)
        if b > a
    ]
    return f"tag {tag}: {fitted.rms:.3f} m RMS about the path; segments {', '.join(segments)}"


def _compare(folder: RecordingFolder, table: pl.DataFrame) -> None:
    """Notice of the deviation from the recording's own truth, if it has one."""
    if "truth" not in folder.tables:
        return
    given, fitted = truth_paths(folder.tables["truth"], folder.name), truth_paths(table, folder.name)
    for tag in sorted(given.keys() & fitted.keys()):
        times, positions = fitted[tag]
        known, _ = interpolate_truth(times, *given[tag])
        deviation = np.sqrt(((positions - known)[:, :2] ** 2).sum(axis=1))
        if np.isfinite(deviation).any():
            rms = np.sqrt(np.nanmean(deviation**2))
            notice(f"notice: tag {tag}: the recording's own truth is replaced; RMS deviation {rms:.3f} m")

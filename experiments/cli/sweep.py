"""`trackwright sweep`: its options; `sweep_job.py` does the work."""

from __future__ import annotations

import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from experiments.cli.console import read_with_notices
from experiments.cli.runtime import keep_programs
from trackers.core.errors import UnusableInput

FORM = "PATTERN=START:STOP:COUNT, as 'motion.sigma_a=0.01:1:100'"


def sweep(
    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path,
    over: tyro.conf.UseAppendAction[tuple[str, ...]],
    tracker: str | None = None,
    objective: str = "rmse",
    dimensions: Literal[2, 3] = 2,
    weigh: Literal["recordings", "rows"] = "recordings",
    repeats: int = 10,
    noise: Path | None = None,
    calibration: Path | None = None,
    average: float | None = None,
    path: Path | None = None,
    free_height: bool = False,
    piece_rows: int = 8000,
) -> int:
    """Evaluate an objective on a grid of one or two noise levels: writes sweep.csv, sweep.png and manifest.json.

    Args:
        recordings: recording folders, all at once.
        out: the folder to write to.
        over: PATTERN=START:STOP:COUNT: a shell pattern of tunables, tied, and their values; once or twice.
        tracker: as in `track`; default: what fits the tables.
        objective: rmse (needs truth), nll, or another objective of `tune`.
        dimensions: 2 to judge the horizontal position, 3 to judge an estimated height too.
        weigh: what has the same say: each recording, or each row, so that long recordings decide.
        repeats: runs of a particle filter per value, with different random numbers.
        noise: a tuned.toml for the other parameters.
        calibration: a calibration.toml of `trackwright calibrate` on other recordings of these stations or anchors.
        average: average the ranges, fixes and bearings of each tag and anchor or station over so many seconds;
        0: every reading; default: 0.5 for bearings that repeat.
        path: an output folder of `tune`, or its trace.csv, to draw as optimiser trace.
        free_height: estimate the height of tags whose height the rig gives.
        piece_rows: long recordings are cut into segments of about this many rows, as in `tune`.
    """
    started, clock = datetime.now(UTC), time.perf_counter()
    if repeats < 1 or piece_rows < 10:
        raise UnusableInput(f"--repeats {repeats} --piece-rows {piece_rows}: expected at least 1 and 10")
    grids = _grids(over)
    folders = read_with_notices(recordings, calibration, average)
    options = {
        "tracker": tracker, "over": over, "objective": objective, "dimensions": dimensions, "weigh": weigh,
        "repeats": repeats, "noise": noise, "calibration": calibration, "average": average, "path": path,
        "free_height": free_height, "piece_rows": piece_rows,
    }  # fmt: skip
    keep_programs()
    # jax takes a second to import, which the help and a refused recording need not wait for.
    from experiments.cli.sweep_job import sweep_folders

    return sweep_folders(folders, recordings, out, grids, options, started, clock)


def _grids(over: Sequence[str]) -> dict[str, np.ndarray]:
    """The grids by pattern; raises UnusableInput."""
    if not 1 <= len(over) <= 2:
        raise UnusableInput(
            f"--over given {len(over)} times: expected once or twice; sweep further parameters separately"
        )
    grids = {}
    for text in over:
        pattern, _, span = text.rpartition("=")
        try:
            start, stop, count = (kind(x) for kind, x in zip((float, float, int), span.split(":"), strict=True))
        except ValueError as error:
            raise UnusableInput(f"--over {text}: expected {FORM}") from error
        if not pattern or not (np.isfinite(start) and np.isfinite(stop)):
            raise UnusableInput(f"--over {text}: expected {FORM}")
        if count < 2 or start >= stop:
            raise UnusableInput(f"--over {text}: expected {FORM}, START below STOP and COUNT at least 2")
        if pattern in grids:
            raise UnusableInput(f"--over {pattern}: duplicate, expected two different patterns")
        grids[pattern] = np.linspace(start, stop, count)
    return grids

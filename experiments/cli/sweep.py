"""`trackwright sweep`: its options; `sweep_job.py` does the work."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from experiments.cli.arguments import FigureFormat, File, Folder, Folders
from experiments.cli.console import ReadingOptions, json_alone, read_with_notices, require_output
from experiments.cli.runtime import keep_programs
from experiments.cli.tune import require_counts
from experiments.text.terminal import stages
from trackers.core.errors import UnusableInput
from tuning.tuned_file import parse_values, read_tuned

FORM = "PATTERN=START:STOP:COUNT, as 'motion.sigma_a=0.01:1:100', with ':log' at the end for equal ratios"


def sweep(
    recordings: Folders,
    *,
    out: Folder,
    over: Annotated[tuple[str, ...], "PATTERN=START:STOP:COUNT[:log]"],
    tracker: Annotated[str | None, "NAME"] = None,
    objective: Annotated[str, "NAME"] = "rmse",
    dimensions: Literal[2, 3] = 2,
    weigh: Literal["recordings", "rows"] = "recordings",
    repeats: int = 10,
    noise: File | None = None,
    set_: Annotated[tuple[str, ...], "NAME=VALUE"] = (),
    used: ReadingOptions,
    path: Annotated[Path | None, "FOLDER"] = None,
    free_height: bool = False,
    piece_rows: int = 8000,
    format: FigureFormat = "png",
    json: bool = False,
) -> int:
    """Evaluate an objective on a grid of one or two noise levels.

    Writes sweep.csv, the figure sweep.png and manifest.json.

    Args:
        recordings: recording folders, all at once.
        out: the folder to write to.
        over: a shell pattern of tunables, tied, and their values; once or twice. ':log' makes equal ratios.
        tracker: as in `track`; default: that of the noise file, else the one that fits the tables.
        objective: rmse (needs truth), nll, or another objective of `tune`.
        dimensions: 2 to judge the horizontal position, 3 to judge an estimated height too.
        weigh: recordings or rows: which of them have the same weight.
        repeats: runs of a particle filter per value, with different random numbers.
        noise: a tuned.toml for the other parameters.
        set_: values of other parameters, by tunable or pattern.
        path: an output folder of `tune`, or its trace.csv, to draw as optimiser trace.
        free_height: estimate the height of tags whose height the rig gives.
        piece_rows: rows of the segments into which long recordings are cut, as in `tune`.
        format: of the figure, sweep.png or sweep.pdf.
        json: print the best point as JSON instead of a line.
    """
    started, clock = datetime.now(UTC), time.perf_counter()
    options: dict[str, Any] = {
        "tracker": tracker, "over": over, "objective": objective, "dimensions": dimensions, "weigh": weigh,
        "repeats": repeats, "noise": noise, "set": set_, "calibration": used.calibration,
        "part": dataclasses.asdict(used.part), "average": used.average, "path": path, "free_height": free_height,
        "piece_rows": piece_rows,
    }  # fmt: skip
    require_counts(options)
    require_output(out)
    grids, values = _grids(over), parse_values(set_, "--set")
    tuned = None if noise is None else read_tuned(noise)
    with json_alone(json) as put, stages("sweep") as begin:
        begin("reading")
        folders = read_with_notices(recordings, used)
        begin("preparing")
        keep_programs()
        # jax takes a second to import, which the help and a refused recording need not wait for.
        from experiments.cli.sweep_job import sweep_folders

        put(sweep_folders(folders, recordings, out, grids, options, tuned, values, started, clock, begin, format))
    return 0


def _grids(over: Sequence[str]) -> dict[str, np.ndarray]:
    """The grids by pattern; raises UnusableInput."""
    if not 1 <= len(over) <= 2:
        raise UnusableInput(
            f"--over given {len(over)} times: expected once or twice; sweep further parameters separately"
        )
    grids = {}
    for text in over:
        pattern, _, span = text.rpartition("=")
        span, log = span.removesuffix(":log"), span.endswith(":log")
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
        if log and start <= 0:
            raise UnusableInput(f"--over {text}: expected START above zero for equal ratios")
        grids[pattern] = (np.geomspace if log else np.linspace)(start, stop, count)
    return grids

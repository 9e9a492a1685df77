"""`trackwright sweep`."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import numpy as np
import polars as pl
import tyro

from experiments.cli.console import output_folder, progress
from experiments.cli.manifest import write_manifest
from experiments.cli.tuning_options import tracker_and_folders
from experiments.plots.objective import sweep_plot
from trackers.core.errors import UnusableInput
from trackers.recordings.atomic import atomic_write
from tuning.data import fit_data
from tuning.problem import is_stochastic
from tuning.sweeping import Sweep, grid_vectors, swept_parameters
from tuning.sweeping import sweep as run

FORM = "PATTERN=START:STOP:COUNT, as 'motion.sigma_a=0.01:1:100'"


def sweep(
    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path,
    over: tyro.conf.UseAppendAction[tuple[str, ...]],
    tracker: str | None = None,
    objective: str = "rmse",
    repeats: int = 10,
    noise: Path | None = None,
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
        repeats: runs of a particle filter per value, with different random numbers.
        noise: a tuned.toml for the other parameters.
        path: an output folder of `tune`, or its trace.csv, to draw as optimiser trace.
        free_height: estimate the height of tags whose height the rig gives.
        piece_rows: long recordings are cut into segments of about this many rows, as in `tune`.
    """
    started, clock = datetime.now(UTC), time.perf_counter()
    if repeats < 1 or piece_rows < 10:
        raise UnusableInput(f"--repeats {repeats} --piece-rows {piece_rows}: expected at least 1 and 10")
    grids = _grids(over)
    named, folders = tracker_and_folders(recordings, tracker, noise, free_height)
    group = named.only_batch(folders)
    model = group.tracker
    data = fit_data(group, objective, (), piece_rows)
    try:
        parameters = swept_parameters(model, list(grids))
        points = grid_vectors(parameters, list(grids.values()))
    except ValueError as error:
        raise UnusableInput(f"--over {' --over '.join(over)}: {_with_hint(str(error))}") from error
    traces = [] if path is None else _traces(path, [p.label for p in parameters])
    output_folder(out)
    runs = repeats if is_stochastic(model) else 1
    with progress("sweeping", len(points) * runs) as advance:
        swept = run(model, data.rows(), data.objective, grids, repeats, report=advance)
    seconds = time.perf_counter() - clock
    if not np.isfinite(swept.mean).any():
        raise UnusableInput("the objective is not finite at any grid point; run `trackwright check` on the recordings")
    _write(out / "sweep.csv", swept, objective)
    unit = "rad" if group.trajectories[0].station else "m"
    sweep_plot(out / "sweep.png", swept, f"RMSE ({unit})" if objective == "rmse" else objective, traces)
    config = {
        "tracker": named.name, "over": over, "objective": objective, "repeats": repeats, "noise": noise, "path": path,
        "free_height": free_height, "piece_rows": piece_rows,
    }  # fmt: skip
    extra = {
        "recordings": [str(p) for p in recordings],
        "best": swept.best,
        "least": float(swept.mean[swept.best_index]),
        "filter_runs": swept.filter_runs,
        "seconds": seconds,
    }
    write_manifest(out, sys.argv, config, started, extra=extra)
    print(_summary(swept, objective, unit if objective == "rmse" else "", seconds))
    print(f"wrote {out / 'sweep.csv'}, sweep.png and manifest.json")
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


def _with_hint(problem: str) -> str:
    return f"{problem}; start the grid at a small positive value" if "is positive" in problem else problem


def _write(path: Path, swept: Sweep, objective: str) -> None:
    """One row per grid point: swept values, mean objective, its standard deviation, and all repeats if several."""
    mesh = np.meshgrid(*swept.grids, indexing="ij")
    columns = {p.label: m.ravel() for p, m in zip(swept.parameters, mesh, strict=True)}
    columns[objective] = swept.mean.ravel()
    if len(swept.values) > 1:
        columns["spread"] = swept.spread.ravel()
        columns |= {f"repeat_{k + 1}": values.ravel() for k, values in enumerate(swept.values)}
    atomic_write(path, pl.DataFrame(columns).fill_nan(None).write_csv)


def _traces(path: Path, labels: list[str]) -> list[np.ndarray]:
    """The optimiser traces of a fit in the swept parameters, one per start, the best first; raises UnusableInput."""
    file = path / "trace.csv" if path.is_dir() else path
    try:
        table = pl.read_csv(file)
    except (OSError, pl.exceptions.PolarsError) as error:
        raise UnusableInput(
            f"--path {path}: cannot be read; expected an output folder of `tune`, or its trace.csv"
        ) from error
    lacking = [label for label in labels if label not in table.columns]
    if lacking:
        raise UnusableInput(
            f"--path {file}: has no column {', '.join(lacking)}; its columns: {', '.join(table.columns)}; sweep "
            "the tuned parameters by the same names"
        )
    parts = table.partition_by("start", maintain_order=True) if "start" in table.columns else [table]
    return [part.select(pl.col(labels).cast(pl.Float64)).to_numpy() for part in parts]


def _summary(swept: Sweep, objective: str, unit: str, seconds: float) -> str:
    at, repeats = swept.best_index, len(swept.values)
    lines = []
    for parameter, grid, k in zip(swept.parameters, swept.grids, at, strict=True):
        edge = len(grid) > 2 and k in (0, len(grid) - 1)
        end = "; at the end of the grid: widen it" if edge else ""
        shown = "" if parameter.example.unit == "1" else f" {parameter.example.unit}"
        lines.append(f"best {parameter.label} = {grid[k]:.6g}{shown}{end}")
    spread = f" ± {swept.spread[at]:.2g} over {repeats} repeats" if repeats > 1 else ""
    lines.append(f"{objective} = {swept.mean[at]:.6g}{' ' if unit else ''}{unit}{spread}")
    undefined = int(np.sum(~np.isfinite(swept.mean)))
    if undefined:
        lines.append(f"undefined: {undefined} of {swept.mean.size} grid points, where a trajectory is not finite")
    lines.append(f"{swept.filter_runs} trajectories filtered in {seconds:.1f} s")
    return "\n".join(lines)

"""What `trackwright sweep` does with recordings that were read: the objective on the grid, its file and its figure."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from trackwright.experiments.cli.console import output_folder
from trackwright.experiments.cli.options import SweepOptions
from trackwright.experiments.cli.runtime import write_manifest
from trackwright.experiments.cli.tuning_job import tracker_for_folders
from trackwright.experiments.pages.charts.tuning import sweep_plot
from trackwright.experiments.text.terminal import Begin
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.tuning.data import fit_data
from trackwright.tuning.problem import is_stochastic
from trackwright.tuning.sweeping import Sweep, grid_vectors, sweep, swept_parameters


def sweep_folders(
    folders: Sequence[RecordingFolder], recordings: Sequence[Path], options: SweepOptions, started: datetime,
    clock: float, begin: Begin,
) -> dict[str, Any]:  # fmt: skip
    """Evaluates the objective on the grid, writes all files and prints the best point; returns it and the counts."""
    objective, grids, out = options.objective, options.grids, options.out
    named = tracker_for_folders(folders, options)
    group = named.only_batch(folders)
    model = group.tracker
    data = fit_data(group, objective, (), dimensions=options.dimensions, weigh=options.weigh)
    try:
        parameters = swept_parameters(model, list(grids))
        points = grid_vectors(parameters, list(grids.values()))
    except ValueError as error:
        hint = "; start the grid at a small positive value" if "is positive" in str(error) else ""
        raise UnusableInput(f"--over {' --over '.join(options.over)}: {error}{hint}") from error
    output_folder(out)
    runs = options.repeats if is_stochastic(model) else 1
    advance = begin("grid point", len(points) * runs)
    swept = sweep(model, data.rows(), data.objective, grids, options.repeats, report=advance, weights=data.weights())
    begin("figure")
    seconds = time.perf_counter() - clock
    if not np.isfinite(swept.mean).any():
        raise UnusableInput("the objective is not finite at any grid point; run `trackwright check` on the recordings")
    _write(out / "sweep.csv", swept, objective)
    unit = "rad" if group.trajectories[0].station else "m"
    drawn = out / f"sweep.{options.figures}"
    sweep_plot(drawn, swept, f"RMSE ({unit})" if objective == "rmse" else objective)
    least = float(swept.mean[swept.best_index])
    result = {"best": swept.best, "least": least, "filter_runs": swept.filter_runs, "seconds": seconds}
    extra = {"recordings": [str(p) for p in recordings]} | result
    write_manifest(out, sys.argv, options.config() | {"tracker": named.name}, started, extra=extra)
    print(_summary(swept, objective, unit if objective == "rmse" else "", seconds))
    print(f"wrote {out / 'sweep.csv'}, {drawn.name} and manifest.json")
    return result


def _write(path: Path, swept: Sweep, objective: str) -> None:
    """One row per grid point: swept values, mean objective, its standard deviation, and all repeats if several."""
    mesh = np.meshgrid(*swept.grids, indexing="ij")
    columns = {p.label: m.ravel() for p, m in zip(swept.parameters, mesh, strict=True)}
    columns[objective] = swept.mean.ravel()
    if len(swept.values) > 1:
        columns["spread"] = swept.spread.ravel()
        columns |= {f"repeat_{k + 1}": values.ravel() for k, values in enumerate(swept.values)}
    atomic_write(path, pl.DataFrame(columns).fill_nan(None).write_csv)


def _summary(swept: Sweep, objective: str, unit: str, seconds: float) -> str:
    at, repeats = swept.best_index, len(swept.values)
    lines = []
    for parameter, grid, k in zip(swept.parameters, swept.grids, at, strict=True):
        end = "; at the end of the grid: widen it" if len(grid) > 2 and k in (0, len(grid) - 1) else ""
        shown = "" if parameter.example.unit == "1" else f" {parameter.example.unit}"
        lines.append(f"best {parameter.label} = {grid[k]:.6g}{shown}{end}")
    spread = f" ± {swept.spread[at]:.2g} over {repeats} repeats" if repeats > 1 else ""
    lines.append(f"{objective} = {swept.mean[at]:.6g}{' ' if unit else ''}{unit}{spread}")
    undefined = int(np.sum(~np.isfinite(swept.mean)))
    if undefined:
        lines.append(f"undefined: {undefined} of {swept.mean.size} grid points, where a trajectory is not finite")
    lines.append(f"{swept.filter_runs} trajectories filtered in {seconds:.1f} s")
    return "\n".join(lines)

"""`trackwright tune`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import polars as pl
import tyro

from experiments.catalogue import fitting, groups
from experiments.entry import Group
from experiments.errors import UnusableInput
from experiments.filter_figures import tuning_trace
from experiments.lanes import Lane, pieces
from experiments.manifest import write_manifest
from experiments.screen import notice, output_folder, progress, read_all
from experiments.tracks import batches
from experiments.tuned_file import read_tuned, with_noise, write_tuned
from experiments.writing import atomic_write
from trackers.core.particles import ParticleFilter
from trackers.core.tracker import AbstractTracker
from tuning import FitResult, NegativeLogLikelihood, RootMeanSquareError, fit
from tuning.objectives import AbstractObjective
from tuning.parameters import chosen

EVERYTHING = "*.sigma_*"


def tune(
    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path,
    tracker: str | None = None,
    objective: Literal["nll", "rmse"] = "nll",
    tune: tuple[str, ...] = (EVERYTHING,),
    start: Path | None = None,
    free_height: bool = False,
    steps: int = 60,
    piece_rows: int = 8000,
) -> int:
    """Fit noise levels (and other tunables) to recordings by gradient: writes tuned.toml, trace.csv and tuning.png.

    Args:
        recordings: recording folders to fit to, all at once.
        out: the folder to write to.
        tracker: as in `track`; default: what fits the tables.
        objective: nll, the negative log-likelihood (needs no truth), or rmse, the position error (needs truth).
        tune: shell patterns of tunables, as 'motion.*' 'sensors.*.sigma_p'; 'tied:PATTERN' keeps all that match equal.
        start: a tuned.toml to start from.
        free_height: estimate the height of tags whose height the rig gives.
        steps: gradient steps.
        piece_rows: long recordings are cut into pieces of about this many rows, which are fitted side by side.
    """
    started = datetime.now(UTC)
    if steps < 1 or piece_rows < 10:
        raise UnusableInput(f"--steps {steps} --piece-rows {piece_rows}: expected at least 1 and 10")
    folders = read_all(recordings)
    name = tracker or fitting(folders[0])
    if tracker is None:
        notice(f"tracker: {name}; choose another with --tracker")
    found = groups(folders, name, free_height)
    if len(found) > 1:
        raise UnusableInput(
            f"the recordings need {len(found)} different '{name}' trackers (other geometry, or heights known for some "
            "tags only); expected one; tune them apart, or give --free-height"
        )
    model, lanes, goal = _problem(found[0], objective, tune, start, piece_rows)
    output_folder(out)
    result = _fitted(model, lanes, goal, tune, steps)
    write_tuned(out / "tuned.toml", name, objective, result)
    unit = "rad" if found[0].lanes[0].station else "m"
    _write_trace(out, result, objective, unit)
    config = {
        "tracker": name,
        "objective": objective,
        "tune": tune,
        "start": start,
        "free_height": free_height,
        "steps": steps,
        "piece_rows": piece_rows,
    }
    write_manifest(out, sys.argv, config, started, extra={"recordings": [str(p) for p in recordings]})
    print(_table(result, objective))
    tuned = out / "tuned.toml"
    print(f"wrote {tuned}, trace.csv, tuning.png and manifest.json; use it: trackwright track … --noise {tuned}")
    return 0


def _problem(
    group: Group, objective: str, patterns: Sequence[str], start: Path | None, piece_rows: int
) -> tuple[AbstractTracker, list[Lane], AbstractObjective]:
    """What is fitted, to which pieces of the recordings, and for the least of what; raises UnusableInput."""
    tracker = group.tracker if start is None else with_noise(group.tracker, read_tuned(start), start)
    if isinstance(getattr(tracker, "filter", None), ParticleFilter):
        raise UnusableInput(
            "tune: a derivative through the resampling of particles is wrong; expected a tracker without them; use "
            "--tracker line-grid, whose model is the same, and give the result to `track --tracker line-pf --noise`"
        )
    try:
        chosen(tracker, patterns)
    except ValueError as error:
        raise UnusableInput(f"--tune {' '.join(patterns)}: {error}") from error
    lanes = [piece for lane in group.lanes for piece in pieces(lane, piece_rows)]
    if objective == "nll":
        return tracker, lanes, NegativeLogLikelihood()
    if group.planar and lanes[0].station:
        raise UnusableInput(
            "--objective rmse: azimuth and elevation of a tag in a flat array's own plane are singular; expected a tag "
            "above or below it; use --objective nll"
        )
    quantity = next(iter(lanes[0].recording.truth))
    lanes = [lane for lane in lanes if lane.recording.truth[quantity][1].any()]
    if not lanes:
        raise UnusableInput("--objective rmse needs truth, and these recordings have none; use --objective nll")
    return tracker, lanes, RootMeanSquareError(quantity, 2 if quantity == "direction" or group.planar else 3)


def _fitted(
    tracker: AbstractTracker, lanes: list[Lane], goal: AbstractObjective, patterns: Sequence[str], steps: int
) -> FitResult:
    with progress("tuning", steps + 1) as advance:
        try:
            result = fit(
                tracker,
                [batch for _, batch in batches(lanes)],
                goal,
                patterns,
                steps=steps,
                report=lambda number, step: advance(1),
            )
        except FloatingPointError as error:
            raise UnusableInput(f"{error}; ask `trackwright check` about the recordings") from error
    if result.left_out:
        notice(
            f"notice: {result.left_out} of {len(lanes)} pieces had no say: their figures were not finite, or depend on "
            "the tunables without measure"
        )
    return result


def _write_trace(out: Path, result: FitResult, objective: str, unit: str) -> None:
    trace = result.trace
    columns: dict[str, list[float]] = {
        objective: [s.value for s in trace],
        "gradient_norm": [s.gradient_norm for s in trace],
    }
    units: dict[str, str] = {}
    drawn: dict[str, np.ndarray] = {}
    for parameter in result.parameters:
        values = np.stack([np.asarray(s.values[parameter.label]) for s in trace])
        parts = values.reshape(len(trace), -1)
        for k in range(parts.shape[1]):
            label = parameter.label + (f".{k}" if values.ndim > 1 else "")
            columns[label] = parts[:, k].tolist()
            drawn[label], units[label] = parts[:, k], parameter.example.unit
    atomic_write(out / "trace.csv", pl.DataFrame(columns).write_csv)
    names = {"nll": "negative log-likelihood per number (nats)", "rmse": f"RMSE ({unit})"}
    tuning_trace(out / "tuning.png", np.array(columns[objective]), drawn, units, names[objective])


def _table(result: FitResult, objective: str) -> str:
    first = result.trace[0].values
    rows: list[tuple[str, ...]] = [("tunable", "before", "after", "standard error", "unit")]
    for parameter in result.parameters:
        name = parameter.label
        triple = (first[name], result.values[name], result.standard_errors[name])
        for k, numbers in enumerate(zip(*(np.ravel(x) for x in triple), strict=True)):
            label = name if np.ndim(result.values[name]) == 0 else f"{name}.{k}"
            shown = ["-" if np.isnan(x) else f"{x:.4g}" for x in numbers]
            rows.append((label, *shown, parameter.example.unit))
    widths = [max(len(r[k]) for r in rows) for k in range(5)]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    return "\n".join([*lines, f"{objective}: {result.start_value:.5g} -> {result.value:.5g}"])

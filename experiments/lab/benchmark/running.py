"""Runs estimators on data sets, and writes what they estimate as others submit theirs: ESTIMATOR/RECORDING.parquet."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from trackwright.experiments.lab.benchmark.declaration import ESTIMATORS, LEVELS, Estimator
from trackwright.experiments.lab.benchmark.motion import Levels
from trackwright.experiments.lab.benchmark.motion import Path as Estimated
from trackwright.experiments.lab.benchmark.problems import NotRead, Problem
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.folder import RecordingFolder

CPU = "cpu_us"
"""The column with the processor time of a reading, µs, the same in all rows of a file."""

FAILED = ".failed"
"""Suffix of the file with the reason in one line where an estimator has none."""


def run(estimator: Estimator, folder: RecordingFolder, given: Sequence[Problem]) -> pl.DataFrame:
    """The estimates of all tags, whose readings are `given`, with the columns of `track`, and `CPU`.

    Raises NotRead where the estimator does not read such recordings, and what its library raises.
    """
    module, _, name = estimator.run.partition(":")
    function = getattr(import_module(f"trackwright.experiments.lab.benchmark.adapters.{module}"), name)
    if estimator.whole:
        table, seconds = _timed(partial(function, folder), estimator.compiled)
        rows = sum(len(problem.times) for problem in given) or len(table)
        return _completed(table, folder, seconds / rows)
    if not given:
        raise NotRead(f"{folder.name}: other readings than ranges, their differences, bearings and fixes")
    tables, seconds = [], 0.0
    for problem in given:
        path, took = _timed(partial(function, problem, levels_of(estimator, problem)), estimator.compiled)
        seconds += took
        tables.append(_table(problem, path))
    return _completed(pl.concat(tables), folder, seconds / sum(len(problem.times) for problem in given))


def levels_of(estimator: Estimator, problem: Problem) -> Levels | None:
    """The noise levels of an estimator for these readings; None of one that has its own."""
    return LEVELS[estimator.levels][problem.kind] if estimator.levels else None


def write(root: Path, name: str, folder: RecordingFolder, given: Sequence[Problem]) -> str | None:
    """Runs an estimator and writes its estimates, or the reason why there are none, which is returned."""
    place, estimator = root / name, ESTIMATORS[name]
    place.mkdir(parents=True, exist_ok=True)
    file, failed = place / f"{folder.name}.parquet", place / f"{folder.name}{FAILED}"
    for path in (file, failed):
        path.unlink(missing_ok=True)
    try:
        table = run(estimator, folder, given)
    except ModuleNotFoundError:
        raise
    except NotRead:
        return None
    except Exception as error:  # A library may raise anything.
        reason = f"{type(error).__name__}: {str(error).strip().splitlines()[0] if str(error).strip() else ''}"
        atomic_write(failed, lambda path: path.write_text(f"{reason}\n", "utf-8"))
        return reason
    atomic_write(file, table.write_parquet)
    return None


def _timed(function: Callable[[], Any], compiled: bool) -> tuple[Any, float]:
    """What a function returns, and its processor time, s; `compiled`: of the second call of what it returns."""
    if compiled:
        function = function()
        function()
    gc.collect()
    began = time.process_time()
    result = function()
    return result, time.process_time() - began


def _table(problem: Problem, path: Estimated) -> pl.DataFrame:
    """The last estimate of each time."""
    last = np.flatnonzero(np.append(np.diff(problem.times) > 0, True))
    places, d = problem.places(path.positions)[last], problem.dimensions
    columns: dict[str, Any] = {"t_s": problem.times[last], "tag": problem.tag}
    columns |= {f"{axis}_m": places[:, k] for k, axis in enumerate("xyz")}
    if path.covariances is not None:
        P = path.covariances[last]
        std = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
        columns |= {f"std_{axis}_m": std[:, k] for k, axis in enumerate("xyz"[:d])}
        columns |= {f"cov_{'xyz'[i]}{'xyz'[j]}_m2": P[:, i, j] for i in range(d) for j in range(i + 1, d)}
    return pl.DataFrame(columns)


def _completed(table: pl.DataFrame, folder: RecordingFolder, seconds: float) -> pl.DataFrame:
    return table.with_columns(recording=pl.lit(folder.name), **{CPU: pl.lit(1e6 * seconds)})

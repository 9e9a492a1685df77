"""The tables of an archive, put together from its finished recordings: estimates, metrics, results, comparisons."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from trackwright.experiments.cli.archive_folders import RESULTS
from trackwright.experiments.cli.archive_part import RecordingStore
from trackwright.experiments.pages.reports.comparison import Contrast, adjusted, difference_table
from trackwright.experiments.text.evaluation_text import to_json
from trackwright.experiments.text.tables import Section
from trackwright.experiments.text.wording import Unit, fixed, length_unit
from trackwright.trackers.core.errors import UnusableInput, has_control, one_line
from trackwright.trackers.core.wording import counted
from trackwright.trackers.evaluation.comparison import COMPARED, LEAST_PIECES, Difference, jackknifed
from trackwright.trackers.evaluation.evaluate import Evaluation
from trackwright.trackers.evaluation.metrics import added, metrics
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.tracks_table import EVALUATION, SOURCES

NAMES, TEXTS = ("recording", "path", "tracker", "tracks", "endings"), ("notices", "refused")
"""The columns of the table of results before and after the metrics."""

Refusals = dict[Path, list[str]]  # a line for each refusal, by the path of the recording
SHOWN = tuple(name for name in COMPARED if "3d" not in name)  # the metrics that are compared, errors first


@dataclass
class Run:
    """The recordings of one tracker and their tracks, with their metrics; `endings`: how many tracks ended how.
    `paths`, `folders`: of the recordings and of their tables, by name."""

    tracker: str
    short: str
    bearing: bool
    sums: list[dict[str, Any]] = field(default_factory=list)
    recordings: list[dict[str, Any]] = field(default_factory=list)
    tracks: list[dict[str, Any]] = field(default_factory=list)
    paths: dict[str, Path] = field(default_factory=dict)
    folders: dict[str, Path] = field(default_factory=dict)
    endings: Counter[str] = field(default_factory=Counter)

    def add(self, path: Path, folder: Path, summary: Mapping[str, Any]) -> None:
        """Adds a recording at `path`, with its outcome and the folder of its tables."""
        name = summary["recording"]
        self.sums.append(summary["sums"])
        self.paths[name], self.folders[name] = path, folder
        self.recordings.append(summary["metrics"])
        self.tracks += summary["tracks"]
        self.endings.update(summary["endings"])

    def write(self, out: Path, errors: str) -> Evaluation:
        """Writes the metrics into the folder `out` and returns them; `errors`: the name of the tables of errors."""
        whole = added(pl.DataFrame(self.sums, infer_schema_length=None), self._rows(errors))
        overall = metrics(whole).row(0, named=True)
        evaluation = Evaluation(self.bearing, overall, by_name(self.recordings), by_name(self.tracks))
        atomic_write(out / EVALUATION, lambda path: path.write_text(to_json(evaluation), encoding="utf-8"))
        return evaluation

    def write_sources(self, out: Path) -> None:
        """Writes the paths of the recordings into the folder `out`."""
        text = "".join(f"{self.paths[name].resolve()}\n" for name in sorted(self.paths))
        atomic_write(out / SOURCES, lambda path: path.write_text(text, encoding="utf-8"))

    def write_table(self, out: Path, name: str) -> int:
        """Writes the tables `name` of all recordings as one, without holding them in memory; returns its rows."""
        path = atomic_write(out / name, partial(self._rows(name).sink_parquet, compression_level=1))
        return int(pl.scan_parquet(path).select(pl.len()).collect().item())

    def _rows(self, name: str) -> pl.LazyFrame:
        """The tables `name` of all recordings as one, which is not in memory."""
        files = [self.folders[recording] / name for recording in sorted(self.folders)]
        schema: dict[str, Any] = {}
        for file in files:
            schema |= pl.read_parquet_schema(file)
        return pl.scan_parquet(files, schema=pl.Schema(schema), missing_columns="insert")


def by_name(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The rows sorted by their names; a value that a row lacks is None."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    keys = [name for name in ("recording", "tag", "station") if name in names]
    return sorted(({name: row.get(name) for name in names} for row in rows), key=lambda row: [row[k] for k in keys])


def gathered(
    store: RecordingStore, paths: Sequence[Path], done: Container[Path], refused: Refusals
) -> tuple[list[Run], list[dict[str, Any]], int]:
    """The runs by tracker, the rows of the table of results, and how many recordings have notices."""
    runs: dict[str, Run] = {}
    rows: list[dict[str, Any]] = []
    noticed = 0
    for path in paths:
        whole = str(path.resolve())
        # Never tracked: no command looks for it by this name.
        whole = one_line(whole) if has_control(whole) else whole
        kept = store.read(store.folder(path)) if path in done else {"outcomes": [], "notices": []}
        for summary in kept["outcomes"]:
            name, short = summary["recording"], summary["short"]
            run = runs.setdefault(short, Run(summary["tracker"], short, summary["bearing"]))
            run.add(path, store.folder(path) / short, summary)
            endings = "; ".join(f"{words} {n}" for words, n in summary["endings"].items())
            metrics = {key: value for key, value in summary["metrics"].items() if key != "recording"}
            rows.append(
                {"recording": name, "path": whole, "tracker": short, "tracks": sum(summary["endings"].values())}
                | {"endings": endings, **metrics, "notices": "; ".join(kept["notices"]), "refused": None}
            )
        noticed += bool(kept["notices"])
        rows += [{"path": whole, "refused": line} for line in refused.get(path, ())]
    return list(runs.values()), rows, noticed


def write_results(out: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes the table of results, names first and texts last."""
    table = pl.DataFrame(rows, infer_schema_length=None)
    metrics = [name for name in table.columns if name not in (*NAMES, *TEXTS)]
    atomic_write(out / RESULTS, table.select(*NAMES, *metrics, *TEXTS).write_csv)


def read_results(out: Path) -> Refusals:
    """The recordings in the table of results, with the lines of those that were refused; raises UnusableInput."""
    path = out / RESULTS
    columns = {"path": pl.String, "refused": pl.String}
    try:
        rows = pl.read_csv(path, columns=[*columns], schema_overrides=columns)
    except (OSError, pl.exceptions.PolarsError) as error:
        fix = "expected the table that `track` writes; run `track` again"
        raise UnusableInput(f"{path}: cannot be read; {fix}") from error
    refusals: Refusals = {}
    for recording, line in rows.drop_nulls("path").iter_rows():
        refusals.setdefault(Path(recording), []).extend([] if line is None else [line])
    return refusals


def compared(runs: Sequence[Run]) -> list[Section]:
    """The trackers over the recordings that all have scored, of which each counts once; empty without one. The
    intervals are from `paired_differences`, with recordings for pieces."""
    if len(runs) < 2 or len({run.bearing for run in runs}) > 1:
        return []
    bearing, names = runs[0].bearing, [run.short for run in runs]
    metrics = [name for name in SHOWN if all(name in recording for run in runs for recording in run.recordings[:1])]
    values = {name: common for name in metrics if (common := _common(runs, name)).size}
    rmse = values.get(metrics[0])
    if rmse is None:
        return []
    medians = {name: np.median(values[name], axis=1) for name in metrics[:3]}
    unit = Unit("°", 180 / math.pi) if bearing else length_unit(float(medians[metrics[0]].min()))
    lowest = (rmse == rmse.min(axis=0)).mean(axis=1)
    rows = [
        [name, *(fixed(median[k] * unit.factor, 2) for median in medians.values()), f"{100 * lowest[k]:.0f} %"]
        for k, name in enumerate(names)
    ]
    what = "Angles between directions" if bearing else "Horizontal position errors"
    head = ("tracker", "RMSE", "median", "p95", "lowest RMSE in")
    note = f"Medians over the {counted(rmse.shape[1], 'recording')} that all trackers have."
    over = Section(f"{what} in {unit.name}", head, rows, 1, note)
    contrasts = [
        Contrast("", metric, name, difference := _difference(by_tracker[0], of_tracker), difference.p)
        for metric, by_tracker in values.items()
        for name, of_tracker in zip(names[1:], by_tracker[1:], strict=True)
    ]
    differences = difference_table(names[0], adjusted(contrasts), unit)
    note = differences.note if rmse.shape[1] >= LEAST_PIECES else f"No intervals with fewer than {LEAST_PIECES}."
    return [over, differences._replace(title=f"Means over recordings, and differences from {names[0]}", note=note)]


def _common(runs: Sequence[Run], metric: str) -> np.ndarray:
    """The metric (k, n) of the k trackers in the n recordings in which all have it."""
    frames = [
        pl.DataFrame(run.recordings, infer_schema_length=None).select(
            "recording", pl.col(metric).cast(pl.Float64).alias(str(k))
        )
        for k, run in enumerate(runs)
    ]
    joined = frames[0]
    for other in frames[1:]:
        joined = joined.join(other, on="recording")
    return joined.drop("recording").drop_nulls().to_numpy().T


def _difference(first: np.ndarray, second: np.ndarray) -> Difference:
    """The difference of the means of paired values (n,)."""
    differences = second - first
    without = (differences.sum() - differences) / max(len(differences) - 1, 1)
    return jackknifed(float(first.mean()), float(second.mean()), without)._replace(kind="recordings")

"""The tables of an archive, put together from its finished recordings: estimates, metrics and one table of results."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl

from trackwright.experiments.cli.archives.folders import RESULTS
from trackwright.experiments.cli.archives.rows import Rows
from trackwright.experiments.cli.archives.store import RecordingStore
from trackwright.experiments.text.evaluation_text import json_pieces
from trackwright.trackers.core.errors import UnusableInput, has_control, one_line
from trackwright.trackers.evaluation.evaluate import Evaluation
from trackwright.trackers.evaluation.metrics import metric_rows
from trackwright.trackers.evaluation.scores import Scores
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.tracks_table import EVALUATION, SOURCES

NAMES, TEXTS = ("recording", "path", "tracker", "tracks", "endings"), ("notices", "refused")
"""The columns of the table of results before and after the metrics."""

Refusals = dict[Path, list[str]]
"""A line for each refusal, by the path of the recording."""


@dataclass
class Run:
    """The recordings of one tracker and their tracks, with their metrics; `endings`: how many tracks ended how.

    `paths`, `folders`: of the recordings and of their tables, by name.
    """

    tracker: str
    short: str
    bearing: bool
    scores: Scores | None = None
    recordings: Rows = field(default_factory=Rows)
    tracks: Rows = field(default_factory=Rows)
    paths: dict[str, Path] = field(default_factory=dict)
    folders: dict[str, Path] = field(default_factory=dict)
    endings: Counter[str] = field(default_factory=Counter)

    def add(self, path: Path, folder: Path, summary: Mapping[str, Any]) -> None:
        """Adds a recording at `path`, with its outcome and the folder of its tables."""
        own, name = Scores.from_plain(summary["scores"]), summary["recording"]
        self.scores = own if self.scores is None else self.scores + own
        self.paths[name], self.folders[name] = path, folder
        self.recordings.append(summary["metrics"])
        for track in summary["tracks"]:
            self.tracks.append(track)
        self.endings.update(summary["endings"])

    @property
    def evaluation(self) -> Evaluation:
        """The metrics over all rows, of each recording and of each track, both by name."""
        assert self.scores is not None
        recordings, tracks = self.recordings.frame.sort("recording"), self.tracks.frame
        keys = [name for name in ("recording", "tag", "station") if name in tracks.columns]
        return Evaluation(self.bearing, metric_rows(self.scores)[0], Rows(recordings), Rows(tracks.sort(keys)))

    def write(self, out: Path) -> Evaluation:
        """Writes the metrics into the folder `out` and returns them."""
        evaluation = self.evaluation

        def write(path: Path) -> None:
            with path.open("w", encoding="utf-8") as file:
                file.writelines(json_pieces(evaluation))

        atomic_write(out / EVALUATION, write)
        return evaluation

    def write_sources(self, out: Path) -> None:
        """Writes the paths of the recordings into the folder `out`."""
        text = "".join(f"{self.paths[name].resolve()}\n" for name in sorted(self.paths))
        atomic_write(out / SOURCES, lambda path: path.write_text(text, encoding="utf-8"))

    def write_table(self, out: Path, name: str) -> int:
        """Writes the tables `name` of all recordings as one, without holding them in memory; returns its rows."""
        files = [self.folders[recording] / name for recording in sorted(self.folders)]
        schema: dict[str, Any] = {}
        for file in files:
            schema |= pl.read_parquet_schema(file)
        rows = pl.scan_parquet(files, schema=pl.Schema(schema), missing_columns="insert")
        path = atomic_write(out / name, partial(rows.sink_parquet, compression_level=1))
        return int(pl.scan_parquet(path).select(pl.len()).collect().item())


class Gathered(NamedTuple):
    """The runs by tracker, the rows of the table of results, and how many recordings have notices."""

    runs: list[Run]
    rows: Rows
    noticed: int


def gathered(store: RecordingStore, paths: Sequence[Path], done: Container[Path], refused: Refusals) -> Gathered:
    """What is stored of the recordings at `paths`, in this order.

    A second recording of one name is refused, since its rows could not be told apart.
    """
    runs: dict[str, Run] = {}
    rows = Rows()
    owners: dict[str, Path] = {}
    noticed = 0
    for path in paths:
        whole = str(path.resolve())
        # Never tracked: no command looks for it by this name.
        whole = one_line(whole) if has_control(whole) else whole
        kept = store.kept(store.folder(path)) if path in done else {"outcomes": [], "notices": []}
        for summary in kept["outcomes"]:
            name, short = summary["recording"], summary["short"]
            if (owner := owners.setdefault(name, path)) != path:
                fix = "expected different names in rig.toml; rename one"
                refused[path] = [f"{path}: is named '{name}', as is {owner}; {fix}"]
                break
            run = runs.setdefault(short, Run(summary["tracker"], short, summary["bearing"]))
            run.add(path, store.folder(path) / short, summary)
            endings = "; ".join(f"{words} {n}" for words, n in summary["endings"].items())
            metrics = {key: value for key, value in summary["metrics"].items() if key != "recording"}
            rows.append(
                {"recording": name, "path": whole, "tracker": short, "tracks": sum(summary["endings"].values())}
                | {"endings": endings, **metrics, "notices": "; ".join(kept["notices"]), "refused": None}
            )
        noticed += bool(kept["notices"])
        for line in refused.get(path, ()):
            rows.append({"path": whole, "refused": line})
    return Gathered(list(runs.values()), rows, noticed)


def write_results(out: Path, rows: Rows) -> None:
    """Writes the table of results, names first and texts last."""
    table = rows.frame
    metrics = [name for name in table.columns if name not in (*NAMES, *TEXTS)]
    atomic_write(out / RESULTS, table.select(*NAMES, *metrics, *TEXTS).write_csv)


def read_results(out: Path) -> Refusals:
    """The recordings in the table of results, with the lines of those that were refused.

    Raises UnusableInput for a file that `write_results` did not write.
    """
    path = out / RESULTS
    columns = {"path": pl.String, "refused": pl.String}
    try:
        rows = pl.read_csv(path, columns=[*columns], schema_overrides=columns)
    except (OSError, pl.exceptions.PolarsError) as error:
        fix = "expected the table that `track` writes; run `track` again"
        raise UnusableInput(f"{path}: cannot be read; {fix}") from error
    found: Refusals = {}
    for recording, line in rows.drop_nulls("path").iter_rows():
        found.setdefault(Path(recording), []).extend([] if line is None else [line])
    return found

"""`track` on an archive: recordings one by one with one tracker, finished ones kept, one table of results.

A finished recording is a run folder, and a file in it, written last, that says what it depends on: options, tracker,
versions, and the content of the recording.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import polars as pl

import trackwright as tw
from trackwright.experiments.cli import tracking as runs
from trackwright.experiments.cli.console import LEFT_OUT, chosen_tracker, keep_programs, output_folder, ready
from trackwright.experiments.cli.options import TrackOptions, settings
from trackwright.experiments.jobs.executors import Threads, cluster_executor, environment
from trackwright.experiments.jobs.store import Store
from trackwright.experiments.jobs.store import run as run_parts
from trackwright.experiments.text.tables import archive_text, terminal_width, to_json
from trackwright.experiments.text.terminal import Begin, notice
from trackwright.trackers.catalogue import fitting, run_file_of, spec_of
from trackwright.trackers.core.errors import counted, one_line
from trackwright.trackers.core.on_demand import split_name
from trackwright.trackers.recordings.files import Content, atomic_write, config_hash, json_text, write_whole
from trackwright.trackers.recordings.folder import content_of
from trackwright.trackers.recordings.rig_file import RIG_FILE, read_rig
from trackwright.trackers.recordings.tracks_table import EVALUATION, RECORDINGS, RESULTS, SOURCES, TRACKS, sources_text

FINISHED, ROWS = "tracked.json", "rows.parquet"
"""The file written last for a recording, and its scored rows, which the metrics of all are taken from."""


@dataclass(frozen=True)
class Found:
    """What was found in one recording: how many tracks ended how, notices; and the files to keep."""

    endings: dict[str, int]
    notices: list[str]
    files: dict[str, Content] = field(default_factory=dict)


Result = Found | str  # of a recording that could not be used, the reason, in a line that names it


@dataclass(frozen=True)
class Archive(Store[Path, Result]):
    """How recordings are tracked by the tracker `name`, wherever that is, and the finished ones in the output folder.
    `names`: of the recordings."""

    options: TrackOptions
    name: str
    names: Mapping[Path, str]

    def part(self, path: Path) -> Found:
        """What is found in the recording at `path`; raises UnusableInput where it has errors."""
        run_file_of(self.name)  # a user's file may add the kind of the recording's tables
        calibration, recording = self.options.used.read_calibration(), tw.read(path)
        folder, lines = ready(recording, self.options.used, self.options.force, calibration)
        one = replace(folder, name=self.names[path])
        run, more = runs.tracked(self.name, [one], self.options, lambda *_: lambda *_: None)
        return Found(run.tracks.summaries, [*map(one_line, (*lines, *more))], runs.files_of(run) | {ROWS: run.rows})

    @cached_property
    def _settings(self) -> str:
        """All that the outcome of a recording depends on, beside its content."""
        options, numbers = self.options, replace(self.options.numbers, tracker=None, noise=None)
        files = options.numbers.noise, options.used.calibration, split_name(self.name)[0]
        texts = [Path(file).read_text("utf-8") for file in files if file]
        plain = settings(options, numbers=numbers, cluster=None, figures="page")
        return repr((plain, split_name(self.name)[1], texts, environment()))

    def folder(self, path: Path) -> Path:
        """The folder of the recording at `path`: its name, and a digest of the path."""
        whole = path.resolve()
        digest = hashlib.sha256(os.fsencode(whole)).hexdigest()[:8]
        plain = re.sub(r"[^\w.-]", "_", whole.name, flags=re.ASCII)[:80]
        return self.options.out / RECORDINGS / f"{plain}-{digest}"

    def _digest(self, path: Path) -> str:
        return config_hash({"content": f"{content_of(path)} {self.names[path]}", "settings": self._settings})

    def read(self, item: Path) -> Found:
        """As `Store`."""
        kept = json.loads((self.folder(item) / FINISHED).read_bytes())
        if kept.pop("digest") != self._digest(item):
            raise LookupError("of other inputs")
        for table in (TRACKS, ROWS):
            pl.read_parquet_schema(self.folder(item) / table)
        return Found(**kept)

    def files(self, item: Path, result: Result) -> dict[Path, Content]:
        """As `Store`; a recording that could not be used is tried again by the next run."""
        if isinstance(result, str):
            return {}
        kept = asdict(replace(result, files={})) | {"digest": self._digest(item)}
        return {self.folder(item) / name: x for name, x in (result.files | {FINISHED: json_text(kept)}).items()}


def _names_apart(paths: Sequence[Path]) -> dict[Path, str]:
    """The names of the recordings; the paths of those that have none, or one that others have, too."""
    names = {path: str(path) for path in paths}
    for path in paths:
        with suppress(tw.UnusableInput):
            names[path] = read_rig(path / RIG_FILE)[0].name
    counts = Counter([*names.values(), *map(str, paths)])
    apart = {path: name if counts[name] == 1 else str(path) for path, name in names.items()}
    if renamed := [path for path in paths if names[path] != apart[path]]:
        count = counted(len(renamed), "recording")
        notice(f"notice: {count}, as {renamed[0]}, named by paths: others have their names")
    return apart


def _refusal(path: Path, error: Exception) -> str:
    """What stands for a recording that could not be used: a line that names it, so that the others go on."""
    if isinstance(error, tw.UnusableInput):
        return str(error) if one_line(path) in str(error) else f"{path}: {error}"
    return f"{path}: cannot be used ({type(error).__name__}: {one_line(error) or 'no message'})"


def _readable(paths: Sequence[Path]) -> tw.RecordingFolder:
    """The first recording that can be read and that a tracker fits; raises UnusableInput."""
    for path in paths:
        with suppress(tw.UnusableInput):
            folder = tw.read(path)
            fitting(folder)
            return folder
    raise tw.UnusableInput(f"{paths[0]} and {len(paths) - 1} more: no tracker fits any; see `trackwright check`")


def track_archive(paths: Sequence[Path], options: TrackOptions, begin: Begin) -> int:
    """Tracks the recordings that are not finished, and writes the tables of all; the exit code."""
    begin("preparing")
    keep_programs()
    numbers, found = options.numbers, dict[Path, Result]()
    name = chosen_tracker([] if numbers.named else [_readable(paths)], numbers)
    spec_of(name)
    options.used.read_calibration()
    archive, out = Archive(options, name, _names_apart(paths)), output_folder(options.out)
    advance = begin("tracking", len(paths))

    def each(path: Path, result: Result) -> None:
        found[path] = result
        advance(1)

    with cluster_executor(options.cluster) if options.cluster else Threads() as executor:
        run_parts(paths, archive.part, archive, executor, each, _refusal)
    refused = [(path, x) for path in paths if isinstance(x := found[path], str)]
    done = [(path, x) for path in paths if isinstance(x := found[path], Found)]
    if not done:
        raise tw.UnusableInput(f"{refused[0][1]} ({len(refused) - 1} more recordings: none could be tracked)")
    begin("tables")
    rows, tracks = (
        pl.concat([pl.read_parquet(archive.folder(path) / table) for path, _ in done], how="diagonal_relaxed")
        for table in (ROWS, TRACKS)
    )
    evaluation = tw.Evaluation.of(rows)
    files: dict[str, Content] = {EVALUATION: to_json(evaluation), TRACKS: tracks}
    for file, whole in (files | {SOURCES: sources_text(path for path, _ in done)}).items():
        write_whole(out / file, whole)
    atomic_write(out / RESULTS, _results(done, evaluation.recordings, refused).write_csv)
    print(f"{counted(len(done), 'recording')}, {runs.words_of(sum((Counter(x.endings) for _, x in done), Counter()))}")
    if evaluation.overall["n"]:
        print(archive_text(evaluation, terminal_width()), end="")
    runs.conclude(evaluation, name, len(rows), options, [RESULTS])
    notice(f"{len(refused)} of {counted(len(paths), 'recording')} not tracked; notices: see {out / RESULTS}")
    for _, line in refused:
        notice(f"not tracked: {line}")
    return LEFT_OUT if refused else 0


def _results(
    done: Sequence[tuple[Path, Found]], metrics: Sequence[Mapping[str, Any]], refused: Sequence[tuple[Path, str]]
) -> pl.DataFrame:
    """The table of results, a row for each recording in the order of paths."""
    rows: dict[Path, dict[str, Any]] = {path: {"refused": line, "notices": None} for path, line in refused}
    for (path, found), own in zip(done, metrics, strict=True):
        endings = "; ".join(f"{words} {n}" for words, n in found.endings.items())
        ends = {"tracks": sum(found.endings.values()), "endings": endings, "notices": "; ".join(found.notices)}
        rows[path] = {**own, **ends, "refused": None}
    lines = [{"path": one_line(path.resolve())} | rows[path] for path in sorted(rows)]
    table, last = pl.DataFrame(lines, infer_schema_length=None), ("notices", "refused")
    return table.select("recording", "path", pl.exclude("recording", "path", *last), *last)

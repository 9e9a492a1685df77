"""The runs that `evaluate` compares: studies, and tracks with their errors against truth."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import polars as pl

from trackwright.experiments.monte_carlo.declaration import short
from trackwright.experiments.text.expectations import Value
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.rows import is_scored, scored_rows
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording
from trackwright.trackers.recordings.input_file import file_bytes
from trackwright.trackers.recordings.tracks_table import EVALUATION, TRACKS, read_tracks, source_paths

RESULTS = "results.json"

T = TypeVar("T")


@dataclass(frozen=True)
class StudyRun:
    """A study: its metrics by subject (world, point and tracker) and name, with intervals."""

    name: str
    folder: Path
    metrics: dict[tuple[str, str], Value]


@dataclass(frozen=True)
class TrackRun:
    """Tracks of recordings. `bearing`: of bearings. `metrics`: of evaluation.json, by recording; overall under "".

    `recordings`: the tracked ones, by name. `rows`: the `scored_rows`, None where no recording with truth
    can be read.
    """

    name: str
    folder: Path
    bearing: bool
    metrics: dict[str, dict[str, Any]]
    recordings: Mapping[str, RecordingFolder]
    rows: pl.DataFrame | None


def read_runs(folders: Sequence[Path]) -> tuple[list[StudyRun] | list[TrackRun], list[str]]:
    """The runs in these folders, and notices; raises UnusableInput for one folder twice, and for runs of two kinds."""
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise UnusableInput("evaluate: a folder is given more than once; expected different runs; remove one")
    kinds = [_kind(folder) for folder in folders]
    other = next((k for k, kind in enumerate(kinds) if kind != kinds[0]), None)
    if other is not None:
        raise UnusableInput(
            f"{folders[0]} holds {kinds[0]}, {folders[other]} {kinds[other]}; expected runs of one kind: studies, or "
            "folders of `track`"
        )
    names = _names(folders)
    if kinds[0] == RESULTS:
        return [
            StudyRun(name, folder, _json(folder / RESULTS, lambda content: dict(_of_study(content))))
            for name, folder in zip(names, folders, strict=True)
        ], []
    return _track_runs(names, folders)


def _track_runs(names: Sequence[str], folders: Sequence[Path]) -> tuple[list[TrackRun], list[str]]:
    contents = [_json(folder / EVALUATION, _of_tracks) for folder in folders]
    if len({bearing for bearing, _ in contents}) > 1:
        raise UnusableInput(f"{', '.join(map(str, folders))}: tracks of positions and of bearings; expected one kind")
    notices, known = [], {}
    for folder in folders:
        for path in source_paths(folder):
            if path not in known:
                try:
                    known[path] = read_recording(path)
                except UnusableInput as problem:
                    notices.append(f"{problem}; no intervals and figures for it")
    by_name = {recording.name: recording for recording in known.values()}
    truths = {name: recording.tables["truth"] for name, recording in by_name.items() if "truth" in recording.tables}
    stations, runs = {name: recording.rig.stations for name, recording in by_name.items()}, []
    for name, folder, (bearing, metrics) in zip(names, folders, contents, strict=True):
        rows = None
        if truths and (folder / TRACKS).is_file():
            rows = scored_rows(read_tracks(folder), truths, stations)
            rows = rows if is_scored(rows).any() else None
        runs.append(TrackRun(name, folder, bearing, metrics, by_name, rows))
    return runs, notices


def _names(folders: Sequence[Path]) -> list[str]:
    """The last parts of the paths, as few as tell them apart."""
    parts = [folder.resolve().parts for folder in folders]
    names = ([os.sep.join(path[-length:]) for path in parts] for length in range(1, max(map(len, parts)) + 1))
    return next((found for found in names if len(set(found)) == len(found)), [*map(str, folders)])


def _kind(folder: Path) -> str:
    for name in (RESULTS, EVALUATION):
        if (folder / name).is_file():
            return name
    if (folder / TRACKS).is_file():
        raise UnusableInput(f"{folder}: no {EVALUATION}; write it with `trackwright evaluate {folder}`")
    raise UnusableInput(
        f"{folder}: no {RESULTS} and no {EVALUATION}; expected a folder of `trackwright study` or `trackwright track`"
    )


def _json(path: Path, use: Callable[[Any], T]) -> T:
    """What `use` makes of the JSON in a file; raises UnusableInput for content that no command writes."""
    try:
        return use(json.loads(file_bytes(path)))
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise UnusableInput(f"{path}: cannot be read as JSON of ours; run the study or `evaluate` again") from error


def _of_tracks(content: Any) -> tuple[bool, dict[str, dict[str, Any]]]:
    """Whether the tracks are of bearings, and the metrics by recording; those of all under ""."""
    metrics = {"": dict(content["overall"])} | {str(row["recording"]): dict(row) for row in content["recordings"]}
    for row in metrics.values():
        for name, value in row.items():
            if not (name == "recording" or value is None or isinstance(value, int | float)):
                raise TypeError(f"{name} is {value!r}, no number")
    return content.get("kind", "position") == "bearing", metrics


def _of_study(content: Mapping[str, Any]) -> Iterator[tuple[tuple[str, str], Value]]:
    for cell in content["cells"]:
        point = ", ".join(f"{short(k)} {v}" for k, v in cell["point"].items())
        subject = ", ".join(x for x in (cell["world"], point, cell["tracker"]) if x)
        for metric, value in cell["figures"].items():
            yield (subject, metric), Value(*(math.nan if value[k] is None else float(value[k]) for k in Value._fields))

"""What `trackwright track` writes: `tracks.parquet` and its key columns, the list of recordings, archives' results."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, has_control
from trackwright.trackers.recordings.files import file_bytes
from trackwright.trackers.recordings.folder import RecordingFolder, is_part, read_recording
from trackwright.trackers.recordings.rig_file import RIG_FILE
from trackwright.trackers.recordings.tables import read_parquet

TRACKS, EVALUATION, SOURCES = "tracks.parquet", "evaluation.json", "recordings.txt"  # estimates, metrics, paths

RECORDINGS, RESULTS = "recordings", "results.csv"  # of an archive: its parts, its table
HEADING = "heading_rad"  # the column with the heading of a body, from x towards y
NO_ESTIMATE = ("waiting", "non-finite")  # values of `status` of rows without an estimate


def read_tracks(folder: Path | str) -> pl.DataFrame:
    """The table of estimates in the output folder of `trackwright track`; raises UnusableInput if there is none."""
    path = Path(folder) / TRACKS
    wrong = "" if path.is_file() else "no such file"
    tracks = pl.DataFrame() if wrong else read_parquet(path)
    if not wrong:
        wrong = "no column x_m" if not {"x_m", "azimuth_rad"} & {*tracks.columns} else "no row" * tracks.is_empty()
    if wrong:
        raise UnusableInput(f"{path}: {wrong}; expected the table of `trackwright track`; give the folder it wrote")
    return tracks


def sources_text(paths: Iterable[Path | None]) -> str:
    """The content of `SOURCES` for recordings at these paths; None: made in memory."""
    return "".join(f"{path.resolve()}\n" for path in paths if path is not None)


def source_paths(folder: Path) -> list[Path]:
    """The recordings that `track` lists in its output folder; none where the list cannot be read."""
    try:
        lines = file_bytes(folder / SOURCES).decode("utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return []
    return [] if any(map(has_control, lines)) else [Path(line) for line in lines if line]


def require_sources(folder: Path) -> tuple[Path, ...]:
    """The recordings tracked into an output folder; raises UnusableInput if it does not list them."""
    paths, where, fix = source_paths(folder), folder / SOURCES, "give --truth RECORDING"
    if not paths:
        raise UnusableInput(f"{where}: names no recording; expected a folder written by `track`; {fix}")
    if moved := [path for path in paths if not path.exists()]:
        raise UnusableInput(f"{where}: {moved[0]} does not exist; expected the recordings there; {fix}")
    return tuple(paths)


def is_bearing(tracks: pl.DataFrame) -> bool:
    """Whether the estimates are bearings, not positions."""
    return "x_m" not in tracks.columns


def track_keys(tracks: pl.DataFrame) -> list[str]:
    """The columns that identify a track: recording and tag, for bearings also station."""
    return ["recording", "tag", "station"] if is_bearing(tracks) else ["recording", "tag"]


def read_archive(out: Path) -> tuple[list[RecordingFolder], list[str]]:
    """The truths of the recordings in the table of results, by their names there; a line for each without one."""
    path, columns = out / RESULTS, dict.fromkeys(("recording", "path"), pl.String)
    try:
        rows = pl.read_csv(path, columns=[*columns], schema_overrides=columns).drop_nulls().unique(maintain_order=True)
    except (OSError, pl.exceptions.PolarsError) as error:
        raise UnusableInput(f"{path}: cannot be read; expected the table of `track`; run `track` again") from error
    truths, refused = list[RecordingFolder](), list[str]()
    for name, source in rows.select("recording", "path").iter_rows():
        try:
            truth = replace(read_recording(Path(source)), name=name)
            if "truth" not in truth.tables:
                raise UnusableInput(f"{source}: no truth table, expected one to evaluate against")
            truths.append(truth)
        except UnusableInput as problem:
            refused.append(str(problem))
    return truths, refused


def require_output(path: Path) -> None:
    """Raises UnusableInput for a folder that takes no results: a recording, a file, or the root of the file system."""
    reasons = {
        "is the root of the file system": path.resolve() == Path(path.resolve().anchor),
        "has a control character or bytes that are no UTF-8": has_control(str(path)),
        "is a file": path.is_file(),
        "is a recording folder": (path / RIG_FILE).exists() and any(map(is_part, {*os.listdir(path)} - {RIG_FILE})),
    }
    for why in (why for why, true in reasons.items() if true):
        raise UnusableInput(f"--out {path}: {why}; expected a folder for results; choose another folder")


def require_new(out: Path, name: str, force: bool) -> None:
    """Raises UnusableInput for a file without the ending of `name`, or that exists and is not to be replaced."""
    ending = Path(name).suffix
    if out.suffix != ending or out.is_dir():
        raise UnusableInput(f"--out {out}: expected a file with the ending {ending}; give {name} in a folder")
    if out.exists() and not force:
        raise UnusableInput(f"--out {out}: exists; expected a new file; --force replaces it")
    require_output(out.parent)

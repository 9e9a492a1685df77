"""The table of estimates that `trackwright track` writes: `tracks.parquet`, its key columns and its kinds."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, has_control
from trackwright.trackers.recordings.input_file import file_bytes
from trackwright.trackers.recordings.tables import read_parquet

TRACKS, EVALUATION, SOURCES = "tracks.parquet", "evaluation.json", "recordings.txt"
"""Files in the output folder of `trackwright track`: estimates, error metrics, a path of a recording per line."""

HEADING = "heading_rad"
"""The column with the heading of a body, from x towards y."""

NO_ESTIMATE = ("waiting", "non-finite")
"""Values of `status` of rows without an estimate."""


def read_tracks(folder: Path | str) -> pl.DataFrame:
    """The table of estimates in the output folder of `trackwright track`; raises UnusableInput if there is none."""
    path = Path(folder) / TRACKS
    if not path.is_file():
        raise UnusableInput(
            f"{path}: no such file; expected a folder with {TRACKS}; give the folder that `trackwright track` wrote"
        )
    if not path.stat().st_size:
        raise UnusableInput(f"{path}: has 0 bytes; expected the table of `trackwright track`; run it again")
    tracks = read_parquet(path)
    if not {"x_m", "azimuth_rad"} & {*tracks.columns}:
        raise UnusableInput(f"{path}: no column x_m; expected the table of `trackwright track`; run it again")
    if tracks.is_empty():
        raise UnusableInput(
            f"{path}: the table is empty; expected one row per estimate; read the output of `trackwright track`"
        )
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

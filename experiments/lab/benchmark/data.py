"""The data sets by name: simulated worlds, and the recordings and flights that are found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import polars as pl

from trackwright.experiments.lab.benchmark.declaration import MOST_READINGS
from trackwright.experiments.lab.benchmark.readings import CHANNELS
from trackwright.experiments.lab.benchmark.worlds import WORLDS, simulated
from trackwright.experiments.lab.subprocesses import flights_folder, recordings_folder
from trackwright.trackers.core.errors import UnusableInput, near
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording


def names() -> tuple[str, ...]:
    """The names of all data sets: recordings in the order of their names, then worlds."""
    return (*sorted(_paths()), *WORLDS)


def folder_of(name: str) -> RecordingFolder:
    """A data set, as far as it is used; raises UnusableInput where there is none of this name."""
    if name in WORLDS:
        return simulated(name)
    paths = _paths()
    if name not in paths:
        raise UnusableInput(
            f"{name}: no such data set{near(name, names())}; expected one of {', '.join(names())}{hint()}"
        )
    return beginning_of(read_recording(paths[name]))


def hint() -> str:
    """What a refusal of a data set ends with: how recordings are found, where there are none; else empty."""
    return "" if _paths() else "; no recordings: name their folder in TRACKWRIGHT_RECORDINGS"


def _paths() -> dict[str, Path]:
    found = (folder for folder in (recordings_folder(), flights_folder()) if folder is not None)
    return {file.parent.name: file.parent for folder in found for file in folder.glob("*/rig.toml")}


def beginning_of(folder: RecordingFolder) -> RecordingFolder:
    """The recording up to the time at which its table of readings has `MOST_READINGS` rows, with all of its truth.

    Bearings, which trackers average, are not cut.
    """
    ends = [
        folder.tables[name]["t_s"].sort()[MOST_READINGS]
        for name in CHANNELS
        if name in folder.tables and name != "bearings" and len(folder.tables[name]) > MOST_READINGS
    ]
    if not ends:
        return folder
    tables = {
        name: table if name == "truth" else table.filter(pl.col("t_s") < min(ends))
        for name, table in folder.tables.items()
    }
    return replace(folder, tables=tables)

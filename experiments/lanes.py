"""From recording folders to the rows that trackers take: one lane per tag, or per tag and station for beams."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import polars as pl

from experiments.folder import Folder
from experiments.matching import Verdict, interpolated, numbers, truth_paths
from trackers.aoa.fusion import BEARINGS, bearing_inputs
from trackers.aoa.rays import recent_points
from trackers.core.recording import Readings, Recording
from trackers.core.rig import Station

PHASES = "phases"
Path = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Lane:
    """One trajectory to track: whose it is, and its rows. `station` is empty where all stations share the lane."""

    folder: Folder
    tag: str
    station: str
    recording: Recording


def bearing_lanes(folder: Folder, free_height: bool) -> Iterator[Lane]:
    """Each tag's bearings, one row per table row, with the geometry of the row's station as inputs."""
    stations = folder.rig.stations
    geometry = {name: bearing_inputs(s) for name, s in stations.items()}
    paths = _true_paths(folder)
    for tag, table in _by_tag(folder.tables["bearings"]):
        values, seen = _values(table, ["azimuth_rad", "elevation_rad"])
        # Without reported spreads zeros stand here, so that lanes with and without share a batch.
        spread = np.nan_to_num(np.stack([numbers(table, f"{a}_std_rad") for a in ("azimuth", "elevation")], axis=1))
        reported = np.stack([spread[:, 0] ** 2, np.zeros(len(spread)), spread[:, 1] ** 2], axis=1)
        where = np.stack([geometry[s] for s in table["station"].to_list()])
        times, height = table["t_s"].to_numpy(), None if free_height else known_height(folder, tag)
        nearby = recent_points(times, where[:, :3], where[:, 3:], values, np.asarray(seen.all(axis=1)), height)
        inputs = {"origin": where[:, :3], "axes": where[:, 3:], "nearby": nearby}
        readings = {BEARINGS: Readings(values, seen, reported)}
        yield _lane(folder, tag, "", times, readings, inputs, paths)


def phase_lanes(folder: Folder, free_height: bool) -> Iterator[Lane]:
    """Each tag's phases at all stations, by the stations' ids; a row per time."""
    stations = {name: s for name, s in folder.rig.stations.items() if s.antennas is not None}
    paths = _true_paths(folder)
    for tag, table in _by_tag(folder.tables["phases"]):
        times, place = _rows(table["t_s"].to_numpy(), table["station"].to_numpy())
        readings = {}
        for name, station in stations.items():
            here = (table["station"] == name).to_numpy()
            values, seen = _values(table.filter(here), _phase_columns(station))
            every, mask = np.zeros((len(times), values.shape[1])), np.zeros((len(times), values.shape[1]), bool)
            every[place[here]], mask[place[here]] = values, seen
            readings[name] = Readings(every, mask)
        yield _lane(folder, tag, "", times, readings, {}, paths)


def beam_lanes(folder: Folder, free_height: bool) -> Iterator[Lane]:
    """Each tag's phases at one station, for every pair of them, under the name `phases`."""
    paths = _true_paths(folder)
    for tag, table in _by_tag(folder.tables["phases"]):
        for (name,), part in table.group_by(["station"], maintain_order=True):
            values, seen = _values(part, _phase_columns(folder.rig.stations[str(name)]))
            readings = {PHASES: Readings(values, seen)}
            yield _lane(folder, tag, str(name), part["t_s"].to_numpy(), readings, {}, paths)


def pieces(lane: Lane, rows: int) -> list[Lane]:
    """The lane cut into parts of about `rows` rows, for fits: short parts run side by side, each started anew."""
    whole = lane.recording
    count = max(1, round(len(whole) / rows))
    ends = np.linspace(0, len(whole), count + 1).astype(int)
    return [Lane(lane.folder, lane.tag, lane.station, cut(whole, a, b)) for a, b in pairwise(ends)]


def cut(recording: Recording, start: int, stop: int) -> Recording:
    """The rows start … stop − 1 of a recording."""
    part = slice(start, stop)
    readings = {
        name: Readings(r.values[part], r.seen[part], None if r.reported is None else r.reported[part])
        for name, r in recording.readings.items()
    }
    inputs = {name: x[part] for name, x in recording.inputs.items()}
    truth = {name: (values[part], known[part]) for name, (values, known) in recording.truth.items()}
    return Recording(recording.times[part], readings, inputs, truth, recording.name)


def _lane(
    folder: Folder,
    tag: str,
    station: str,
    times: np.ndarray,
    readings: dict[str, Readings],
    inputs: dict[str, np.ndarray],
    paths: dict[str, Path],
) -> Lane:
    height = known_height(folder, tag)
    inputs = {**inputs, "height": np.full(len(times), 0.0 if height is None else height)}
    truth = _truth(folder, tag, station, times, paths)
    return Lane(folder, tag, station, Recording(times, readings, inputs, truth, f"{folder.name}, tag {tag}"))


def known_height(folder: Folder, tag: str) -> float | None:
    """The constant height of a tag, m, where the rig gives one."""
    known = folder.rig.tags.get(tag)
    return None if known is None else known.height


def _true_paths(folder: Folder) -> dict[str, Path]:
    return truth_paths(folder.tables["truth"], folder.name) if "truth" in folder.tables else {}


def _truth(folder: Folder, tag: str, station: str, times: np.ndarray, paths: dict[str, Path]) -> dict[str, Path]:
    """The true position at the rows' times, or for a station's lane the true direction; known nowhere without truth."""
    place, known = np.zeros((len(times), 3)), np.zeros(len(times), bool)
    if tag in paths:
        place, verdict = interpolated(times, *paths[tag])
        known = (verdict == Verdict.COUNTS) & np.isfinite(place).all(axis=1)
        place = np.where(known[:, None], place, 0.0)
    if station:
        return {"direction": (folder.rig.stations[station].angles(place), known)}
    return {"position": (place, known)}


def _by_tag(table: pl.DataFrame) -> Iterator[tuple[str, pl.DataFrame]]:
    for (tag,), part in table.group_by(["tag"], maintain_order=True):
        yield str(tag), part


def _values(table: pl.DataFrame, columns: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """The columns (n, m) with zero where a value is missing, and where there is one."""
    values = table.select(pl.col(columns).cast(pl.Float64).fill_null(np.nan)).to_numpy()
    seen = np.isfinite(values)
    return np.where(seen, values, 0.0), seen


def _phase_columns(station: Station) -> list[str]:
    assert station.antennas is not None
    return [f"phase_{k + 1}_rad" for k in range(len(station.antennas))]


def _rows(times: np.ndarray, stations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One row per time, and per repeat of a station at one time; the rows' times and each entry's row."""
    order = np.lexsort((np.arange(len(times)), stations, times))
    repeat = np.zeros(len(times), int)
    same = (np.diff(times[order]) == 0) & (stations[order][1:] == stations[order][:-1])
    for k in np.flatnonzero(same):
        repeat[order[k + 1]] = repeat[order[k]] + 1
    keys, place = np.unique(np.stack([times, repeat], axis=1), axis=0, return_inverse=True)
    return keys[:, 0], place.ravel()

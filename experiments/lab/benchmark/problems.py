"""What estimators are given: recordings that are found, and five worlds, of which the plain filter is the optimum."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from trackwright.experiments.lab.benchmark.peers.model import CHANNELS, Problem, diffusion, transition
from trackwright.experiments.lab.subprocesses import flights_folder, recordings_folder
from trackwright.trackers.catalogue import build, fitting
from trackwright.trackers.core.model.rig import Rig, Station, Tag
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording
from trackwright.trackers.recordings.named_tracker import NamedTracker
from trackwright.trackers.recordings.rig_file import mounted

MOST_READINGS = 6_000
"""Readings of a recording that every estimator is given, from its beginning; bearings, which are averaged, whole."""
INPUTS = {"ranges": ("anchors",), "tdoa": ("pairs",), "bearings": ("origin", "axes"), "fixes": ()}
"""The inputs of a row that are the geometry of its reading."""
WORLDS = {
    "world-ranges-2d": ("ranges", 2, 0.02, 0.1), "world-ranges-3d": ("ranges", 3, 0.02, 0.1),
    "world-tdoa": ("tdoa", 3, 0.02, 0.1), "world-bearings": ("bearings", 2, 0.02, 0.1),
    "world-fixes": ("fixes", 3, 0.02, 0.2),
}  # fmt: skip
"""Kind, coordinates, m/s² per √Hz, and m or rad."""
ROWS, RATE_HZ, TAGS, MIDDLE, PRIOR = 600, 20.0, 3, np.array([5.0, 5.0, 1.2]), (0.3, 0.05)
"""PRIOR: standard deviations of the place about the middle and of the velocity at the start, m and m/s."""
CORNERS = np.array([[0, 0, 0.2], [10, 0, 2.8], [10, 10, 0.2], [0, 10, 2.8],
                    [0, 5, 2.8], [10, 5, 0.2], [5, 0, 2.8], [5, 10, 0.2]], float)  # fmt: skip


def places() -> dict[str, Path]:
    """The recordings and flights that are found, by name."""
    found = (folder for folder in (recordings_folder(), flights_folder()) if folder is not None)
    return {file.parent.name: file.parent for folder in found for file in sorted(folder.glob("*/rig.toml"))}


def folder_of(name: str, most: int = MOST_READINGS) -> RecordingFolder:
    """A data set without its known path, up to `most` readings, with all of its truth."""
    if name in WORLDS:
        return world(name)
    folder = read_recording(places()[name])
    folder = replace(folder, rig=replace(folder.rig, path_knots=None))
    cut = [table["t_s"].sort()[most] for kind, table in folder.tables.items()
           if kind in CHANNELS and kind != "bearings" and len(table) > most]  # fmt: skip
    before = pl.col("t_s") < min(cut, default=np.inf)
    return replace(folder, tables={k: t if k == "truth" else t.filter(before) for k, t in folder.tables.items()})


def tracker_of(folder: RecordingFolder) -> NamedTracker:
    """The tracker that a user gets."""
    return build(fitting(folder), folder)


def problems(folder: RecordingFolder) -> Iterator[tuple[str, Problem]]:
    """Tag and readings as our tracker has them: averaged, repeated values once. None of other kinds, as phases."""
    for batch in tracker_of(folder).batches(folder):
        for trajectory in batch.trajectories:
            recording = trajectory.recording
            kind = next((name for name in CHANNELS if name in recording.readings), None)
            if kind is None:
                continue
            readings, times = recording.readings[kind], recording.times
            inputs = [recording.inputs[name] for name in INPUTS[kind]]
            geometry = np.concatenate([np.zeros((len(times), 0)), *inputs], axis=1)
            values, seen = readings.values, readings.seen
            if kind == "tdoa":  # A row has the differences of a message in slots.
                slots = values.shape[1]
                geometry, times = geometry.reshape(len(times) * slots, -1), np.repeat(times, slots)
                values, seen = values.reshape(-1, 1), seen.reshape(-1, 1)
            some = seen.any(axis=1)
            height = float(recording.inputs["height"][0]) if batch.planar else np.nan
            prior = PRIOR if folder.name in WORLDS else (1.0, 1.0)
            seen = seen & (np.arange(3) < 2) if kind == "fixes" and batch.planar else seen
            rows = times[some], values[some].astype(float), seen[some], geometry[some].astype(float)
            yield trajectory.tag, Problem(kind, *rows, height, prior)


def world(name: str) -> RecordingFolder:
    """The recording of a world, the same whenever it is asked for."""
    kind, d, acceleration, sigma = WORLDS[name]
    rng, tags = np.random.default_rng([7, list(WORLDS).index(name)]), [str(k) for k in range(TAGS)]
    rig = Rig(name, tags={tag: Tag(MIDDLE[2] if d == 2 else None) for tag in tags})
    if kind == "bearings":
        turns = [mounted(np.arctan2(MIDDLE[1] - y, MIDDLE[0] - x), 0.0, 0.0) for x, y, _ in CORNERS[::2]]
        stations = [Station(p, turn) for p, turn in zip(CORNERS[::2], turns, strict=True)]
        rig = replace(rig, stations={f"S{k}": s for k, s in enumerate(stations)})
        each = np.array([np.append(s.position, s.world_from_array().T.ravel()) for s in stations])
    elif kind != "fixes":
        rig, each = replace(rig, anchors={f"A{k}": p for k, p in enumerate(CORNERS)}), CORNERS
    ids, times = np.array([*rig.stations, *rig.anchors]), np.arange(ROWS) / RATE_HZ
    F, root = transition(d, 1 / RATE_HZ), np.linalg.cholesky(diffusion(d, 1 / RATE_HZ, acceleration))
    tables: dict[str, list[pl.DataFrame]] = {kind: [], "truth": []}
    for tag in tags:
        x, path = np.append(MIDDLE[:d], np.zeros(d)) + np.repeat(PRIOR, d) * rng.standard_normal(2 * d), []
        for _ in times:
            path.append(x[:d])
            x = F @ x + root @ rng.standard_normal(2 * d)
        geometry, turn = np.zeros((ROWS, 0)), np.arange(ROWS) % max(len(ids), 1)
        columns: dict[str, Any] = {"t_s": times, "tag": tag}
        if kind != "fixes":
            geometry = np.hstack([each[turn], each[(turn + 1) % len(ids)]]) if kind == "tdoa" else each[turn]
            columns["station" if kind == "bearings" else "anchor"] = ids[turn]
            columns |= {"anchor_2": ids[(turn + 1) % len(ids)]} if kind == "tdoa" else {}
        one = Problem(kind, times, np.empty(0), np.empty(0), geometry, MIDDLE[2] if d == 2 else np.nan)
        clean = one.predicted(np.array(path), geometry, np.zeros((ROWS, 1)))
        z = clean + sigma * rng.standard_normal(clean.shape)
        names = {"ranges": ["range_m"], "tdoa": ["range_difference_m"], "bearings": ["azimuth_rad", "elevation_rad"]}
        columns |= dict(zip(names.get(kind, ["x_m", "y_m", "z_m"]), z.T, strict=True))
        tables[kind].append(pl.DataFrame(columns))
        truth = zip(["x_m", "y_m", "z_m"], one.place(np.array(path)).T, strict=True)
        tables["truth"].append(pl.DataFrame({"t_s": times, "tag": tag, **dict(truth)}))
    return RecordingFolder(name, None, rig, {k: pl.concat(parts) for k, parts in tables.items()})

"""What estimators are given: recordings that are found, and five worlds, of which the plain filter is the optimum."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import polars as pl

from trackwright.experiments.lab.benchmark.peers.model import Problem, diffusion, transition
from trackwright.experiments.lab.validation.sites import read
from trackwright.trackers.catalogue import build, fitting
from trackwright.trackers.core.model.rig import Rig, Station, Tag
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS
from trackwright.trackers.recordings.rig_file import mounted

MOST_READINGS = 6_000
"""Readings of a recording that every estimator is given, from its beginning; bearings, which are averaged, whole."""
INPUTS = {"ranges": ("anchors",), "tdoa": ("pairs",), "bearings": ("origin", "axes"), "fixes": ()}
"""The kinds of readings, and the inputs of a row that are the geometry of its reading."""
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


def folder_of(name: str, most: int = MOST_READINGS) -> RecordingFolder:
    """A data set without its known path, up to `most` readings, with all of its truth."""
    if name in WORLDS:
        return world(name)
    folder = read(name)
    tables = [folder.tables[kind]["t_s"].sort() for kind in ("ranges", "tdoa", "fixes") if kind in folder.tables]
    before = pl.col("t_s") < min((times[most] for times in tables if len(times) > most), default=np.inf)
    cut = {k: t if k == "truth" else t.filter(before) for k, t in folder.tables.items()}
    return replace(folder, rig=replace(folder.rig, path_knots=None), tables=cut)


def problems(folder: RecordingFolder, most: int | None = None) -> Iterator[tuple[str, Problem]]:
    """Tag and readings as our tracker has them: averaged, repeated values once. None of other kinds, as phases."""
    for batch in build(fitting(folder), folder).batches(folder):
        for trajectory in batch.trajectories:
            recording = trajectory.recording
            kind = next((name for name in INPUTS if name in recording.readings), None)
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
            height = float(recording.inputs["height"][0]) if batch.planar else np.nan
            prior = PRIOR if folder.name in WORLDS else (1.0, 1.0)
            seen = seen & (np.arange(3) < 2) if kind == "fixes" and batch.planar else seen
            rows = np.flatnonzero(seen.any(axis=1))[:most]
            given = times[rows], values[rows].astype(float), seen[rows], geometry[rows].astype(float)
            yield trajectory.tag, Problem(kind, *given, height, prior)


def world(name: str) -> RecordingFolder:
    """The recording of a world, the same whenever it is asked for."""
    kind, d, acceleration, sigma = WORLDS[name]
    rng, each = np.random.default_rng([7, list(WORLDS).index(name)]), np.zeros((1, 0))
    rig = Rig(name, tags={str(k): Tag(MIDDLE[2] if d == 2 else None) for k in range(TAGS)})
    if kind == "bearings":
        stations = (Station(p, mounted(np.arctan2(*(MIDDLE - p)[1::-1]), 0.0, 0.0)) for p in CORNERS[::2])
        rig = replace(rig, stations={f"S{k}": station for k, station in enumerate(stations)})
        each = np.array([np.append(s.position, s.world_from_array().T.ravel()) for s in rig.stations.values()])
    elif kind != "fixes":
        rig, each = replace(rig, anchors={f"A{k}": p for k, p in enumerate(CORNERS)}), CORNERS
    ids, times, turn = np.array([*rig.stations, *rig.anchors]), np.arange(ROWS) / RATE_HZ, np.arange(ROWS) % len(each)
    after, columns, geometry = (turn + 1) % len(each), {"t_s": times}, each[turn]
    if kind == "tdoa":
        geometry, columns["anchor_2"] = np.hstack([geometry, each[after]]), ids[after]
    if kind != "fixes":
        columns["station" if kind == "bearings" else "anchor"] = ids[turn]
    model = Problem(kind, times, np.empty(0), np.empty(0), geometry, MIDDLE[2] if d == 2 else np.nan)
    F, root = transition(d, 1 / RATE_HZ), np.linalg.cholesky(diffusion(d, 1 / RATE_HZ, acceleration))
    tables: dict[str, list[pl.DataFrame]] = {kind: [], "truth": []}
    for tag in rig.tags:
        x, path = np.append(MIDDLE[:d], np.zeros(d)) + np.repeat(PRIOR, d) * rng.standard_normal(2 * d), []
        for _ in times:
            path.append(x[:d])
            x = F @ x + root @ rng.standard_normal(2 * d)
        clean = model.predicted(np.array(path), geometry, np.zeros((ROWS, 1)))
        z = clean + sigma * rng.standard_normal(clean.shape)
        values = zip((column.name for column in KINDS[kind].columns), z.T, strict=True)
        tables[kind].append(pl.DataFrame({**columns, "tag": tag, **dict(values)}))
        truth = zip(("x_m", "y_m", "z_m"), model.place(np.array(path)).T, strict=True)
        tables["truth"].append(pl.DataFrame({"t_s": times, "tag": tag, **dict(truth)}))
    return RecordingFolder(name, None, rig, {k: pl.concat(parts) for k, parts in tables.items()})

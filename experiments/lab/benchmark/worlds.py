"""Five simulated worlds whose optimum is known: paths of white acceleration, readings with white normal noise.

The filter and the path by least squares with the levels of a world are the optimum of its estimators.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import polars as pl

from trackwright.experiments.lab.benchmark.motion import Levels, diffusion, transition
from trackwright.experiments.lab.benchmark.readings import predicted
from trackwright.trackers.core.model.rig import Rig, Station, Tag
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.rig_file import mounted

ROWS, RATE_HZ, TAGS, SEED = 600, 20.0, 3, 7
"""Readings of a tag, one after another; how many a second; tags; seed."""

MIDDLE, HEIGHT = np.array([5.0, 5.0, 1.2]), 1.2
"""Where paths begin, m, and the height of tags where it is known, m."""

CORNERS = np.array(
    [[0, 0, 0.2], [10, 0, 2.8], [10, 10, 0.2], [0, 10, 2.8], [0, 5, 2.8], [10, 5, 0.2], [5, 0, 2.8], [5, 10, 0.2]],
    float,
)
"""Anchors, m; stations are at every other."""


class World(NamedTuple):
    """A kind of readings, the coordinates that are estimated, and the levels of the noise."""

    kind: str
    dimensions: int
    levels: Levels


WORLDS = {
    "world-ranges-2d": World("ranges", 2, Levels(0.02, 0.1)),
    "world-ranges-3d": World("ranges", 3, Levels(0.02, 0.1)),
    "world-tdoa": World("tdoa", 3, Levels(0.02, 0.1)),
    "world-bearings": World("bearings", 2, Levels(0.02, 0.1)),
    "world-fixes": World("fixes", 3, Levels(0.02, 0.2)),
}


def simulated(name: str) -> RecordingFolder:
    """The recording of a world, the same whenever it is asked for."""
    world = WORLDS[name]
    rng = np.random.default_rng([SEED, list(WORLDS).index(name)])
    return _folder(name, world, rng)


def _folder(name: str, world: World, rng: np.random.Generator) -> RecordingFolder:
    rig = _rig(name, world)
    ids = list(rig.stations or rig.anchors)
    d, truth, read = world.dimensions, list[pl.DataFrame](), list[pl.DataFrame]()
    times = np.arange(ROWS) / RATE_HZ
    for tag in map(str, range(TAGS)):
        path = _path(rng, d, world.levels.acceleration)
        path = path if d == 3 else np.column_stack([path, np.full(ROWS, HEIGHT)])
        truth.append(pl.DataFrame({"t_s": times, "tag": tag} | dict(zip(("x_m", "y_m", "z_m"), path.T, strict=True))))
        turn = np.arange(ROWS) % max(len(ids), 1)
        geometry = _geometry(world.kind, rig, ids, turn)
        clean = predicted(world.kind, path, geometry, np.zeros((ROWS, 1)))
        values = clean + world.levels.reading * rng.standard_normal(clean.shape)
        columns = dict(zip(COLUMNS[world.kind], values.T, strict=True))
        sources = dict(
            zip(SOURCES[world.kind], ([ids[(k + j) % len(ids)] for k in turn] for j in range(2)), strict=False)
        )
        read.append(pl.DataFrame({"t_s": times, "tag": tag} | sources | columns))
    return RecordingFolder(name, None, rig, {world.kind: pl.concat(read), "truth": pl.concat(truth)})


COLUMNS = {
    "ranges": ("range_m",),
    "tdoa": ("range_difference_m",),
    "bearings": ("azimuth_rad", "elevation_rad"),
    "fixes": ("x_m", "y_m", "z_m"),
}
SOURCES = {"ranges": ("anchor",), "tdoa": ("anchor", "anchor_2"), "bearings": ("station",), "fixes": ()}


def _path(rng: np.random.Generator, d: int, acceleration: float) -> np.ndarray:
    """Places (ROWS, d) from the middle, with a random velocity at the start."""
    F, root = transition(d, 1 / RATE_HZ), np.linalg.cholesky(diffusion(d, 1 / RATE_HZ, acceleration))
    state = np.concatenate([MIDDLE[:d], 0.05 * rng.standard_normal(d)])
    places = np.empty((ROWS, d))
    for row in range(ROWS):
        places[row] = state[:d]
        state = F @ state + root @ rng.standard_normal(2 * d)
    return places


def _rig(name: str, world: World) -> Rig:
    tags = {str(k): Tag(HEIGHT if world.dimensions == 2 else None) for k in range(TAGS)}
    if world.kind == "fixes":
        return Rig(name, tags=tags)
    if world.kind == "bearings":
        stations = {f"S{k}": Station(place, _looking_at_the_middle(place)) for k, place in enumerate(CORNERS[::2])}
        return Rig(name, stations=stations, tags=tags)
    return Rig(name, anchors={f"A{k}": place for k, place in enumerate(CORNERS)}, tags=tags)


def _looking_at_the_middle(place: np.ndarray) -> np.ndarray:
    """The quaternion of a level station whose boresight points to the middle."""
    return mounted(np.arctan2(MIDDLE[1] - place[1], MIDDLE[0] - place[0]), 0.0, 0.0)


def _geometry(kind: str, rig: Rig, ids: list[str], turn: np.ndarray) -> np.ndarray:
    """The geometry (ROWS, g) of readings, each of the anchor or station whose turn it is, or of it and the next."""
    if kind == "fixes":
        return np.zeros((ROWS, 0))
    if kind == "bearings":
        each = [np.append(s.position, s.world_from_array().T.ravel()) for s in rig.stations.values()]
        return np.array(each)[turn]
    places = np.array([rig.anchors[name] for name in ids])
    return places[turn] if kind == "ranges" else np.hstack([places[turn], places[(turn + 1) % len(ids)]])

"""Sites in normal operation, simulated, and changes made to recordings, simulated or real ones, by their truth.

Normal operation: constant errors of each source, errors bound to places, errors that last for 3 s, white noise and, of
ranges and times of arrival, detours of 20 cm and more for 2 s in 3 % of the time. A change is made to the readings of a
recording from a time on, with the true positions; all else of the recording stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import polars as pl
from scipy.interpolate import PchipInterpolator
from scipy.signal import lfilter

import trackwright as tw
from trackwright.experiments.lab.validation.surveys import on_walls
from trackwright.sim.stations import facing
from trackwright.trackers.recordings.checks.fitted_changes import about_vertical
from trackwright.trackers.recordings.kinds import KINDS

RATE = 5.0
"""Readings of each source a second, by default."""

LEG_S, LASTS, DETOUR_S, HIDDEN = 6.0, 3.0, 2.0, 0.03
ERRORS = {"m": (0.05, 0.02, 0.03, 0.05), "rad": tuple(np.radians([3.0, 1.5, 1.0, 2.0]))}
"""Standard deviations of constant errors, of those bound to places, of those that last, and of white noise."""

SITES = {
    "ranges": (6, None), "ranges, height known": (6, 1.2), "range differences": (8, None), "bearings": (4, 1.2),
}  # fmt: skip
"""Anchors or stations of each kind of site, and the height of the tag, m, where it is known."""


class World(NamedTuple):
    """A simulated site: its kind, the room (3,) m, its rig, constant errors (G, m), and waves of those of places."""

    kind: str
    size: np.ndarray
    rig: tw.Rig
    constant: np.ndarray
    waves: np.ndarray


class Change(NamedTuple):
    """A change of sources of a table from `onset_s` on, the recording's time.

    `size`: the move (3,) m, the turn, rad, the delay, m, the drift, m/s, the detour at places, m, or nothing of a swap.
    """

    name: str
    table: str
    sources: tuple[str, ...]
    size: np.ndarray
    onset_s: float


def world_of(seed: int, kind: str) -> World:
    """A room with anchors or stations on its walls."""
    random = np.random.default_rng([seed, 71])
    size, count = np.append(random.uniform([6.0, 5.0], [12.0, 9.0]), 2.8), SITES[kind][0]
    walls = on_walls(size[:2], (np.arange(count) + random.uniform(0.0, 0.6, count)) / count)
    heights = np.where(np.arange(count) % 2, random.uniform(2.2, 2.8, count), random.uniform(0.3, 1.0, count))
    places = np.column_stack([walls, heights])
    middle = np.append(size[:2] / 2, 1.2)
    names = [f"{'S' if kind == 'bearings' else 'A'}{k + 1}" for k in range(count)]
    tags = {"0": tw.Tag(height=SITES[kind][1])}
    if kind == "bearings":
        stations = {n: tw.Station(p, facing(p, middle, (0.0, 0.0, 1.0))) for n, p in zip(names, places, strict=True)}
        rig = tw.Rig("site", stations=stations, tags=tags)
    else:
        rig = tw.Rig("site", anchors=dict(zip(names, places, strict=True)), tags=tags)
    columns = 2 if kind == "bearings" else 1
    constant = ERRORS["rad" if kind == "bearings" else "m"][0] * random.standard_normal((count, columns))
    return World(kind, size, rig, constant, random.uniform(0.0, 2.0 * np.pi, (count, columns, 4)))


def normal_operation(world: World, name: str, seconds: float, seed: int, rate: float = RATE) -> tw.RecordingFolder:
    """A recording of a tag in the room, with truth; `rate`: readings of each source a second."""
    random = np.random.default_rng([seed, 72])
    times = np.arange(int(seconds * rate)) / rate
    corners = np.arange(0.0, seconds + 2 * LEG_S, LEG_S)
    path = PchipInterpolator(
        corners, random.uniform([0.6, 0.6, 0.8], [*(world.size[:2] - 0.6), 1.6], (len(corners), 3))
    )(times)
    height = SITES[world.kind][1]
    path[:, 2] = path[:, 2] if height is None else height
    if world.kind == "bearings":
        ideal = np.stack([station.angles(path) for station in world.rig.stations.values()], axis=1)
    else:
        ideal = np.stack([np.linalg.norm(path - place, axis=1) for place in world.rig.anchors.values()], axis=1)[
            ..., None
        ]
    values = ideal + _errors(world, path, ideal.shape, random, rate)
    seen = random.random(values.shape[:2]) > 0.1
    names = np.array([*world.rig.anchors, *world.rig.stations])
    tables = {
        "truth": pl.DataFrame({"t_s": times, "tag": "0", "x_m": path[:, 0], "y_m": path[:, 1], "z_m": path[:, 2]})
    }
    if world.kind == "range differences":
        # Each message is compared with that of the next anchor.
        row, first = np.nonzero(seen & np.roll(seen, -1, axis=1))
        second = (first + 1) % len(names)
        difference = values[row, first, 0] - values[row, second, 0]
        columns = {"anchor": names[first], "anchor_2": names[second], "range_difference_m": difference}
        tables["tdoa"] = pl.DataFrame({"t_s": times[row], "tag": ["0"] * len(row), **columns})
    else:
        row, source = np.nonzero(seen)
        kind = KINDS["bearings" if world.kind == "bearings" else "ranges"]
        columns = {kind.sensors[0]: names[source], **dict(zip(kind.least, values[row, source].T, strict=True))}
        tables[kind.name] = pl.DataFrame({"t_s": times[row], "tag": ["0"] * len(row), **columns})
    return tw.RecordingFolder(name, None, replace(world.rig, name=name), tables)


def _errors(
    world: World, path: np.ndarray, shape: tuple[int, ...], random: np.random.Generator, rate: float
) -> np.ndarray:
    """Errors (T, G, m) of normal operation, m or rad."""
    _, at_places, lasting, white = ERRORS["rad" if world.kind == "bearings" else "m"]
    phase_x, phase_y, *turns = np.moveaxis(world.waves, -1, 0)
    waves = np.sin(1.6 * path[:, 0, None, None] * np.cos(turns[0]) + phase_x)
    waves = waves + np.sin(1.6 * path[:, 1, None, None] * np.cos(turns[1]) + phase_y)
    keep = np.exp(-1.0 / (rate * LASTS))
    slow = lfilter([1.0], [1.0, -keep], np.sqrt(1.0 - keep**2) * random.standard_normal(shape), axis=0)
    errors = world.constant + at_places * waves + lasting * slow + white * random.standard_normal(shape)
    if world.kind != "bearings":
        often = int(DETOUR_S * rate)
        hidden = np.repeat(random.random((len(path) // often + 1, shape[1])) < HIDDEN, often, axis=0)[: len(path)]
        errors[..., 0] += hidden * (0.2 + random.exponential(0.2, hidden.shape))
    return np.asarray(errors)


def changed(folder: tw.RecordingFolder, change: Change, seed: int) -> tw.RecordingFolder:
    """The recording with a change made to its readings."""
    kind, rows = KINDS[change.table], folder.tables[change.table]
    after = rows["t_s"].to_numpy() >= change.onset_s
    columns = [rows[name].cast(pl.String).to_numpy().astype(object) for name in kind.sensors]
    if change.name == "swapped":
        other = dict(zip(change.sources, change.sources[::-1], strict=True))
        renamed = [np.where(after, [other.get(x, x) for x in column], column) for column in columns]
        new = {name: pl.Series(list(column)) for name, column in zip(kind.sensors, renamed, strict=True)}
        return replace(folder, tables={**folder.tables, change.table: rows.with_columns(**new)})
    positions = true_positions(folder, change.table)
    values = rows.select(kind.least).to_numpy().copy()
    for column, sign in zip(columns, (1.0, -1.0), strict=False):
        mine = after & (column == change.sources[0]) & np.isfinite(positions[:, 0])
        values[mine] += sign * _difference(folder.rig, change, positions[mine], rows["t_s"].to_numpy()[mine], seed)
    if kind.angles:
        values[:, 0] = np.mod(values[:, 0] + np.pi, 2.0 * np.pi) - np.pi
    new = {name: pl.Series(column) for name, column in zip(kind.least, values.T, strict=True)}
    return replace(folder, tables={**folder.tables, change.table: rows.with_columns(**new)})


def true_positions(folder: tw.RecordingFolder, table: str) -> np.ndarray:
    """The true positions (N, 3), m, of the rows of a table, with the known height of the tag where truth has none."""
    rows, truth = folder.tables[table], folder.tables["truth"]
    result = np.full((len(rows), 3), np.nan)
    tags = rows["tag"].cast(pl.String).to_numpy()
    for tag in np.unique(tags):
        own = truth.filter(pl.col("tag").cast(pl.String) == tag)
        if len(own):
            at = [
                np.interp(rows["t_s"].to_numpy()[tags == tag], own["t_s"], own[axis].fill_null(0.0))
                for axis in ("x_m", "y_m", "z_m")
            ]
            result[tags == tag] = np.stack(at, axis=1)
    return result


def _difference(rig: tw.Rig, change: Change, at: np.ndarray, times: np.ndarray, seed: int) -> np.ndarray:
    """What is added (N, m) to the values of a source at positions and times."""
    name, size = change.sources[0], change.size
    if change.table == "bearings":
        station = rig.stations[name]
        before = station.angles(at)
        # The turned array sees the tag where the unturned one would see it turned back.
        about = (at - station.position) @ about_vertical(float(size[0])) + station.position
        return (
            station.angles(about) - before
            if change.name == "turned"
            else behind_wall(rig, name, at, seed)[:, None] * size
        )
    place = np.asarray(rig.anchors[name], float)
    match change.name:
        case "moved":
            return (np.linalg.norm(at - place - size, axis=1) - np.linalg.norm(at - place, axis=1))[:, None]
        case "drift":
            return (size[0] * (times - change.onset_s))[:, None]
        case "wall":
            return (size[0] * behind_wall(rig, name, at, seed))[:, None]
    return np.full((len(at), 1), size[0])


def behind_wall(rig: tw.Rig, name: str, at: np.ndarray, seed: int) -> np.ndarray:
    """Whether positions (N, 3) are behind a wall that hides a third of what is seen from a source."""
    place = np.asarray(rig.anchors[name] if name in rig.anchors else rig.stations[name].position, float)
    if not len(at):
        return np.zeros(0, bool)
    away = at[:, :2] - place[:2]
    angle = np.arctan2(*away.T)
    middle = np.arctan2(*away.mean(axis=0))
    about = np.mod(angle - middle + np.pi, 2.0 * np.pi) - np.pi
    low = np.random.default_rng([seed, 73]).uniform(0.0, 0.5)
    first, last = np.quantile(about, [low, low + 0.45])
    far = np.linalg.norm(away, axis=1)
    return (about > first) & (about < last) & (far > np.quantile(far, 0.25))


def drawn_change(name: str, large: bool, table: str, ids: Sequence[str], onset_s: float, seed: int) -> Change:
    """A change of some source, of a size in the range of small or large ones."""
    random = np.random.default_rng([seed, 74])
    sources = tuple(str(x) for x in random.choice(sorted(ids), 2 if name == "swapped" else 1, replace=False))
    of_station = table == "bearings"
    low, high = {
        "moved": (0.5, 2.0) if large else (0.1, 0.2),
        "delay": (0.4, 1.0) if large else (0.1, 0.2),
        "drift": (0.002, 0.005) if large else (0.0004, 0.0008),
        "turned": (np.radians(10.0), np.radians(40.0)) if large else (np.radians(3.0), np.radians(3.0)),
        "wall": ((np.radians(20.0), np.radians(40.0)) if of_station else (0.4, 0.8)) if large else (0.1, 0.2),
        "swapped": (0.0, 0.0),
    }[name]
    size = random.uniform(low, high)
    angle = random.uniform(0.0, 2.0 * np.pi)
    if name == "moved":
        return Change(name, table, sources, size * np.array([np.cos(angle), np.sin(angle), 0.0]), onset_s)
    sign = 1.0 if name == "wall" and not of_station else random.choice([-1.0, 1.0])
    return Change(name, table, sources, np.array([sign * size]) if name != "swapped" else np.zeros(0), onset_s)

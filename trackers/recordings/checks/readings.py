"""Readings of a table beside true positions, and a robust fit."""

from __future__ import annotations

from collections.abc import Callable
from itertools import compress
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from trackwright.trackers.recordings.columns import TruePaths, stable_order, within_groups
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, Kind, Sensors

MOST_OF_GROUP, LEAST_OF_GROUP = 500, 12  # readings of a sensor that are compared


def known_median(x: Float[np.ndarray, "N m"]) -> Float[np.ndarray, " m"]:
    """The median (m,) of each column without its missing values, NaN without any value."""
    return np.array([np.median(c[~np.isnan(c)]) if not np.isnan(c).all() else np.nan for c in x.T])


class Compared(NamedTuple):
    """Readings of a table and what predicts them, a group (anchor or station; of fixes, tag) together.

    `group` (N,), not decreasing, and `tag` (N,): numbers in `ids` and in `tags`. A difference is in the groups of both
    its anchors, in the second one's with the other sign. `positions` (N, 3) m: the true ones, with the known `heights`
    of tags, NaN where unknown, for a truth without.
    """

    kind: Kind
    ids: tuple[str, ...]
    tags: tuple[str, ...]
    columns: tuple[str, ...]
    group: Int[np.ndarray, " N"]
    tag: Int[np.ndarray, " N"]
    times: Float[np.ndarray, " N"]
    values: Float[np.ndarray, "N m"]
    positions: Float[np.ndarray, "N 3"]
    sensors: Sensors
    paths: TruePaths
    heights: Float[np.ndarray, " tags"]

    def changed(self, **fields: Any) -> Compared:
        """The same readings with other fields, of these or of the sensors."""
        own = {name: x for name, x in fields.items() if name in self._fields}
        return self._replace(**own, sensors=self.sensors._replace(**{k: x for k, x in fields.items() if k not in own}))

    def of_rows(self, part: Any) -> Compared:
        """Some of the readings, by a mask, a slice or their numbers."""
        names = ("group", "tag", "times", "values", "positions")
        return self.changed(number=self.sensors.number[part], **{name: getattr(self, name)[part] for name in names})

    def thinned(self, most: int) -> Compared:
        """Every k-th reading, at most about `most` in all."""
        return self.of_rows(slice(None, None, -(-len(self.group) // most)))

    def later(self, delay: float) -> Compared:
        """The readings beside the true positions of `delay` seconds before, NaN where there are none."""
        starts = np.concatenate([[0], np.flatnonzero(np.diff(self.tag)) + 1, [len(self.tag)]])
        positions, _ = self.paths.at([self.tags[k] for k in self.tag[starts[:-1]]], starts, self.times - delay)
        positions[:, 2] = np.where(np.isnan(positions[:, 2]), self.heights[self.tag], positions[:, 2])
        return self._replace(positions=positions)

    def turned(self, yaw: float, centre: Float[np.ndarray, " 3"], to: Float[np.ndarray, " 3"]) -> Compared:
        """The readings beside the true positions turned about the vertical at `centre`, which goes `to` a place."""
        return self._replace(positions=to + (self.positions - centre) @ about_vertical(yaw).T)

    def errors(self) -> Float[np.ndarray, "N m"]:
        """The differences from the values that the positions imply: see `Kind.errors`."""
        return self.kind.errors(self.values, self.positions, self.sensors, self.columns)

    def sizes(self, errors: Float[np.ndarray, "N m"] | None = None, bias: bool = True) -> Float[np.ndarray, "G m"]:
        """The median size of the errors of each group and column, less a `bias` as far as it may be the sensor's."""
        errors = self.errors() if errors is None else errors
        most, sizes = bias * self.kind.sizes("bias", errors.shape[1]), np.full((len(self.ids), errors.shape[1]), np.nan)
        for k, part in enumerate(np.split(errors, np.searchsorted(self.group, np.arange(1, len(self.ids))))):
            known = 2 * np.isfinite(part).sum(axis=0) >= max(len(part), 1)
            middle = np.clip(known_median(part), -most, most)
            sizes[k] = np.where(known, known_median(np.abs(part - middle)), np.nan)
        return sizes

    def large(self) -> Bool[np.ndarray, " G"]:
        """The groups whose errors are large in a column."""
        return np.asarray((self.sizes() > self.kind.sizes("large", len(self.columns))).any(axis=1))


def readings_of(recording: RecordingFolder, table: str) -> Compared:
    """The readings of a table, one tag after another, without positions."""
    rows, kind = recording.rows(table), KINDS[table]
    measured, tag, tags = kind.measured(recording.rig, rows), rows.of_each(np.arange(len(rows.tags))), tuple(rows.tags)
    ids, group = (measured.ids, measured.sensors.number[:, 0]) if kind.sensors else (tags, tag)
    at, known = (rows.times, measured.values, np.full((len(tag), 3), np.nan)), recording.rig.tags
    heights = np.array([getattr(known.get(tag), "height", None) for tag in tags], float)
    return Compared(kind, ids, tags, measured.columns, group, tag, *at, measured.sensors, recording.paths, heights)


def compared(recording: RecordingFolder, table: str) -> Compared | None:
    """The readings of a table beside the truth; None where too few of them have a true position."""
    kind = KINDS[table]
    if kind.predicted is None or not {table, "truth"} <= {*recording.tables}:
        return None
    view = readings_of(recording, table)
    tag, tags, ids, number = view.tag, view.tags, view.ids, view.sensors.number
    if kind.difference:
        # Each is one of both its anchors, whichever is the first.
        number = np.concatenate([number, number[:, ::-1]])
        view = view.of_rows(np.tile(np.arange(len(tag)), 2)).changed(number=number, group=number[:, 0])
        view = view.changed(values=view.values * np.repeat([[1], [-1]], len(tag), axis=0))
    order, counts = stable_order(view.group * len(tags) + view.tag), np.bincount(view.group)
    view = view.of_rows(order[within_groups(counts) % np.repeat(-(-counts // MOST_OF_GROUP), counts) == 0]).later(0.0)
    view = view.of_rows(np.isfinite(view.errors()).any(axis=1))
    enough = np.bincount(view.group, minlength=len(ids)) >= LEAST_OF_GROUP
    view = view.of_rows(enough[view.group])
    # The other sensor of a difference stays in any case.
    used = enough | (np.bincount(view.sensors.number.ravel(), minlength=len(ids)) > 0)
    names, new = ("places", "axes", "antennas", "wavelengths") if kind.sensors else (), np.cumsum(used) - 1
    fields = {name: getattr(view.sensors, name)[used] for name in names}
    view = view.changed(**fields, number=new[view.sensors.number], group=new[view.group], ids=(*compress(ids, used),))
    return view if len(view.group) else None


def about_vertical(yaw: float) -> Float[np.ndarray, "3 3"]:
    """The matrix of a turn about z, rad."""
    c, s = float(np.cos(yaw)), float(np.sin(yaw))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def robust_fit(
    errors: Callable[[np.ndarray], Float[np.ndarray, "N m"]], start: Float[np.ndarray, " k"], steps: int = 15
) -> tuple[Float[np.ndarray, " k"], float]:
    """The numbers near `start` with the smallest errors, and their median size; errors that are NaN count nothing."""
    from scipy.optimize import least_squares

    flat, x = lambda x: errors(x).ravel(), np.asarray(start, float)
    near = 1e-6 * np.eye(len(x))
    # Where one of the two errors is unknown, as at the first time of the truth, there is no difference.
    slopes = lambda x: np.nan_to_num(np.stack([flat(x + by) for by in near], axis=-1) - flat(x)[:, None]) / 1e-6  # noqa: E731
    for _ in range(3):
        scale = max(1.4826 * float(np.median(np.abs(np.nan_to_num(flat(x))))), 1e-9)
        # An error that becomes unknown is no gain.
        known = lambda x, far=3.0 * scale: np.nan_to_num(flat(x), nan=far)  # noqa: E731
        x = least_squares(known, x, slopes, loss="cauchy", f_scale=scale, max_nfev=steps).x
    return x, float(np.median(np.abs(np.nan_to_num(flat(x)))))

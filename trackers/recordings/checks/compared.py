"""The readings of a table beside positions, the true ones or those that fit each moment best; and a robust fit."""

from __future__ import annotations

from collections.abc import Callable
from itertools import compress
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from jaxtyping import Float, Int

from trackwright.trackers.recordings.checks.readings import MOST_ROWS, known_median
from trackwright.trackers.recordings.columns import TruePaths, stable_order, within_groups
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, Kind, Sensors, wrapped

MOST_OF_GROUP, LEAST_OF_GROUP = 500, 12
"""Readings of an anchor, station or tag that are compared, evenly spaced in time; and the least number of them."""

SPANS_S, LEAST_MOMENTS, MOST_MOMENTS, MOST_SENSORS, LEAST_EXTENT_M = (0.1, 0.25, 0.5, 1.0), 15, 60, 12, 1.0
"""Times within which readings are taken for one moment's, s, the first in which enough of them come; and the extent, m,
of sensors below which any change leaves their readings as contradictory."""

POSITION_STEPS, STEP_M = 12, 1e-4
"""Steps to positions; half the distance over which slopes are taken, m."""


class Compared(NamedTuple):
    """Readings of a table and what predicts them, a group (anchor or station; of fixes, tag) together.

    `ids`: of the G groups. `group` (N,), not decreasing, `tag` (N,): numbers in `ids` and in `tags`. Beside a truth a
    difference is in the groups of both its anchors, in the second one's with the other sign. `times` (N,) s.
    `values` (N, m): NaN where one is missing. `positions` (N, 3) m: the true ones. `sensors`: of each reading,
    the first of which is the group. `paths`: the true paths. Without a truth, `moment` (N,): whose best position stands
    for the true one, and `heights` (E,) m of the moments, NaN where not known.
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
    moment: Int[np.ndarray, " N"] = np.zeros(0, int)
    heights: Float[np.ndarray, " E"] = np.zeros(0)

    def changed(self, **fields: np.ndarray) -> Compared:
        """The same readings with other fields, of these or of the sensors."""
        of_view = {name: x for name, x in fields.items() if name in self._fields}
        of_sensors = {name: x for name, x in fields.items() if name not in of_view}
        return self._replace(**of_view, sensors=self.sensors._replace(**of_sensors))  # type: ignore[arg-type]

    def of_rows(self, part: Any) -> Compared:
        """Some of the readings, by a mask, a slice or their numbers."""
        names = ["group", "tag", "times", "values", "positions", *["moment"] * bool(len(self.moment))]
        return self.changed(**{name: getattr(self, name)[part] for name in names}, number=self.sensors.number[part])

    def thinned(self, most: int) -> Compared:
        """Every k-th reading of each group, at most about `most` in all."""
        return self.of_rows(slice(None, None, -(-len(self.group) // most)))

    def later(self, delay: float, of: Int[np.ndarray, " T"] | None = None) -> Compared:
        """The same readings with the true positions of `delay` seconds before, NaN where there are none.

        `of`: the number of the tag whose path stands for each tag's.
        """
        path = self.tag if of is None else of[self.tag]
        starts = np.concatenate([[0], np.flatnonzero(np.diff(path)) + 1, [len(path)]])
        positions, _ = self.paths.at([self.tags[k] for k in path[starts[:-1]]], starts, self.times - delay)
        return self._replace(positions=positions)

    def errors(self) -> Float[np.ndarray, "N m"]:
        """The differences from the values that the positions imply: see `Kind.errors`."""
        return self.kind.errors(self.values, self.positions, self.sensors, self.columns)

    def sizes(self, errors: Float[np.ndarray, "N m"] | None = None, bias: bool = True) -> Float[np.ndarray, "G m"]:
        """The median size of the errors of each group and column; NaN where fewer than half of them are known.

        `errors`: by default those of the positions. `bias`: less their median, as far as it may be the sensor's own.
        """
        errors = self.errors() if errors is None else errors
        most, sizes = self.kind.sizes("bias", errors.shape[1]) * bias, np.full((len(self.ids), errors.shape[1]), np.nan)
        for k, part in enumerate(np.split(errors, np.searchsorted(self.group, np.arange(1, len(self.ids))))):
            known = 2 * np.isfinite(part).sum(axis=0) >= max(len(part), 1)
            middle = np.clip(known_median(part), -most, most)
            sizes[k] = np.where(known, known_median(np.abs(part - middle)), np.nan)
        return sizes

    def medians(self, errors: Float[np.ndarray, "N m"]) -> Float[np.ndarray, "G m"]:
        """The median error of each group and column.

        Of differences the errors of anchors, by least squares over the medians of pairs, less their median: an error
        that all have in common is seen in no difference.
        """
        ids = len(self.ids)
        if not self.kind.difference:
            return np.stack([known_median(errors[self.group == k]) for k in range(ids)])
        pairs, of_pair, counts = np.unique(self.sensors.number, axis=0, return_inverse=True, return_counts=True)
        medians = np.stack([known_median(errors[of_pair.ravel() == k]) for k in range(len(pairs))])
        signs, weights = np.eye(ids)[pairs[:, 0]] - np.eye(ids)[pairs[:, 1]], np.sqrt(counts)[:, None]
        own = np.linalg.lstsq(weights * signs, weights * medians, rcond=None)[0]
        return np.asarray(own - np.median(own, axis=0))

    def located(self) -> Compared:
        """The same readings at the positions that fit each moment best, by damped Gauss-Newton steps."""
        free, seen = np.isnan(self.heights), np.isfinite(self.values).astype(float)[..., None]
        p = np.tile(self.sensors.places.mean(axis=0) - [0.0, 0.0, 1.0], (len(free), 1))
        p[:, 2] = np.where(free, p[:, 2], self.heights)
        allowed = np.stack([np.ones_like(free), np.ones_like(free), free], axis=1)
        longest = np.linalg.norm(np.ptp(self.sensors.places, axis=0))
        for _ in range(POSITION_STEPS):
            view = self._replace(positions=p[self.moment])
            J = slopes(self.kind, view.positions, self.sensors) * seen * allowed[self.moment][:, None]
            normal, side = np.zeros((len(p), 3, 3)), np.zeros((len(p), 3))
            np.add.at(normal, self.moment, np.einsum("nci,ncj->nij", J, J))
            np.add.at(side, self.moment, np.einsum("nci,nc->ni", J, np.nan_to_num(view.errors())))
            ridge = (0.003 * np.trace(normal, axis1=1, axis2=2) + 1e-9)[:, None, None] * np.eye(3)
            step = np.linalg.solve(normal + ridge, side[..., None])[..., 0]
            p = p + step * np.minimum(longest / np.maximum(np.linalg.norm(step, axis=1), 1e-9), 1.0)[:, None]
        return self._replace(positions=p[self.moment])

    def closing(self) -> float:
        """The root mean square of the errors that remain in a typical moment, m or rad."""
        squares = self.located().errors() ** 2
        count, total = (np.bincount(self.moment, x) for x in (np.isfinite(squares).sum(1), np.nansum(squares, axis=1)))
        return float(np.median(np.sqrt(total[count > 0] / count[count > 0])))


def slopes(kind: Kind, positions: Float[np.ndarray, "N 3"], sensors: Sensors) -> Float[np.ndarray, "N m 3"]:
    """The derivatives of the predicted values by the positions, per m; exact to about 1e-9."""
    sides = ([kind.values_at(positions + way * STEP_M * axis, sensors) for way in (1, -1)] for axis in np.eye(3))
    return np.stack([wrapped(up - down, kind.least) for up, down in sides], axis=-1) / (2.0 * STEP_M)


def _whole(recording: RecordingFolder, kind: Kind) -> Compared:
    """All readings of a table, in its order."""
    rows = recording.rows(kind.name)
    measured = kind.measured(recording.rig, rows)
    tag = rows.of_each(np.arange(len(rows.tags)))
    ids, group = (measured.ids, measured.sensors.number[:, 0]) if kind.sensors else (tuple(rows.tags), tag)
    unknown = np.full((len(tag), 3), np.nan)
    return Compared(
        kind, ids, tuple(rows.tags), measured.columns, group, tag, rows.times, measured.values, unknown,
        measured.sensors, recording.paths,
    )  # fmt: skip


def _of_used(view: Compared, least: int) -> Compared:
    """The readings of groups with so many of them, and these groups alone."""
    enough = np.bincount(view.group, minlength=len(view.ids)) >= least
    view = view.of_rows(enough[view.group])
    # The other sensor of a difference stays in any case.
    used = enough | (np.bincount(view.sensors.number.ravel(), minlength=len(enough)) > 0)
    number, fields = np.cumsum(used) - 1, dict[str, np.ndarray]()
    if view.kind.sensors:
        names = ("places", "axes", "antennas", "wavelengths")
        fields = {name: getattr(view.sensors, name)[used] for name in names} | {"number": number[view.sensors.number]}
    return view.changed(**fields, group=number[view.group])._replace(ids=tuple(compress(view.ids, used)))


def compared(recording: RecordingFolder, table: str) -> Compared | None:
    """The readings of a table beside the truth; None where too few of them have a true position."""
    kind = KINDS[table]
    if kind.predicted is None or not {table, "truth"} <= {*recording.tables}:
        return None
    whole = _whole(recording, kind)
    if kind.difference:
        # Each is one of both its anchors, whichever is the first.
        number = np.concatenate([whole.sensors.number, whole.sensors.number[:, ::-1]])
        twice = {name: np.concatenate([getattr(whole, name)] * 2) for name in ("tag", "times", "positions")}
        values = np.concatenate([whole.values, -whole.values])
        whole = whole.changed(**twice, values=values, number=number, group=number[:, 0])
    order, counts = stable_order(whole.group * len(whole.tags) + whole.tag), np.bincount(whole.group)
    view = whole.of_rows(order[within_groups(counts) % np.repeat(-(-counts // MOST_OF_GROUP), counts) == 0]).later(0.0)
    view = _of_used(view.of_rows(np.isfinite(view.errors()).any(axis=1)), LEAST_OF_GROUP)
    return view if len(view.group) else None


def moments(recording: RecordingFolder, table: str) -> Compared | None:
    """Moments of a table with more readings than a position takes; None with too few, or sensors all at one place."""
    kind = KINDS[table]
    if not (kind.difference or (len(kind.sensors) == 1 and (kind.angles or kind.columns[0].positive))):
        return None
    whole = _whole(recording, kind)
    view = _of_used(whole.of_rows(np.flatnonzero(np.isfinite(whole.values[:MOST_ROWS]).all(axis=1))), 1)
    if not 2 <= len(view.ids) <= MOST_SENSORS or np.linalg.norm(np.ptp(view.sensors.places, axis=0)) < LEAST_EXTENT_M:
        return None
    known = {tag: one.height for tag, one in recording.rig.tags.items() if one.height is not None}
    height, number = np.array([known.get(tag, np.nan) for tag in view.tags]), view.sensors.number
    for span in SPANS_S:
        of_row = {"tag": view.tag, "at": np.floor(view.times / span), "first": number[:, 0], "last": number[:, -1]}
        rows = pl.DataFrame(of_row).with_row_index("row").unique([*of_row], keep="last").sort("tag", "at", "first")
        rows = rows.with_columns(moment=pl.struct("tag", "at").rle_id(), n=pl.len().over("tag", "at"))
        enough = rows.filter(pl.Series(rows["n"].to_numpy() >= needed(kind, height[rows["tag"].to_numpy()])))
        found = enough["moment"].unique().sort().to_numpy()
        if len(found) >= LEAST_MOMENTS and 2 * len(found) > rows["moment"].max():  # type: ignore[operator]
            chosen = found[np.unique(np.linspace(0, len(found) - 1, MOST_MOMENTS).astype(int))]
            part = enough.filter(pl.col("moment").is_in(chosen)).sort("first", "moment")
            moment, heights = np.searchsorted(chosen, part["moment"].to_numpy()), np.zeros(len(chosen))
            heights[moment] = height[part["tag"].to_numpy()]
            return _of_used(view._replace(moment=np.zeros(len(view.tag), int)).of_rows(part["row"].to_numpy())._replace(
                moment=moment, heights=heights), 1)  # fmt: skip
    return None


def needed(kind: Kind, heights: np.ndarray) -> np.ndarray:
    """Of how many sensors, or pairs, moments need readings, so that these can contradict each other."""
    return np.where(np.isnan(heights), 3, 2) + (0 if kind.angles else 3 if kind.difference else 1)


def cauchy_weights(errors: np.ndarray, scale: float | np.ndarray) -> np.ndarray:
    """The weights of errors with this robust standard deviation: a tenth at three of them."""
    return np.asarray(1.0 / (1.0 + (errors / scale) ** 2))


def derivatives(errors: Callable[[np.ndarray], np.ndarray], x: np.ndarray, there: np.ndarray) -> np.ndarray:
    """The derivatives (…, k) of errors (…) by each of the numbers `x` (k,), where they are `there`."""
    return np.stack([(errors(x + 1e-6 * unit) - there) / 1e-6 for unit in np.eye(len(x))], axis=-1)


def robust_fit(
    errors: Callable[[np.ndarray], Float[np.ndarray, "N m"]], start: Float[np.ndarray, " k"], steps: int = 15
) -> tuple[Float[np.ndarray, " k"], float]:
    """The numbers near `start` with the smallest errors, and their median size; errors that are NaN count nothing.

    Levenberg-Marquardt with Cauchy's weights of the errors at each step: scipy's takes twice the time.
    """
    x, damping = np.asarray(start, float), 1e-2
    raw = errors(x).ravel()
    for _ in range(steps):
        e = np.nan_to_num(raw)
        scale = max(1.4826 * float(np.median(np.abs(e))), 1e-9)
        weights = cauchy_weights(e, scale)
        # Where one of the two errors is unknown, as at the first time of the truth, there is no difference.
        J = np.nan_to_num(derivatives(lambda x: errors(x).ravel(), x, raw))
        normal, gradient = (J.T * weights) @ J, (J.T * weights) @ e
        # Damped in proportion to the largest curvature too: a height that is hardly seen would go far in one step.
        ridge = np.diag(np.diag(normal) + 0.1 * np.diag(normal).max() + 1e-12)
        for _ in range(6):
            step = np.linalg.solve(normal + damping * ridge, -gradient)
            trial = errors(x + step).ravel()
            if np.log(cauchy_weights(np.nan_to_num(trial), scale)).sum() > np.log(weights).sum():
                break
            damping *= 10
        else:
            break
        x, raw, damping = x + step, trial, max(damping / 5, 1e-9)
        if np.max(np.abs(step)) < 1e-5:
            break
    return x, float(np.median(np.abs(np.nan_to_num(raw))))

"""Readings of a table as arrays: by stream, beside true positions, or beside those that fit each moment best."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import compress
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from jaxtyping import Bool, Float, Int

from trackwright.trackers.recordings.columns import TruePaths, stable_order, within_groups
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, Kind, Sensors, wrapped

MOST_ROWS, MOST_DIFFERENCES, MOST_OF_GROUP, LEAST_OF_GROUP, MOMENTS = 100_000, 20_000, 500, 12, (15, 60)
"""Most rows of a table and differences of a column; most and least readings of a sensor, and moments, compared."""

LEAST_PAIRS, MANY, LEAST_VALUES, MULTIPLES, NEAR = 50, 0.2, 20, 0.95, 0.02
"""Least pairs that tell of repeats, and the share that is a warning; differences that tell a quantisation step, share
of these that are multiples, and distance from one in steps: one in 25 continuous values is as near."""


class Readings(NamedTuple):
    """The rows of a table, one stream (one tag and one anchor or station) after another, by time.

    `stream` (N,): its number. `values` (N, m): of the `columns`, NaN where one is missing.
    """

    columns: tuple[str, ...]
    stream: Int[np.ndarray, " N"]
    values: Float[np.ndarray, "N m"]


def readings(recording: RecordingFolder, name: str) -> Readings:
    """The readings of a table; of more than `MOST_ROWS`, equally many first ones of each stream."""
    rows = recording.rows(name)
    measured, stream = KINDS[name].measured(recording.rig, rows), rows.of_each(np.arange(len(rows.tags)))
    for number in measured.sensors.number.T:
        stream = stream * len(measured.ids) + number
    order = stable_order(stream)
    if len(order) > MOST_ROWS:
        counts = np.bincount(stream)
        order = order[within_groups(counts) < MOST_ROWS // np.count_nonzero(counts)]
    return Readings(measured.columns, stream[order], measured.values[order])


def known_median(x: Float[np.ndarray, "N m"]) -> Float[np.ndarray, " m"]:
    """The median (m,) of each column without its missing values, NaN without any value."""
    return np.array([np.median(c[~np.isnan(c)]) if not np.isnan(c).all() else np.nan for c in x.T])


def changes(read: Readings) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, "n m"]]:
    """Of each reading but the first: whether it follows the one before in its stream, and the change from it.

    Rows without any value are left out. Where both lack a column its change is zero, where one does infinite.
    """
    seen = np.isfinite(read.values).any(axis=1)
    values, stream = read.values[seen], read.stream[seen]
    missing = np.isnan(values)
    moved = np.where(missing[1:] & missing[:-1], 0.0, wrapped(np.diff(values, axis=0), read.columns))
    return stream[1:] == stream[:-1], np.where(np.isnan(moved), np.inf, moved)


def repeated_share(read: Readings) -> float:
    """The share of the readings with a predecessor in their stream that equal it in all columns; NaN without any."""
    follows, moved = changes(read)
    return float(np.mean((moved[follows] == 0.0).all(axis=1))) if follows.any() else float("nan")


def quantisation_step(read: Readings, column: int) -> float | None:
    """The quantisation step of a column, in its unit; None where its values are not multiples of one."""
    x, stream = read.values[:MOST_DIFFERENCES, column], read.stream[:MOST_DIFFERENCES]
    seen = np.isfinite(x)
    x, stream = x[seen], stream[seen]
    # The offsets of streams may differ, as their wraps may.
    differences = np.abs(wrapped(np.diff(x)[:, None], (read.columns[column],))[:, 0][stream[1:] == stream[:-1]])
    resolution = 1e-12 * (1.0 + np.abs(x).max(initial=0.0))
    differences = differences[differences > resolution]
    if len(differences) < LEAST_VALUES:
        return None
    spacings = np.diff(np.sort(x[stream == np.bincount(stream).argmax()]))
    candidates = np.concatenate([spacings[spacings > resolution], differences])
    # The coarsest first: a few values off the steps, as means of two, are multiples of half a step.
    quantiles = np.quantile(candidates, (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3), method="lower")
    for candidate in np.unique(quantiles)[::-1]:
        multiples = np.round(differences / candidate)
        good = (np.abs(differences / candidate - multiples) < NEAR) & (multiples > 0)
        if good.mean() >= MULTIPLES:
            return float(differences[good].sum() / multiples[good].sum())
    return None


class Compared(NamedTuple):
    """Readings of a table and what predicts them, a group (anchor or station; of fixes, tag) together.

    `group` (N,), not decreasing, and `tag` (N,): numbers in `ids` and in `tags`. A difference is in the groups of both
    its anchors, in the second one's with the other sign. `positions` (N, 3) m: the true ones, or those that fit each
    `moment` (N,) best at its height, m, in `heights`, NaN where that is not known.
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
    moment: Int[np.ndarray, " N"] | Any = None
    heights: Float[np.ndarray, " E"] = np.zeros(0)

    def changed(self, **fields: Any) -> Compared:
        """The same readings with other fields, of these or of the sensors."""
        own = {name: x for name, x in fields.items() if name in self._fields}
        return self._replace(**own, sensors=self.sensors._replace(**{k: x for k, x in fields.items() if k not in own}))

    def of_rows(self, part: Any) -> Compared:
        """Some of the readings, by a mask, a slice or their numbers."""
        names = ("group", "tag", "times", "values", "positions", *(["moment"] if self.moment is not None else []))
        return self.changed(number=self.sensors.number[part], **{name: getattr(self, name)[part] for name in names})

    def thinned(self, most: int) -> Compared:
        """Every k-th reading, at most about `most` in all."""
        return self.of_rows(slice(None, None, -(-len(self.group) // most)))

    def later(self, delay: float) -> Compared:
        """The readings beside the true positions of `delay` seconds before, NaN where there are none."""
        starts = np.concatenate([[0], np.flatnonzero(np.diff(self.tag)) + 1, [len(self.tag)]])
        positions, _ = self.paths.at([self.tags[k] for k in self.tag[starts[:-1]]], starts, self.times - delay)
        return self._replace(positions=positions)

    def errors(self) -> Float[np.ndarray, "N m"]:
        """The differences from the values that the positions imply: see `Kind.errors`."""
        view = self if self.moment is None else self.located()
        return view.kind.errors(view.values, view.positions, view.sensors, view.columns)

    def sizes(self, errors: Float[np.ndarray, "N m"] | None = None, bias: bool = True) -> Float[np.ndarray, "G m"]:
        """The median size of the errors of each group and column, NaN where fewer than half of them are known.

        Less their median, as far as it may be the sensor's own, if it may have a `bias`.
        """
        errors = self.errors() if errors is None else errors
        most, sizes = bias * self.kind.sizes("bias", errors.shape[1]), np.full((len(self.ids), errors.shape[1]), np.nan)
        for k, part in enumerate(np.split(errors, np.searchsorted(self.group, np.arange(1, len(self.ids))))):
            known = 2 * np.isfinite(part).sum(axis=0) >= max(len(part), 1)
            middle = np.clip(known_median(part), -most, most)
            sizes[k] = np.where(known, known_median(np.abs(part - middle)), np.nan)
        return sizes

    def medians(self, errors: Float[np.ndarray, "N m"]) -> Float[np.ndarray, "G m"]:
        """The median error of each group and column.

        Of differences: of each anchor by least squares over the medians of pairs, less what all have in common.
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
        """The readings at the positions that fit each moment best: Gauss-Newton steps, then with Cauchy's weights."""
        free, large = np.isnan(self.heights), self.kind.sizes("large", self.values.shape[1])
        p = np.tile(self.sensors.places.mean(axis=0) - [0.0, 0.0, 1.0], (len(free), 1))
        p[:, 2] = np.where(free, p[:, 2], self.heights)
        allowed = np.stack([np.ones_like(free), np.ones_like(free), free], axis=1)[self.moment]
        longest = float(np.linalg.norm(np.ptp(self.sensors.places, axis=0)))
        for step in range(20):
            view = self._replace(positions=p[self.moment], moment=None)
            at = lambda move, view=view: view._replace(positions=view.positions + 1e-3 * move).errors()  # type: ignore[misc]  # noqa: E731
            e, J = (
                np.nan_to_num(view.errors()),
                np.nan_to_num(np.stack([at(-u) - at(u) for u in np.eye(3)], axis=-1)) / 2e-3,
            )
            w, J = cauchy_weights(e, large) if step >= 8 else np.ones_like(e), J * allowed[:, None]
            normal, side = np.zeros((len(p), 3, 3)), np.zeros((len(p), 3))
            np.add.at(normal, self.moment, np.einsum("nc,nci,ncj->nij", w, J, J))
            np.add.at(side, self.moment, np.einsum("nc,nci,nc->ni", w, J, e))
            ridge = (0.003 * np.trace(normal, axis1=1, axis2=2) + 1e-9)[:, None, None] * np.eye(3)
            move = np.linalg.solve(normal + ridge, side[..., None])[..., 0]
            p = p + move * np.minimum(longest / np.maximum(np.linalg.norm(move, axis=1), 1e-9), 1.0)[:, None]
        return self._replace(positions=p[self.moment])


def _whole(recording: RecordingFolder, kind: Kind) -> Compared:
    """All readings of a table, in its order."""
    rows = recording.rows(kind.name)
    measured, tag = kind.measured(recording.rig, rows), rows.of_each(np.arange(len(rows.tags)))
    ids, group = (measured.ids, measured.sensors.number[:, 0]) if kind.sensors else (tuple(rows.tags), tag)
    unknown, sensors = np.full((len(tag), 3), np.nan), measured.sensors
    values, columns, tags = measured.values, measured.columns, tuple(rows.tags)
    return Compared(kind, ids, tags, columns, group, tag, rows.times, values, unknown, sensors, recording.paths)


def _of_used(view: Compared) -> Compared:
    """The readings of groups with enough of them, and these groups alone."""
    enough = np.bincount(view.group, minlength=len(view.ids)) >= LEAST_OF_GROUP
    view = view.of_rows(enough[view.group])
    # The other sensor of a difference stays in any case.
    used = enough | (np.bincount(view.sensors.number.ravel(), minlength=len(enough)) > 0)
    number = np.cumsum(used) - 1
    if view.kind.sensors:
        names = ("places", "axes", "antennas", "wavelengths")
        fields = {name: getattr(view.sensors, name)[used] for name in names}
        view = view.changed(**fields, number=number[view.sensors.number])
    return view._replace(group=number[view.group], ids=tuple(compress(view.ids, used)))


def compared(recording: RecordingFolder, table: str) -> Compared | None:
    """The readings of a table beside the truth; None where too few of them have a true position."""
    kind = KINDS[table]
    if kind.predicted is None or not {table, "truth"} <= {*recording.tables}:
        return None
    whole = _whole(recording, kind)
    if kind.difference:
        # Each is one of both its anchors, whichever is the first.
        number = np.concatenate([whole.sensors.number, whole.sensors.number[:, ::-1]])
        whole = whole.of_rows(np.tile(np.arange(len(whole.tag)), 2)).changed(number=number)
        whole = whole._replace(values=whole.values * np.repeat([[1], [-1]], len(number) // 2, 0), group=number[:, 0])
    order, counts = stable_order(whole.group * len(whole.tags) + whole.tag), np.bincount(whole.group)
    view = whole.of_rows(order[within_groups(counts) % np.repeat(-(-counts // MOST_OF_GROUP), counts) == 0]).later(0.0)
    view = _of_used(view.of_rows(np.isfinite(view.errors()).any(axis=1)))
    return view if len(view.group) else None


def located(recording: RecordingFolder, table: str) -> Compared | None:
    """Moments of a table with more ranges or bearings than a position takes; None for too few."""
    kind = KINDS[table]
    if len(kind.sensors) != 1 or not (kind.angles or kind.columns[0].positive):
        return None
    whole = _whole(recording, kind)
    view = whole.of_rows(np.flatnonzero(np.isfinite(whole.values[:MOST_ROWS]).all(axis=1)))
    known = {tag: one.height for tag, one in recording.rig.tags.items() if one.height is not None}
    height = np.array([known.get(tag, np.nan) for tag in view.tags])[view.tag]
    least = np.where(np.isnan(height), 3, 2) + (not kind.angles)
    for span in (0.1, 0.25, 0.5, 1.0):
        of_row = {"tag": view.tag, "at": np.floor(view.times / span), "group": view.group, "least": least}
        rows = pl.DataFrame(of_row).with_row_index("row").unique(["tag", "at", "group"], keep="last")
        enough = rows.filter(pl.len().over("tag", "at") >= pl.col("least"))
        found = enough.select("tag", "at").unique().sort("tag", "at").with_row_index("moment")
        if len(found) >= MOMENTS[0] and 2 * len(found) > rows.n_unique(["tag", "at"]):
            part = enough.join(found.gather_every(-(-len(found) // MOMENTS[1])), ["tag", "at"]).sort("group", "moment")
            row, (_, moment) = part["row"].to_numpy(), np.unique(part["moment"].to_numpy(), return_inverse=True)
            heights = np.zeros(moment.max() + 1)
            heights[moment] = height[row]
            return _of_used(view.of_rows(row)._replace(moment=moment, heights=heights))
    return None


def cauchy_weights(errors: np.ndarray, scale: float | np.ndarray) -> np.ndarray:
    """The weights of errors with this robust standard deviation: a tenth at three of them."""
    return np.asarray(1.0 / (1.0 + (errors / scale) ** 2))


def derivatives(errors: Callable[[np.ndarray], np.ndarray], x: np.ndarray, there: np.ndarray) -> np.ndarray:
    """The derivatives (…, k) of errors (…) by each of the numbers `x` (k,), where they are `there`."""
    return np.stack([(errors(x + 1e-6 * unit) - there) / 1e-6 for unit in np.eye(len(x))], axis=-1)


def robust_fit(
    errors: Callable[[np.ndarray], Float[np.ndarray, "N m"]], start: Float[np.ndarray, " k"], steps: int = 15
) -> tuple[Float[np.ndarray, " k"], float]:
    """The numbers near `start` with the smallest errors, and their median size; errors that are NaN count nothing."""
    from scipy.optimize import least_squares

    flat, x = lambda x: errors(x).ravel(), np.asarray(start, float)
    # Where one of the two errors is unknown, as at the first time of the truth, there is no difference.
    slopes = lambda x: np.nan_to_num(derivatives(flat, x, flat(x)))  # noqa: E731
    for _ in range(3):
        scale = max(1.4826 * float(np.median(np.abs(np.nan_to_num(flat(x))))), 1e-9)
        # An error that becomes unknown is no gain.
        known = partial(lambda x, far: np.nan_to_num(flat(x), nan=far), far=3.0 * scale)
        x = least_squares(known, x, slopes, loss="cauchy", f_scale=scale, max_nfev=steps).x
    return x, float(np.median(np.abs(np.nan_to_num(flat(x)))))

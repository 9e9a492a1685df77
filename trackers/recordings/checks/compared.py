"""The readings of a table beside the truth: what predicts each, their errors, and fits that make these small."""

from __future__ import annotations

from collections.abc import Callable
from itertools import compress, pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from trackwright.trackers.recordings.checks.readings import known_median
from trackwright.trackers.recordings.columns import stable_order
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, Kind, Sensors
from trackwright.trackers.recordings.truth import TruePaths

MOST_OF_GROUP = 500
"""Readings of an anchor, station or tag that are compared, evenly spaced in time."""

LEAST_OF_GROUP = 12
"""Least number of readings of an anchor, station or tag."""

STEPS = 15
CUT = 3.0
"""Robust standard deviations at which an error has a tenth of the weight of a small one."""


class Compared(NamedTuple):
    """Readings of a table and what predicts them, a group (anchor or station; of fixes, tag) together.

    `ids`: of the G groups. `group` (N,), not decreasing, `tag` (N,): numbers in `ids` and in `tags`. A difference is
    in the groups of both its anchors, in the second one's with the other sign. `times` (N,) s.
    `values` (N, m): NaN where one is missing. `positions` (N, 3) m: the true ones. `sensors`: of each reading,
    the first of which is the group. `rotations` (G, 4): quaternions of stations. `paths`: the true paths.
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
    rotations: Float[np.ndarray, "G 4"]
    paths: TruePaths

    def changed(self, **fields: np.ndarray) -> Compared:
        """The same readings with other fields, of these or of the sensors."""
        of_view = {name: x for name, x in fields.items() if name in self._fields}
        of_sensors = {name: x for name, x in fields.items() if name not in of_view}
        return self._replace(**of_view, sensors=self.sensors._replace(**of_sensors))  # type: ignore[arg-type]

    def predicted(self) -> Float[np.ndarray, "N m"]:
        """The readings that true positions and geometry imply."""
        return self.kind.values_at(self.positions, self.sensors)

    def errors(self) -> Float[np.ndarray, "N m"]:
        """The differences from the predicted readings: see `Kind.errors`."""
        return self.kind.errors(self.values, self.positions, self.sensors, self.columns)

    def sizes(self, errors: Float[np.ndarray, "N m"] | None = None, bias: bool = True) -> Float[np.ndarray, "G m"]:
        """The median size of the errors of each group and column; NaN where fewer than half of them are known.

        `errors`: by default those against truth. `bias`: less their median, as far as it may be the sensor's own.
        """
        errors = self.errors() if errors is None else errors
        ends = np.searchsorted(self.group, np.arange(len(self.ids) + 1))
        sizes = np.full((len(self.ids), errors.shape[1]), np.nan)
        for column, bound in enumerate(self.kind.sizes("bias", errors.shape[1]) * bias):
            x = errors[:, column]
            for k, (a, b) in enumerate(pairwise(ends)):
                known = x[a:b][np.isfinite(x[a:b])]
                if 2 * len(known) >= max(b - a, 1):
                    middle = min(max(float(np.median(known)), -bound), bound) if bound else 0.0
                    sizes[k, column] = np.median(np.abs(known - middle))
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

    def later(self, delay: float | Float[np.ndarray, " N"], of: Int[np.ndarray, " T"] | None = None) -> Compared:
        """The same readings with the true positions of `delay` seconds before, NaN where there are none.

        `of`: the number of the tag whose path stands for each tag's.
        """
        path = self.tag if of is None else of[self.tag]
        changes = np.flatnonzero(np.diff(path)) + 1
        starts = np.concatenate([[0], changes, [len(path)]])
        positions, _ = self.paths.at([self.tags[k] for k in path[starts[:-1]]], starts, self.times - delay)
        return self._replace(positions=positions)

    def thinned(self, most: int) -> Compared:
        """Every k-th reading of each group, at most about `most` in all."""
        return self.of_rows(slice(None, None, -(-len(self.group) // most)))

    def of_rows(self, part: Any) -> Compared:
        """Some of the readings, by a mask, a slice or their numbers."""
        of_rows = {name: getattr(self, name)[part] for name in ("group", "tag", "times", "values", "positions")}
        return self.changed(**of_rows, number=self.sensors.number[part])


def compared(recording: RecordingFolder, table: str) -> Compared | None:
    """The readings of a table beside the truth; None where too few of them have a true position."""
    kind = KINDS.get(table)
    if kind is None or kind.predicted is None or table not in recording.tables or "truth" not in recording.tables:
        return None
    rows, rig = recording.rows(table), recording.rig
    measured = kind.measured(rig, rows)
    tag = rows.of_each(np.arange(len(rows.tags)))
    ids = measured.ids if kind.sensors else tuple(rows.tags)
    times, values, sensors = rows.times, measured.values, measured.sensors
    if kind.difference:
        # Each is one of both its anchors, whichever is the first.
        tag, times, values = np.tile(tag, 2), np.tile(times, 2), np.concatenate([values, -values])
        sensors = sensors._replace(number=np.concatenate([sensors.number, sensors.number[:, ::-1]]))
    group = sensors.number[:, 0] if kind.sensors else tag
    rotations = np.array([rig.stations[key].rotation for key in ids if kind.noun == "station"], float).reshape(-1, 4)
    whole = Compared(
        kind, ids, tuple(rows.tags), measured.columns, group, tag, times, values,
        np.full((len(tag), 3), np.nan), sensors, rotations, recording.paths,
    )  # fmt: skip
    order = stable_order(group * len(rows.tags) + tag)
    counts = np.bincount(group, minlength=len(ids))
    within = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    view = whole.of_rows(order[within % np.repeat(-(-counts // MOST_OF_GROUP), counts) == 0]).later(0.0)
    known = np.isfinite(view.errors()).any(axis=1)
    enough = np.bincount(view.group[known], minlength=len(ids)) >= LEAST_OF_GROUP
    view = view.of_rows(known & enough[view.group])
    if not len(view.group):
        return None
    # The other sensor of a difference stays in any case.
    used = enough | (np.bincount(view.sensors.number.ravel(), minlength=len(enough)) > 0)
    number = np.cumsum(used) - 1
    of_used = {"group": number[view.group]}
    if kind.sensors:
        of_used |= {name: getattr(sensors, name)[used] for name in ("places", "axes", "antennas", "wavelengths")}
        of_used |= {"number": number[view.sensors.number]}
    if len(rotations):
        of_used["rotations"] = rotations[used]
    return view.changed(**of_used)._replace(ids=tuple(compress(ids, used)))


def cauchy_weights(errors: np.ndarray, scale: float | np.ndarray) -> np.ndarray:
    """The weights of errors with this robust standard deviation; less their logarithm is the loss of each."""
    return np.asarray(1.0 / (1.0 + (errors / (CUT / 3 * scale)) ** 2))


def robust_fit(
    errors: Callable[[np.ndarray], Float[np.ndarray, "N m"]], start: Float[np.ndarray, " k"], steps: int = STEPS
) -> tuple[Float[np.ndarray, " k"], float]:
    """The numbers near `start` with the smallest errors, and their median size; errors that are NaN count nothing.

    Levenberg-Marquardt with Cauchy's weights. Derivatives are differences over 1e-6 of each number's unit.
    """

    x, damping = np.asarray(start, float), 1e-2
    raw = errors(x).ravel()
    for _ in range(steps):
        e = np.nan_to_num(raw)
        scale = max(1.4826 * float(np.median(np.abs(e))), 1e-9)
        weights = cauchy_weights(e, scale)
        # Where one of the two errors is unknown, as at the first time of the truth, there is no difference.
        J = np.nan_to_num(np.stack([(errors(x + 1e-6 * unit).ravel() - raw) / 1e-6 for unit in np.eye(len(x))], axis=1))
        normal, gradient, before = (J.T * weights) @ J, (J.T * weights) @ e, -np.log(weights).sum()
        # Damped in proportion to the largest curvature too: a height that is hardly seen would go far in one step.
        ridge = np.diag(np.diag(normal) + 0.1 * np.diag(normal).max() + 1e-12)
        for _ in range(6):
            step = np.linalg.solve(normal + damping * ridge, -gradient)
            trial = errors(x + step).ravel()
            if -np.log(cauchy_weights(np.nan_to_num(trial), scale)).sum() < before:
                damping = max(damping / 5, 1e-9)
                break
            damping *= 10
        else:
            break
        x, raw = x + step, trial
        if np.max(np.abs(step)) < 1e-5:
            break
    return x, float(np.median(np.abs(np.nan_to_num(raw))))

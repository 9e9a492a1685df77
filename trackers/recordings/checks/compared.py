"""The readings of a table beside the truth: what predicts each of them, their errors, and how large these are."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.recordings.columns import stable_order
from trackwright.trackers.recordings.kinds import KINDS, Kind, Sensors, wrapped
from trackwright.trackers.recordings.truth import TruePaths

if TYPE_CHECKING:  # the folder's module imports `anomalies`
    from trackwright.trackers.recordings.folder import RecordingFolder

MOST_OF_GROUP = 500
"""Readings of an anchor, station or tag that are compared, evenly spaced in time."""

LEAST_OF_GROUP = 12
"""Least number of readings of an anchor, station or tag."""


class Compared(NamedTuple):
    """Readings of a table and what predicts them, those of a group (anchor or station; of fixes, tag) together.

    `ids`: of the G groups. `group` (N,), not decreasing, `tag` (N,): numbers in `ids` and in `tags`. `sensor` (N, k):
    numbers in `ids` of the sensors of each reading, the first of which is the group. `times` (N,) s. `values` (N, m):
    NaN where one is missing. `positions` (N, 3) m: the true ones. `places` (G, 3) m, `rotations` (G, 4) and `axes`
    (G, 3, 3), their matrices: of anchors and stations. `paths`: the true paths. `antennas` (G, m, 2) m, `wavelengths`
    (G,) m: of stations with phases, NaN for antennas that a station lacks.
    """

    kind: Kind
    ids: tuple[str, ...]
    tags: tuple[str, ...]
    columns: tuple[str, ...]
    group: Int[np.ndarray, " N"]
    tag: Int[np.ndarray, " N"]
    sensor: Int[np.ndarray, "N k"]
    times: Float[np.ndarray, " N"]
    values: Float[np.ndarray, "N m"]
    positions: Float[np.ndarray, "N 3"]
    places: Float[np.ndarray, "G 3"]
    rotations: Float[np.ndarray, "G 4"]
    axes: Float[np.ndarray, "G 3 3"]
    paths: TruePaths
    antennas: Float[np.ndarray, "G m 2"]
    wavelengths: Float[np.ndarray, " G"]

    @property
    def table(self) -> str:
        """The name of the table."""
        return self.kind.name

    @property
    def noun(self) -> str:
        """What the groups are."""
        return self.kind.noun

    def predicted(self) -> Float[np.ndarray, "N m"]:
        """The readings that true positions and geometry imply."""
        assert self.kind.predicted is not None
        sensors = Sensors(self.sensor, self.places, self.axes, self.antennas, self.wavelengths)
        return self.kind.predicted(self.positions, sensors)

    def errors(self) -> Float[np.ndarray, "N m"]:
        """The differences from the predicted readings, those of angles in [−π, π); less an offset common to a row."""
        found = self.values - self.predicted()
        if self.kind.common:
            found = found - np.angle(np.nansum(np.exp(1j * found), axis=1, keepdims=True))
        return wrapped(found, self.columns)

    def sizes(self, errors: Float[np.ndarray, "N m"], bias: bool = True) -> Float[np.ndarray, "G m"]:
        """The median size of the errors of each group and column; NaN where fewer than half of them are known.

        `bias`: less their median, as far as it may be the sensor's own.
        """
        ends = np.searchsorted(self.group, np.arange(len(self.ids) + 1))
        found = np.full((len(self.ids), errors.shape[1]), np.nan)
        for column, bound in enumerate(self.kind.sizes("bias", errors.shape[1]) * bias):
            x = errors[:, column]
            for k, (a, b) in enumerate(pairwise(ends)):
                own = x[a:b][np.isfinite(x[a:b])]
                if 2 * len(own) >= max(b - a, 1):
                    middle = min(max(median_of(own), -bound), bound) if bound else 0.0
                    found[k, column] = median_of(np.abs(own - middle))
        return found

    def later(self, delay: float | Float[np.ndarray, " N"], of: Int[np.ndarray, " T"] | None = None) -> Compared:
        """The same readings with the true positions of `delay` seconds before, NaN where there are none.

        `of`: the number of the tag whose path stands for that of each tag.
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
        """Some of the readings, by a mask or a slice."""
        return self._replace(
            group=self.group[part], tag=self.tag[part], sensor=self.sensor[part], times=self.times[part],
            values=self.values[part], positions=self.positions[part],
        )  # fmt: skip


def median_of(x: np.ndarray) -> float:
    """The median of values without NaN, as of `np.median`, which takes three times as long for some hundred of them."""
    half = len(x) // 2
    if len(x) % 2:
        return float(np.partition(x, half)[half])
    low, high = np.partition(x, (half - 1, half))[half - 1 : half + 1]
    return float((low + high) / 2)


def axes_of(rotations: Float[np.ndarray, "G 4"]) -> Float[np.ndarray, "G 3 3"]:
    """The matrices that take array-frame vectors to world-frame vectors, of quaternions w, x, y, z of any length."""
    return rotation_matrices(rotations / np.linalg.norm(rotations, axis=1, keepdims=True))


def compared(recording: RecordingFolder, table: str) -> Compared | None:
    """The readings of a table beside the truth; None where too few of them have a true position."""
    kind = KINDS.get(table)
    if kind is None or kind.predicted is None or table not in recording.tables or "truth" not in recording.tables:
        return None
    rows, rig = recording.rows(table), recording.rig
    columns = kind.layout(recording.tables[table].columns).values
    tag = rows.of_each(np.arange(len(rows.tags)))
    ids = tuple(kind.places(rig)) if kind.sensors else tuple(rows.tags)
    sensor = kind.numbers(rows, ids)
    group = sensor[:, 0] if kind.sensors else tag
    order = stable_order(group * len(rows.tags) + tag)
    counts = np.bincount(group, minlength=len(ids))
    within = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    order = order[within % np.repeat(-(-counts // MOST_OF_GROUP), counts) == 0]
    _, places, axes, antennas, wavelengths = kind.sensors_of(rig, ids, sensor, len(columns))
    rotations = np.tile([1.0, 0.0, 0.0, 0.0], (len(ids), 1))
    if kind.noun == "station":
        rotations = np.stack([np.asarray(rig.stations[key].rotation, float) for key in ids])
    found = Compared(
        kind, ids, tuple(rows.tags), columns, group[order], tag[order], sensor[order], rows.times[order],
        rows.floats(columns)[order], np.full((len(order), 3), np.nan), places, rotations, axes, recording.paths,
        antennas, wavelengths,
    ).later(0.0)  # fmt: skip
    known = np.isfinite(found.errors()).any(axis=1)
    enough = np.bincount(found.group[known], minlength=len(ids)) >= LEAST_OF_GROUP
    found = found.of_rows(known & enough[found.group])
    if not len(found.group):
        return None
    # The other sensor of a difference stays, whether or not it has readings of its own.
    used = enough | (np.bincount(found.sensor.ravel(), minlength=len(ids)) > 0)
    number = np.cumsum(used) - 1
    return found._replace(
        ids=tuple(key for key, ok in zip(ids, used, strict=True) if ok), group=number[found.group],
        sensor=number[found.sensor], places=places[used], rotations=rotations[used], axes=axes[used],
        antennas=antennas[used], wavelengths=wavelengths[used],
    )  # fmt: skip

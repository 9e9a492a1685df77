"""The readings of a table beside the truth: what predicts each of them, their errors, and how large these are."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from trackers.core.rig import rotation_matrices
from trackers.recordings.checks.readings import wrapped
from trackers.recordings.columns import stable_order
from trackers.recordings.tables import layout
from trackers.recordings.truth import TruePaths

if TYPE_CHECKING:  # the folder's module imports `anomalies`
    from trackers.recordings.folder import RecordingFolder

TABLES = ("ranges", "bearings", "fixes", "phases")
"""Tables whose readings truth predicts."""

BIAS = {
    "ranges": (1.0,), "fixes": (0.0, 0.0, 1.0), "bearings": (np.radians(5.0), np.radians(5.0)), "phases": (0.5,),
}  # fmt: skip
"""Bias of each column, or of all, m or rad, up to which it is a property of the sensor and no mistake."""

MOST_OF_GROUP = 500
"""Readings of an anchor, station or tag that are compared, evenly spaced in time."""

LEAST_OF_GROUP = 12
"""Least number of readings of an anchor, station or tag."""


class Compared(NamedTuple):
    """Readings of a table and what predicts them, those of a group (anchor or station; of fixes, tag) together.

    `noun`, `ids`: of the G groups. `group` (N,), not decreasing, `tag` (N,): numbers in `ids` and in `tags`. `times`
    (N,) s. `values` (N, m): NaN where one is missing. `positions` (N, 3) m: the true ones. `places` (G, 3) m,
    `rotations` (G, 4) and `axes` (G, 3, 3), their matrices: of anchors and stations. `paths`: the true paths.
    `antennas` (G, m, 2) m, `wavelengths` (G,) m: of stations with phases, NaN for antennas that a station lacks.
    """

    table: str
    noun: str
    ids: tuple[str, ...]
    tags: tuple[str, ...]
    columns: tuple[str, ...]
    group: Int[np.ndarray, " N"]
    tag: Int[np.ndarray, " N"]
    times: Float[np.ndarray, " N"]
    values: Float[np.ndarray, "N m"]
    positions: Float[np.ndarray, "N 3"]
    places: Float[np.ndarray, "G 3"]
    rotations: Float[np.ndarray, "G 4"]
    axes: Float[np.ndarray, "G 3 3"]
    paths: TruePaths
    antennas: Float[np.ndarray, "G m 2"]
    wavelengths: Float[np.ndarray, " G"]

    def predicted(self) -> Float[np.ndarray, "N m"]:
        """The readings that true positions and geometry imply."""
        if self.table == "fixes":
            return self.positions
        away = self.positions - self.places[self.group]
        if self.table == "ranges":
            return np.sqrt(np.einsum("nd,nd->n", away, away))[:, None]
        x, y, z = np.einsum("ni,nij->jn", away, self.axes[self.group])
        if self.table == "phases":
            p, a = np.stack([x, y], axis=1)[:, None], self.antennas[self.group]
            square = np.einsum("nmd,nmd->nm", a, a)
            along = 2.0 * np.einsum("nmd,nmd->nm", p * np.ones_like(a), a) - square
            far = np.sqrt(x * x + y * y + z * z)[:, None]
            # The distance less that of the antenna, without subtracting the two.
            shorter = along / (far + np.sqrt(np.maximum(far * far - along, 0.0)))
            return 2 * np.pi / self.wavelengths[self.group, None] * shorter
        return np.stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))], axis=1)

    def errors(self) -> Float[np.ndarray, "N m"]:
        """The differences from the predicted readings, those of angles in [−π, π); of phases, less their mean."""
        found = self.values - self.predicted()
        if self.table == "phases":
            found = found - np.angle(np.nansum(np.exp(1j * found), axis=1, keepdims=True))
        return wrapped(found, self.columns)

    def sizes(self, errors: Float[np.ndarray, "N m"], bias: bool = True) -> Float[np.ndarray, "G m"]:
        """The median size of the errors of each group and column; NaN where fewer than half of them are known.

        `bias`: less their median, as far as it is no larger than `BIAS`.
        """
        ends = np.searchsorted(self.group, np.arange(len(self.ids) + 1))
        found = np.full((len(self.ids), errors.shape[1]), np.nan)
        for column, bound in enumerate(np.broadcast_to(BIAS[self.table] if bias else 0.0, errors.shape[1])):
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
            group=self.group[part], tag=self.tag[part], times=self.times[part], values=self.values[part],
            positions=self.positions[part],
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
    if table not in TABLES or table not in recording.tables or "truth" not in recording.tables:
        return None
    rows, rig = recording.rows(table), recording.rig
    tag = np.repeat(np.arange(len(rows.tags)), np.diff(rows.starts))
    if table == "fixes":
        noun, ids, group = "tag", tuple(rows.tags), tag
        columns: tuple[str, ...] = ("x_m", "y_m", "z_m")
    elif table == "ranges":
        noun, ids, columns = "anchor", tuple(rig.anchors), ("range_m",)
    else:
        noun, ids, columns = "station", tuple(rig.stations), layout(table, recording.tables[table].columns).values
    if table != "fixes":
        group = rows.codes(noun, ids).astype(int)
    order = stable_order(group * len(rows.tags) + tag)
    counts = np.bincount(group, minlength=len(ids))
    within = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    order = order[within % np.repeat(-(-counts // MOST_OF_GROUP), counts) == 0]
    values = rows.floats(columns)[order]
    places, rotations = np.zeros((len(ids), 3)), np.tile([1.0, 0.0, 0.0, 0.0], (len(ids), 1))
    if table == "ranges":
        places = np.stack([np.asarray(rig.anchors[key], float) for key in ids])
    elif table != "fixes":
        places = np.stack([np.asarray(rig.stations[key].position, float) for key in ids])
        rotations = np.stack([np.asarray(rig.stations[key].rotation, float) for key in ids])
    antennas, wavelengths = np.full((len(ids), len(columns), 2), np.nan), np.ones(len(ids))
    for k, station in enumerate(rig.stations.values() if table == "phases" else ()):
        if station.antennas is not None and station.wavelength is not None:
            antennas[k, : len(station.antennas)], wavelengths[k] = station.antennas, station.wavelength
    found = Compared(
        table, noun, ids, tuple(rows.tags), columns, group[order], tag[order], rows.times[order], values,
        np.full((len(order), 3), np.nan), places, rotations, axes_of(rotations), recording.paths,
        antennas, wavelengths,
    ).later(0.0)  # fmt: skip
    known = np.isfinite(found.errors()).any(axis=1)
    enough = np.bincount(found.group[known], minlength=len(ids)) >= LEAST_OF_GROUP
    kept = known & enough[found.group]
    if not kept.any():
        return None
    number = np.cumsum(enough) - 1
    return found._replace(
        ids=tuple(key for key, ok in zip(ids, enough, strict=True) if ok), group=number[found.group[kept]],
        tag=found.tag[kept], times=found.times[kept], values=found.values[kept], positions=found.positions[kept],
        places=places[enough], rotations=rotations[enough], axes=found.axes[enough],
        antennas=antennas[enough], wavelengths=wavelengths[enough],
    )  # fmt: skip

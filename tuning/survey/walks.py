"""Walks: the readings of a tag on its way, and its path as a spline with white acceleration.

The spline is cubic, with knots every `STEP` s. Its prior density, exp(−½∫|x''|²dt / q), is that of white acceleration
of spectral density q, m²/s³. Each reading depends on four neighbouring coefficients: matrices of a path are banded.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Int

from trackwright.trackers.recordings.columns import TagRows
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS

STEP = 0.25
"""Interval of the knots of a path, s: a person or a drone turns more slowly."""

AVERAGE = 0.1
"""Interval, s, over which ranges to an anchor are averaged: a tag moves on a line meanwhile, and errors last longer."""

GAP = 5.0
"""Time without a range, s, after which a path begins anew."""

LEVEL = 0.1
"""Distance, m, from the height of a walk below which an anchor counts as at it."""

LEAST_RANGES = 20
"""Ranges below which a piece of a walk between gaps is left out."""


@dataclass(frozen=True, eq=False)
class Walk(ABC):
    """n readings of a tag between gaps: `times` s and `values`, m or rad (n,).

    `height`: of the tag, m, where it is known and constant; its path then has two coordinates instead of three.
    `least_scale`: smallest scale of errors, about the resolution of the readings.
    """

    recording: str
    tag: str
    times: Float[np.ndarray, " n"]
    values: Float[np.ndarray, " n"]
    height: float | None

    least_scale: ClassVar[float]

    @property
    @abstractmethod
    def levels(self) -> Int[np.ndarray, "n e"]:
        """The numbers of the scales of errors that add up, by their squares, to that of each reading."""

    @abstractmethod
    def residuals(self, sensors: Float[np.ndarray, "S w"], path: Float[np.ndarray, "knots d"]) -> np.ndarray:
        """The readings (n,) less those without errors, by the unknowns of anchors or stations and the path."""

    @abstractmethod
    def linearised(
        self, sensors: Float[np.ndarray, "S w"], path: Float[np.ndarray, "knots d"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n U"]]:
        """The residuals, and the derivatives of the readings by the tag's position and by all unknowns `sensors`."""

    @property
    def dimensions(self) -> int:
        """The coordinates of the path that are estimated."""
        return 3 if self.height is None else 2

    @cached_property
    def basis(self) -> sparse.csr_array:
        """The weights (n, knots) of the coefficients of a coordinate in its values at the times of the ranges."""
        at = (self.times - self.times[0]) / STEP
        first = at.astype(int)
        u = at - first
        weights = np.stack([(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3], axis=1) / 6
        row = np.repeat(np.arange(len(at)), 4)
        return sparse.csr_array((weights.ravel(), (row, (first[:, None] + np.arange(4)).ravel())))

    @cached_property
    def roughness(self) -> sparse.csr_array:
        """The matrix (knots · dimensions, …) whose quadratic form of the coefficients is ∫|x''|²dt."""
        knots = self.basis.shape[1]
        second = sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(knots - 2, knots))
        return sparse.csr_array(sparse.kron(second.T @ second / STEP**3, sparse.eye_array(self.dimensions)))

    def rough(self, density: float | Float[np.ndarray, " 3"]) -> sparse.csr_array:
        """The information, m⁻², of a path of these accelerations, m²/s³: the same along all axes, or one of each."""
        if np.ndim(density) == 0:
            return self.roughness / density
        by_axis = np.tile(1.0 / np.asarray(density)[: self.dimensions], self.basis.shape[1])
        return sparse.csr_array(self.roughness.multiply(by_axis[:, None]))

    def positions(self, coefficients: Float[np.ndarray, "knots d"]) -> Float[np.ndarray, "n 3"]:
        """The positions of the tag, m, at the times of the ranges."""
        path = self.basis @ coefficients
        return path if self.height is None else np.column_stack([path, np.full(len(path), self.height)])

    def along(self, units: Float[np.ndarray, "n 3"]) -> sparse.csr_array:
        """The derivatives (n, knots · dimensions) of the readings by the coefficients; `units`: by the position."""
        d = self.dimensions
        weights, knot = self.basis.data.reshape(-1, 4), self.basis.indices.reshape(-1, 4)
        values = weights[:, :, None] * units[:, None, :d]
        column = d * knot[:, :, None] + np.arange(d)
        ends = np.arange(0, values.size + 1, 4 * d)
        return sparse.csr_array((values.ravel(), column.ravel(), ends), shape=(len(values), d * self.basis.shape[1]))

    def fitted(self, positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "knots d"]:
        """The coefficients of a smooth path near these positions at the times of the ranges."""
        system = self.basis.T @ self.basis + sparse.csr_array(self.roughness[:: self.dimensions, :: self.dimensions])
        # A little of the identity for knots without ranges beside them.
        system = system + 1e-9 * sparse.eye_array(system.shape[0])
        return sparse.linalg.spsolve(sparse.csc_array(system), self.basis.T @ positions[:, : self.dimensions])


@dataclass(frozen=True, eq=False)
class RangeWalk(Walk):
    """Ranges, or range differences: the numbers of the `anchor` of each, and of the `second`, which is subtracted.

    The unknowns of an anchor are its position and its delay, m.
    """

    anchor: Int[np.ndarray, " n"]
    second: Int[np.ndarray, " n"] | None = None

    least_scale = 0.01

    @property
    def levels(self) -> Int[np.ndarray, "n e"]:
        """The numbers of the anchors of each reading, whose distances are added, and subtracted, by `signs`."""
        return self.anchor[:, None] if self.second is None else np.stack([self.anchor, self.second], axis=1)

    @property
    def signs(self) -> Float[np.ndarray, " e"]:
        """1, and of range differences −1."""
        return np.array([1.0]) if self.second is None else np.array([1.0, -1.0])

    def residuals(self, sensors: Float[np.ndarray, "S 4"], path: Float[np.ndarray, "knots d"]) -> np.ndarray:
        return self._offsets(sensors, path)[0]

    def linearised(
        self, sensors: Float[np.ndarray, "S 4"], path: Float[np.ndarray, "knots d"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n U"]]:
        residuals, offset, distance = self._offsets(sensors, path)
        units = offset / distance[..., None] * self.signs[:, None]
        partial = np.zeros((len(units), len(sensors), 4))
        rows = np.arange(len(units))[:, None]
        partial[rows, self.levels, :3], partial[rows, self.levels, 3] = -units, self.signs
        return residuals, units.sum(axis=1), partial.reshape(len(units), -1)

    def _offsets(self, sensors: np.ndarray, path: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The residuals (n,), and the offsets (n, e, 3) and distances (n, e), m, of the tag from each anchor."""
        offset = self.positions(path)[:, None] - sensors[self.levels, :3]
        distance = np.maximum(np.sqrt((offset**2).sum(axis=-1)), 1e-9)
        return self.values - (distance + sensors[self.levels, 3]) @ self.signs, offset, distance


def common_height(walks: Sequence[Walk]) -> float | None:
    """The height, m, that is known of all walks; None where they have several or one is not known."""
    heights = {walk.height for walk in walks}
    return heights.pop() if len(heights) == 1 else None


def walks_of(
    folders: Sequence[RecordingFolder], anchors: Sequence[str], height: float | None, table: str = "ranges"
) -> list[RangeWalk]:
    """The walks of all tags to anchors of these ids, by ranges or `tdoa`; `height`: of all, m, else those in rigs."""
    walks, (column, *_) = [], KINDS[table].layout(()).values
    for folder in folders:
        rows = folder.rows(table, AVERAGE)
        values, number = rows.floats([column])[:, 0], rows.codes("anchor", anchors)
        second = rows.codes("anchor_2", anchors) if KINDS[table].difference else None
        usable = np.isfinite(values) if second is not None else values > 0.0
        walks += [
            RangeWalk(folder.name, tag, rows.times[piece], values[piece], known, number[piece],
                      None if second is None else second[piece])
            for tag, known, piece in pieces(folder, rows, usable, height)
        ]  # fmt: skip
    return walks


def pieces(
    folder: RecordingFolder, rows: TagRows, usable: Bool[np.ndarray, " N"], height: float | None
) -> Iterator[tuple[str, float | None, Int[np.ndarray, " n"]]]:
    """The tag of each piece between gaps, its height, m, if known, and the rows; `height`: of all, else the rig's."""
    for k, tag in enumerate(rows.tags):
        known = folder.rig.tags[tag].height if height is None and tag in folder.rig.tags else height
        of_tag = np.arange(rows.starts[k], rows.starts[k + 1])
        of_tag = of_tag[usable[of_tag]]
        for piece in np.split(of_tag, np.flatnonzero(np.diff(rows.times[of_tag]) > GAP) + 1):
            if len(piece) >= LEAST_RANGES:
                yield tag, known, piece

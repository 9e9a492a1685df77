"""Walks: the ranges of a tag on its way, and its path as a spline with white acceleration.

The spline is cubic, with knots every `STEP` s. Its prior density, exp(−½∫|x''|²dt / q), is that of white acceleration
of spectral density q, m²/s³. Each range depends on four neighbouring coefficients: matrices of a path are banded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Int

from trackwright.trackers.recordings.folder import RecordingFolder

STEP, AVERAGE, GAP = 0.25, 0.1, 5.0
"""Times, s: between knots of a path, over which ranges to an anchor are averaged, after which a path begins anew."""

LEVEL, LEAST_SCALE, LEAST_RANGES = 0.1, 0.01, 20
"""Distance, m, at which an anchor counts as at the height of a walk; least scale of errors, m; ranges of a walk."""


@dataclass(frozen=True, eq=False)
class Walk:
    """n ranges of a tag between gaps: `times` s, `values` m, `anchor` numbers (n,); the `height` that is known, m."""

    recording: str
    tag: str
    times: Float[np.ndarray, " n"]
    values: Float[np.ndarray, " n"]
    height: float | None
    anchor: Int[np.ndarray, " n"]

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
    def bending(self) -> sparse.csr_array:
        """The matrix (knots · dimensions, …) by which, transposed, the square of the coefficients is ∫|x''|²dt."""
        knots = self.basis.shape[1]
        second = sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, -1, -2], shape=(knots, knots - 2)) / STEP**1.5
        return sparse.csr_array(sparse.kron(second, sparse.eye_array(self.dimensions)))

    def positions(self, coefficients: Float[np.ndarray, "knots d"]) -> Float[np.ndarray, "n 3"]:
        """The positions of the tag, m, at the times of the ranges."""
        path = self.basis @ coefficients
        return path if self.height is None else np.column_stack([path, np.full(len(path), self.height)])

    def fitted(self, positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "knots d"]:
        """The coefficients of a smooth path near these positions at the times of the ranges."""
        bending = self.bending[:: self.dimensions, :: self.dimensions]
        # A little of the identity for knots without ranges beside them.
        system = self.basis.T @ self.basis + bending @ bending.T + 1e-9 * sparse.eye_array(bending.shape[0])
        return sparse.linalg.spsolve(sparse.csc_array(system), self.basis.T @ positions[:, : self.dimensions])

    def residuals(self, anchors: np.ndarray, path: np.ndarray) -> np.ndarray:
        """How much longer the ranges (n,), m, are than those to anchors (A, 4) with delays from a path (knots, d)."""
        offset = self.positions(path) - anchors[self.anchor, :3]
        return self.values - np.linalg.norm(offset, axis=1) - anchors[self.anchor, 3]

    def linearised(self, anchors: np.ndarray, path: np.ndarray) -> tuple[np.ndarray, np.ndarray, sparse.csr_array]:
        """The residuals (n,), m, and the derivatives by anchors (n, 4A) and by coefficients (n, knots · d)."""
        offset = self.positions(path) - anchors[self.anchor, :3]
        units, rows = offset / np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-9), np.arange(len(offset))
        partial = np.zeros((len(rows), len(anchors), 4))
        partial[rows, self.anchor] = np.column_stack([-units, np.ones(len(rows))])
        d, ends = self.dimensions, 4 * self.dimensions * np.arange(len(rows) + 1)
        values = self.basis.data.reshape(-1, 4, 1) * units[:, None, :d]
        column = d * self.basis.indices.reshape(-1, 4, 1) + np.arange(d)
        along = sparse.csr_array((values.ravel(), column.ravel(), ends), shape=(len(rows), d * self.basis.shape[1]))
        return self.residuals(anchors, path), partial.reshape(len(rows), -1), along


def walks_of(folders: Sequence[RecordingFolder], anchors: Sequence[str], height: float | None) -> list[Walk]:
    """The walks of all tags to anchors of these ids; `height`: of all tags, m, else those in rigs."""
    walks = []
    for folder in folders:
        rows = folder.rows("ranges", AVERAGE)
        values, number = rows.floats(["range_m"])[:, 0], rows.codes("anchor", anchors)
        for k, tag in enumerate(rows.tags):
            known = folder.rig.tags[tag].height if height is None and tag in folder.rig.tags else height
            of_tag = rows.starts[k] + np.flatnonzero(values[rows.starts[k] : rows.starts[k + 1]] > 0.0)
            walks += [
                Walk(folder.name, tag, rows.times[piece], values[piece], known, number[piece])
                for piece in np.split(of_tag, np.flatnonzero(np.diff(rows.times[of_tag]) > GAP) + 1)
                if len(piece) >= LEAST_RANGES
            ]
    return walks

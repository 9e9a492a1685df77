"""Walks: the ranges of tags on their way, and their paths as splines with white acceleration.

A spline is cubic, with knots every `STEP` s. Its prior density, exp(−½∫|x''|²dt / q), is that of white acceleration
of spectral density q, m²/s³. Each range depends on four neighbouring coefficients: matrices of a path are banded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Int

from trackwright.trackers.recordings.folder import RecordingFolder

STEP, AVERAGE, GAP = 0.25, 0.1, 5.0
"""Times, s: between knots of a path, over which ranges to an anchor are averaged, after which a path begins anew."""

LEVEL, LEAST_SCALE, LEAST_RANGES = 0.1, 0.01, 20
"""Distance, m, at which an anchor counts as at the height of a walk; least scale of errors, m; ranges of a walk."""


@dataclass(frozen=True, eq=False)
class Walks:
    """n ranges on W walks between gaps: the numbers of `walk` and `anchor`, `times`, s, and `values`, m (n,); whose
    walks these are, and the `heights` of their tags, m, NaN: estimated. Paths have coefficients (knots, 3), m."""

    names: Sequence[str]
    heights: Float[np.ndarray, " W"]
    walk: Int[np.ndarray, " n"]
    anchor: Int[np.ndarray, " n"]
    times: Float[np.ndarray, " n"]
    values: Float[np.ndarray, " n"]

    def only(self, k: int) -> Walks:
        """Walk number `k` alone."""
        own = self.walk == k
        rows = (column[own] for column in (self.anchor, self.times, self.values))
        return Walks(self.names[k : k + 1], self.heights[k : k + 1], 0 * self.walk[own], *rows)

    @cached_property
    def _spline(self) -> tuple[sparse.csr_array, Int[np.ndarray, " knots"]]:
        """The weights (n, knots) of the coefficients of a coordinate at the times of the ranges; the walks of knots."""
        begins = np.searchsorted(self.walk, np.arange(len(self.heights)))
        at = (self.times - self.times[begins][self.walk]) / STEP
        first = at.astype(int)
        knots = np.repeat(np.arange(len(begins)), np.maximum.reduceat(first, begins) + 4)
        column, u = first + np.searchsorted(knots, self.walk), at - first
        weights = np.stack([(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3], axis=1) / 6
        row = np.repeat(np.arange(len(at)), 4)
        return sparse.csr_array((weights.ravel(), (row, (column[:, None] + np.arange(4)).ravel()))), knots

    @cached_property
    def free(self) -> Bool[np.ndarray, " coefficients"]:
        """Which coefficients are estimated: M of them, all but known heights."""
        return np.isnan(np.pad(self.heights[self._spline[1], None], ((0, 0), (2, 0)), constant_values=np.nan)).ravel()

    @cached_property
    def spread(self) -> sparse.csr_array:
        """The derivatives (3n, M) of positions by the coefficients that are estimated."""
        return sparse.csr_array(sparse.kron(self._spline[0], sparse.eye_array(3), "csc")[:, self.free])

    @cached_property
    def bending(self) -> tuple[sparse.csr_array, Int[np.ndarray, " bends"]]:
        """The matrix (M, bends) by which, transposed, the square of the coefficients is ∫|x''|²dt; the bends' walks."""
        walk = np.repeat(self._spline[1], 3)
        second = sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, -3, -6], shape=(len(walk), len(walk) - 6))
        inside = self.free[:-6] & (walk[:-6] == walk[6:])
        return sparse.csr_array(second.tocsr()[self.free][:, inside] / STEP**1.5), walk[:-6][inside]

    def positions(self, path: Float[np.ndarray, "knots 3"]) -> Float[np.ndarray, "n 3"]:
        """The positions of the tags, m, at the times of the ranges."""
        at, heights = self._spline[0] @ path, self.heights[self.walk]
        at[:, 2] = np.where(np.isnan(heights), at[:, 2], heights)
        return at

    def fitted(self, positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "knots 3"]:
        """The coefficients of smooth paths near these positions at the times of the ranges."""
        path, bending = np.repeat(self.heights[self._spline[1]], 3), self.bending[0]
        # A little of the identity for knots without ranges beside them.
        system = self.spread.T @ self.spread + bending @ bending.T + 1e-9 * sparse.eye_array(bending.shape[0])
        path[self.free] = sparse.linalg.spsolve(sparse.csc_array(system), self.spread.T @ positions.ravel())
        return path.reshape(-1, 3)


def walks_of(folders: Sequence[RecordingFolder], anchors: Sequence[str], height: float | None) -> Walks:
    """The walks of all tags to anchors of these ids; `height`: of all tags, m, else those in rigs."""
    names, heights, pieces = list[str](), list[float](), [np.empty((0, 4))]
    for folder in folders:
        rows = folder.rows("ranges", AVERAGE)
        table = np.column_stack([rows.codes("anchor", anchors), rows.times, rows.floats(["range_m"])[:, 0]])
        for tag, of_tag in zip(rows.tags, np.split(table, rows.starts[1:-1]), strict=True):
            known = folder.rig.tags[tag].height if height is None and tag in folder.rig.tags else height
            ranged = of_tag[of_tag[:, 2] > 0.0]
            for piece in np.split(ranged, np.flatnonzero(np.diff(ranged[:, 1]) > GAP) + 1):
                if len(piece) >= LEAST_RANGES:
                    pieces.append(np.insert(piece, 0, len(names), axis=1))
                    names.append(f"tag {tag} of {folder.name}")
                    heights.append(np.nan if known is None else known)
    walk, anchor, times, values = np.concatenate(pieces).T
    return Walks(names, np.array(heights), walk.astype(int), anchor.astype(int), times, values)

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

LEAST_SCALE = 0.01
"""Smallest scale of errors, m, about the resolution of ranges."""


@dataclass(frozen=True, eq=False)
class Walk:
    """n ranges of a tag between gaps: `times` s, `values` m, and the numbers of the `anchor` of each (n,).

    `height`: of the tag, m, where it is known and constant; its path then has two coordinates instead of three.
    """

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
    def roughness(self) -> sparse.csr_array:
        """The matrix (knots · dimensions, …) whose quadratic form of the coefficients is ∫|x''|²dt."""
        knots = self.basis.shape[1]
        second = sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(knots - 2, knots))
        return sparse.csr_array(sparse.kron(second.T @ second / STEP**3, sparse.eye_array(self.dimensions)))

    def positions(self, coefficients: Float[np.ndarray, "knots d"]) -> Float[np.ndarray, "n 3"]:
        """The positions of the tag, m, at the times of the ranges."""
        path = self.basis @ coefficients
        return path if self.height is None else np.column_stack([path, np.full(len(path), self.height)])

    def along(self, units: Float[np.ndarray, "n 3"]) -> sparse.csr_array:
        """The derivatives (n, knots · dimensions) of the ranges by the coefficients; `units`: by the position."""
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

    def linearised(self, anchors: np.ndarray, path: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The residuals (n,), m, and the derivatives of ranges by the position (n, 3) and by the unknowns (n, 4A).

        `anchors` (A, 4): positions and delays, m; `path`: its coefficients.
        """
        offset = self.positions(path) - anchors[self.anchor, :3]
        distance = np.maximum(np.sqrt((offset**2).sum(axis=1)), 1e-9)
        units, partial = offset / distance[:, None], np.zeros((len(offset), len(anchors), 4))
        partial[np.arange(len(units)), self.anchor] = np.column_stack([-units, np.ones(len(units))])
        return self.values - (distance + anchors[self.anchor, 3]), units, partial.reshape(len(units), -1)


def common_height(walks: Sequence[Walk]) -> float | None:
    """The height, m, that is known of all walks; None where they have several or one is not known."""
    heights = {walk.height for walk in walks}
    return heights.pop() if len(heights) == 1 else None


def walks_of(folders: Sequence[RecordingFolder], anchors: Sequence[str], height: float | None) -> list[Walk]:
    """The walks of all tags to anchors of these ids; `height`: of all tags, m, else those in rigs."""
    walks = []
    for folder in folders:
        rows = folder.rows("ranges", AVERAGE)
        values, number = rows.floats(["range_m"])[:, 0], rows.codes("anchor", anchors)
        for k, tag in enumerate(rows.tags):
            known = folder.rig.tags[tag].height if height is None and tag in folder.rig.tags else height
            of_tag = np.arange(rows.starts[k], rows.starts[k + 1])
            of_tag = of_tag[values[of_tag] > 0.0]
            walks += [
                Walk(folder.name, tag, rows.times[piece], values[piece], known, number[piece])
                for piece in np.split(of_tag, np.flatnonzero(np.diff(rows.times[of_tag]) > GAP) + 1)
                if len(piece) >= LEAST_RANGES
            ]
    return walks

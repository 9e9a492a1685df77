"""Estimates: what every tracker returns, on the host, ready for metrics, reports and the next tracker."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import jax
import numpy as np

from trackers.core.algebra import dense, triangle
from trackers.core.state import component_names


class Status(IntEnum):
    """What a row of a trajectory is."""

    OK = 0
    WAITING = 1
    RESTARTED = 2
    LOST = 3
    NON_FINITE = 4
    PADDING = 5


@dataclass(frozen=True)
class Estimates:
    """A tracker's output for one recording (arrays start with T) or a batch (with B, T).

    `mean`: the state, one array per named component. `cov_upper`: (n(n+1)/2, …, T), the covariance of the small step
    about the mean, upper triangle row by row. `log_likelihood`, `nis`, `count` (degrees of freedom of the NIS),
    `wrapped` (readings whose wrapping was ambiguous): per row, summed over sensors. `status`: `Status` codes.
    `example`: a state of plain numbers that tells the names.
    """

    mean: Any
    cov_upper: np.ndarray
    log_likelihood: np.ndarray
    nis: np.ndarray
    count: np.ndarray
    wrapped: np.ndarray
    status: np.ndarray

    @property
    def dimension(self) -> int:
        """The size of the covariance."""
        return int((np.sqrt(8 * len(self.cov_upper) + 1) - 1) / 2)

    @property
    def covariance(self) -> np.ndarray:
        """The covariances as (…, T, n, n)."""
        return dense(list(self.cov_upper), self.dimension, np.stack)

    @property
    def sigmas(self) -> dict[str, np.ndarray]:
        """The standard deviation of each component of the state, by name."""
        position = {pair: k for k, pair in enumerate(triangle(self.dimension))}
        scalar_state = jax.tree_util.tree_map(lambda x: np.zeros(np.shape(x)[self.status.ndim :]), self.mean)
        return {
            name: np.sqrt(np.maximum(self.cov_upper[position[i, i]], 0))
            for i, name in enumerate(component_names(scalar_state))
        }

    @property
    def usable(self) -> np.ndarray:
        """Where there is an estimate: rows that are neither padding, waiting nor non-finite."""
        return ~np.isin(self.status, (Status.PADDING, Status.WAITING, Status.NON_FINITE))

    def __getitem__(self, trajectory: Any) -> Estimates:
        """One trajectory of a batch, or a slice of them."""
        return Estimates(
            jax.tree_util.tree_map(lambda x: x[trajectory], self.mean),
            self.cov_upper[:, trajectory],
            *(getattr(self, k)[trajectory] for k in ("log_likelihood", "nis", "count", "wrapped", "status")),
        )

    def verdict(self) -> str:
        """One sentence on a single trajectory: ok, lost and re-started, non-finite at row k, or too little data."""
        status = self.status[self.status != Status.PADDING]
        if np.all(status == Status.WAITING):
            return "too little data: no row could start the tracker"
        bad = np.flatnonzero(status == Status.NON_FINITE)
        if len(bad):
            return f"non-finite at row {bad[0]}"
        restarts = int(np.sum(status == Status.RESTARTED))
        if restarts or np.any(status == Status.LOST):
            return f"lost and re-started {restarts} times" if restarts else "lost and never re-started"
        return "ok"

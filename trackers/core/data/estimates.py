"""Estimates: the result of a tracker's run, as NumPy arrays for metrics, reports and the next tracker."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import jax
import numpy as np
import polars as pl
from jaxtyping import Bool, Float, Int, Num

from trackwright.trackers.core.data.frames import estimates_html, to_pandas
from trackwright.trackers.core.errors import UnusableInput, numbered_names
from trackwright.trackers.core.model.algebra import dense, triangle
from trackwright.trackers.core.model.state import component_names, path_name


class Status(IntEnum):
    """The status of an estimate.

    OK: a track is running. WAITING: no track yet. RESTARTED: a new track starts here after a loss. LOST: the track is
    lost and none has started since; the estimate is its last one. NON_FINITE: numerical failure. PADDING: beyond the
    end of the recording.
    """

    OK = 0
    WAITING = 1
    RESTARTED = 2
    LOST = 3
    NON_FINITE = 4
    PADDING = 5


AXES = "xyz"

STATUS_WORDS = {
    Status.OK: "ok",
    Status.WAITING: "waiting",
    Status.RESTARTED: "restarted",
    Status.LOST: "lost",
    Status.NON_FINITE: "non-finite",
}

# The attributes of `Estimates` with a number for each row.
ROWS = ("log_likelihood", "nis", "nis_dof", "wrapped", "status", "times", "age")
# Columns of tables of estimates: attributes of `Estimates`, summed over the rows of a time.
STEP_COLUMNS = ("nis", "nis_dof", "log_likelihood")


def is_usable(status: Int[Any, "*rows"]) -> Bool[Any, "*rows"]:
    """The mask of `Status` codes of rows with an estimate: neither padding, waiting nor non-finite."""
    return (status == Status.OK) | (status == Status.RESTARTED) | (status == Status.LOST)


@dataclass(frozen=True, repr=False)
class Estimates:
    """The estimates of one recording (arrays start with T) or of several (with B, T).

    `mean`: the state, one array per named component. `cov_upper`: (n(n+1)/2, …, T), the covariance of the small step
    about the mean, upper triangle row by row; of the n leading components where n is less than the state's size.
    `log_likelihood`, `nis`, `nis_dof` (its degrees of freedom), `wrapped` (number of ambiguous angle wraps): per row,
    summed over sensors. `status`: `Status` codes. `age`: time from an estimate's validity to its row, s; None where
    they coincide. `times`: (T,) or (B, T) s, at which the estimates are valid, NaN in padding. `names`: of the
    recordings. `final`: the state after their last rows, `initial` of a run that continues. After a run of a `Batch`
    the last three are empty.
    """

    mean: Any
    cov_upper: Float[np.ndarray, "entries *rows"]
    log_likelihood: Float[np.ndarray, "*rows"]
    nis: Float[np.ndarray, "*rows"]
    nis_dof: Float[np.ndarray, "*rows"]
    wrapped: Num[np.ndarray, "*rows"]
    status: Int[np.ndarray, "*rows"]
    times: Float[np.ndarray, "*rows"] | None = None
    names: tuple[str, ...] = ()
    age: Float[np.ndarray, "*rows"] | None = None
    final: Any = None

    @property
    def dimension(self) -> int:
        """The size of the covariance."""
        return int((np.sqrt(8 * len(self.cov_upper) + 1) - 1) / 2)

    @property
    def covariance(self) -> Float[np.ndarray, "*rows n n"]:
        """The covariances as (…, T, n, n)."""
        return dense(list(self.cov_upper), self.dimension, np.stack)

    @property
    def sigmas(self) -> dict[str, Float[np.ndarray, "*rows"]]:
        """The standard deviation of each component of the state that has one, by name."""
        position = {pair: k for k, pair in enumerate(triangle(self.dimension))}
        return {
            name: np.sqrt(np.maximum(self.cov_upper[position[i, i]], 0))
            for i, name in enumerate(component_names(self._scalar_state)[: self.dimension])
        }

    @property
    def _scalar_state(self) -> Any:
        """A state of one row, for the names of its components."""
        return jax.tree_util.tree_map(lambda x: np.zeros(np.shape(x)[self.status.ndim :]), self.mean)

    @property
    def usable(self) -> Bool[np.ndarray, "*rows"]:
        """Rows with an estimate: neither padding, waiting nor non-finite."""
        return is_usable(self.status)

    def valid_times(self, times: Float[np.ndarray, "*rows"]) -> Float[np.ndarray, "*rows"]:
        """The times at which the estimates of rows at `times`, s, are valid."""
        return times if self.age is None else times - self.age

    def __getitem__(self, trajectory: Any) -> Estimates:
        """One trajectory of a batch, or a slice of them."""
        single = isinstance(trajectory, (int, np.integer))
        several = slice(trajectory, trajectory + 1 or None) if single else trajectory
        return replace(
            self._part((trajectory,)),
            names=tuple(np.array(self.names)[several].tolist()) if self.names else (),
            final=jax.tree_util.tree_map(lambda x: x[several], self.final),
        )

    def rows(self, part: slice) -> Estimates:
        """A slice of the rows of every trajectory."""
        return self._part((..., part))

    def _part(self, index: tuple[Any, ...]) -> Estimates:
        """The same part of every array over trajectories and rows."""

        def part(rows: Any) -> Any:
            return None if rows is None else rows[index]

        rows = {name: part(getattr(self, name)) for name in ROWS}
        mean, cov_upper = jax.tree_util.tree_map(part, self.mean), self.cov_upper[(slice(None), *index)]
        return replace(self, mean=mean, cov_upper=cov_upper, **rows)

    def __repr__(self) -> str:
        shape = " x ".join(
            f"{n} {what}" for n, what in zip(self.status.shape[::-1], ("rows", "trajectories"), strict=False)
        )
        return f"<Estimates: {shape}; state {', '.join(self.sigmas)}>"

    _repr_html_ = estimates_html

    def marginal(self, field: str) -> Float[np.ndarray, "*rows k k"]:
        """The covariances (…, T, k, k) of one field of the state, as `position`, in the order of its components.

        Raises KeyError, naming the fields, where the state has no such field.
        """
        return np.stack([np.stack(row, axis=-1) for row in self.entries(field)], axis=-2)

    def entries(self, field: str) -> list[list[Float[np.ndarray, "*rows"]]]:
        """The entries of `marginal`, each an array over trajectories and rows."""
        names = list(component_names(self._scalar_state))
        index = [k for k, name in enumerate(names) if name.split(".")[0] == field]
        if not index:
            raise KeyError(
                f"the state has no '{field}'; it has {', '.join(dict.fromkeys(n.split('.')[0] for n in names))}"
            )
        entry = {pair: k for k, pair in enumerate(triangle(self.dimension))}
        return [[self.cov_upper[entry[min(i, j), max(i, j)]] for j in index] for i in index]

    def per_time(self, times: np.ndarray | None = None) -> tuple[np.ndarray, Estimates]:
        """The mask (…, T) of the last row of each time, and one estimate (N,) per time; rows of padding are left out.

        State and covariance are the last row's; log-likelihood, NIS, its degrees of freedom and wraps are sums
        over the rows of the time, in double precision (rows with a non-finite NIS count in neither of the two). The
        status is `NON_FINITE` if any of the rows is, `RESTARTED` if a track restarted in any of them and runs after
        the last, else the last row's. `times` (…, T): of the rows, not of validity; by default from the
        estimates' times and ages.
        """
        last = self.last_rows(times)
        mean = jax.tree_util.tree_map(lambda x: np.asarray(x)[last], self.mean)
        cov_upper = np.asarray(self.cov_upper)[:, last]
        return last, replace(self, mean=mean, cov_upper=cov_upper, **self._steps_per_time(last))

    def _steps_per_time(self, last: Bool[np.ndarray, "*rows"]) -> dict[str, Any]:
        """What `per_time` gives of each time but the state; `last`: see `last_rows`."""
        rows = self.status != Status.PADDING
        first = np.flatnonzero(np.append(True, last[rows])[:-1])
        counted = np.isfinite(self.nis)

        def summed(values: np.ndarray) -> np.ndarray:
            return np.add.reduceat(values[rows].astype(float), first)

        return {
            "log_likelihood": summed(self.log_likelihood),
            "nis": summed(np.where(counted, self.nis, 0.0)),
            "nis_dof": summed(np.where(counted, self.nis_dof, 0.0)),
            "wrapped": summed(self.wrapped),
            "status": self.status_per_time(last),
            "times": None if self.times is None else self.times[last],
            "age": None if self.age is None else self.age[last],
        }

    def last_rows(self, times: np.ndarray | None = None) -> Bool[np.ndarray, "*rows"]:
        """The mask (…, T) of the last row of each time; `times` as in `per_time`."""
        if times is None:
            if self.times is None:
                raise UnusableInput("these estimates have no times: a Batch was run; run the recordings themselves")
            times = self.times if self.age is None else self.times + self.age
        rows = self.status != Status.PADDING
        ends = np.ones_like(rows)
        # (t − age) + age is t up to rounding.
        steps, later = np.diff(times), ~rows[..., 1:]
        ends[..., :-1] = (steps > 2 * np.spacing(np.abs(times[..., 1:]))) | later
        return rows & ends

    def status_per_time(self, last: Bool[np.ndarray, "*rows"]) -> Int[np.ndarray, " N"]:
        """The status (N,) of each time, whose `last` row (…, T) `last_rows` gives; see `per_time`."""
        rows, status = self.status != Status.PADDING, self.status[last]
        first = np.flatnonzero(np.append(True, last[rows])[:-1])

        def occurs(status: Status) -> np.ndarray:
            return np.logical_or.reduceat(self.status[rows] == status, first)

        status = np.where((status == Status.OK) & occurs(Status.RESTARTED), Status.RESTARTED, status)
        return np.where(occurs(Status.NON_FINITE), Status.NON_FINITE, status).astype(np.int8)

    def to_polars(self) -> pl.DataFrame:
        """A table with one row per time: recording, `t_s`, the state, its standard deviations, NIS and status.

        Rows that share a time are merged as by `per_time`. A position becomes `x_m`, `y_m`, `z_m` with `std_…_m` and
        `cov_…_m2`, a velocity `vx_mps`, …; other components keep their names. `t_s` is the time for which the
        estimate is valid. Empty where there is no estimate. Recordings of one name are numbered (`numbered_names`).
        Raises UnusableInput where the run was of a bare `Batch`, which has no times.
        """
        last = self.last_rows()
        steps = self._steps_per_time(last)
        number = np.broadcast_to(np.arange(len(last))[:, None] if last.ndim == 2 else 0, last.shape)[last]
        missing = ~is_usable(steps["status"])

        def column(values: np.ndarray) -> pl.Series:
            return pl.Series(np.where(missing, np.nan, np.asarray(values, float)[last]), nan_to_null=True)

        # Most entries of a large covariance have no column.
        return pl.DataFrame(
            {"recording": pl.Series(numbered_names(self.names)).gather(number), "t_s": steps["times"]}
            | {name: column(x) for name, x in state_columns(self).items()}
            | {name: steps[name] for name in STEP_COLUMNS}
            | {"status": pl.Series([STATUS_WORDS.get(s) for s in Status]).gather(steps["status"])}
        )

    def to_pandas(self) -> Any:
        """The table of `to_polars` as a pandas frame; raises UnusableInput where pandas is not installed."""
        return to_pandas(self.to_polars())

    def summary(self) -> str:
        """One sentence on a single trajectory: ok, lost and re-started, non-finite at row k, or too little data.

        Restarts are counted by times with the status `RESTARTED`, by rows where there are no times.
        """
        status = self.status[self.status != Status.PADDING]
        if np.all(status == Status.WAITING):
            return "too little data: no row could start the tracker"
        bad = np.flatnonzero(status == Status.NON_FINITE)
        if len(bad):
            return f"non-finite at row {bad[0]}"
        if self.times is not None:
            status = self.per_time()[1].status
        restarts = int(np.sum(status == Status.RESTARTED))
        if restarts or np.any(status == Status.LOST):
            return f"lost and re-started {restarts} times" if restarts else "lost and never re-started"
        return "ok"


def state_columns(estimates: Estimates) -> dict[str, Num[np.ndarray, "*rows"]]:
    """The columns (…, T) of a table of states: positions and velocities by axis with units, the rest by its names."""
    mean, sigmas = estimates.mean, estimates.sigmas
    columns: dict[str, Any] = {}
    if hasattr(mean, "position"):
        axes = AXES[: len(mean.position)]
        cov = estimates.entries("position")
        columns |= {f"{a}_m": x for a, x in zip(axes, mean.position, strict=True)}
        columns |= {f"std_{a}_m": sigmas[f"position.{k}"] for k, a in enumerate(axes)}
        columns |= {f"cov_{axes[i]}{axes[j]}_m2": cov[i][j] for i in range(len(axes)) for j in range(i + 1, len(axes))}
    if hasattr(mean, "velocity"):
        columns |= {f"v{a}_mps": v for a, v in zip(AXES, mean.velocity, strict=False)}
    for path, leaf in jax.tree_util.tree_flatten_with_path(mean)[0]:
        name = path_name(path)
        if name.split(".")[0] not in ("position", "velocity"):
            parts = np.asarray(leaf).reshape(*estimates.status.shape, -1)
            columns |= {name if parts.shape[-1] == 1 else f"{name}.{k}": parts[..., k] for k in range(parts.shape[-1])}
    return columns | {f"std_{n}": x for n, x in sigmas.items() if n.split(".")[0] not in ("position", "velocity")}

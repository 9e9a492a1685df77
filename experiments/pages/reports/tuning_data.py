"""The data of a tuning report: numbers and text only, as `tuning_collect.collect` gathers them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from trackwright.experiments.pages.reports.recordings_compared import Compared
    from trackwright.experiments.pages.reports.tracks_compared import TrackChanges
    from trackwright.tuning.diagnostics import Innovations
    from trackwright.tuning.surface import Surface


@dataclass(frozen=True)
class TunedParameter:
    """A parameter before and after; `low`, `high`: its 95 % interval, NaN where there is none.

    `determined`: whether the recordings determine it; None where the objective has no information on that. `spread`:
    in words, that of the readings which the scale of a Student's t implies; empty for other parameters.
    """

    name: str
    unit: str
    before: float
    after: float
    low: float = float("nan")
    high: float = float("nan")
    determined: bool | None = None
    spread: str = ""


@dataclass(frozen=True)
class MetricChange:
    """A metric before and after, on the recordings tuned on and on those held out; NaN where missing.

    `key`: its name, as `rmse` or `nis-shape`. `target`: its value for a consistent filter, as 1 for NIS per degree of
    freedom; None where lower is better.
    """

    key: str
    title: str
    unit: str
    training: tuple[float, float]
    held_out: tuple[float, float]
    target: float | None = None


@dataclass(frozen=True)
class OptimiserTrace:
    """The steps from one start: the objective (i,) and the physical values (i, p) of the parameters."""

    name: str
    objective: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class ErrorTrack:
    """Absolute errors of one trajectory before and after (t,), in the report's error unit, NaN where unknown.

    `times` (t,): s since the start of the recording, one for each time.
    """

    name: str
    times: np.ndarray
    before: np.ndarray
    after: np.ndarray


@dataclass(frozen=True)
class TuningReportData:
    """Everything that a tuning report shows.

    `command`: as typed; `next_commands`: to use the result and to repeat the run. `tracker`, `objective`: names,
    `tracker_about`, `objective_about`: the same in words. `training`, `held_out`: names of recordings. `traces`: one
    per start, the best first. `evaluated_on`: in words, the recordings of `innovations` (before, after) and `errors`.
    `compared`: recordings before and after, in the figures of `evaluate`; `plans`: their tracks. `cautions`: clauses of
    the fit on itself. `issues`: sentences on undetermined parameters. `notes`: sentences on irregularities of the run.
    `provenance`: pairs of name and text.
    """

    command: str
    next_commands: tuple[str, ...]
    tracker: str
    tracker_about: str
    objective: str
    objective_about: str
    training: tuple[str, ...]
    held_out: tuple[str, ...]
    parameters: tuple[TunedParameter, ...]
    metrics: tuple[MetricChange, ...]
    traces: tuple[OptimiserTrace, ...]
    surface: Surface | None
    evaluated_on: str
    innovations: tuple[Innovations, Innovations] | None
    errors: tuple[ErrorTrack, ...]
    error_unit: str
    filter_runs: int
    seconds: float
    compared: Compared | None = None
    plans: TrackChanges | None = None
    cautions: tuple[str, ...] = ()
    issues: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    provenance: tuple[tuple[str, str], ...] = ()

    def metric(self, key: str) -> MetricChange | None:
        """The metric of this key, or None."""
        return next((m for m in self.metrics if m.key == key), None)

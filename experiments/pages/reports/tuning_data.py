"""The data of a tuning report, numbers and text only, and how they are collected: both trackers over the recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from trackwright.experiments.pages.reports.before_after import NO_PLANS, Compared, TrackChanges
from trackwright.experiments.text.wording import number, uncapitalised
from trackwright.trackers.core.data.estimates import Estimates
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.evaluation.residuals import residuals_of
from trackwright.trackers.recordings.tracks import batches
from trackwright.trackers.recordings.trajectories import Trajectories, Trajectory
from trackwright.tuning.data import FitData
from trackwright.tuning.diagnostics import Innovations, implied_spread, innovations_of
from trackwright.tuning.fitting import FitResult
from trackwright.tuning.identifiability import IdentifiabilityIssue
from trackwright.tuning.intervals import Interval
from trackwright.tuning.named_objectives import all_metrics
from trackwright.tuning.parameters import Parameter, component_names
from trackwright.tuning.sweeping import Surface, surface_of


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

    `key`: its name, as `rmse`; lower is better.
    """

    key: str
    title: str
    unit: str
    training: tuple[float, float]
    held_out: tuple[float, float]


@dataclass(frozen=True)
class OptimiserTrace:
    """The steps from one start: the objective (i,) and the physical values (i, p) of the parameters."""

    objective: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class TuningReportData:
    """Everything that a tuning report shows.

    `tracker`, `objective`: names, `tracker_about`, `objective_about`: the same in words. `training`, `held_out`: names
    of recordings. `traces`: one per start, the best first. `innovations`: before and after, of held-out recordings if
    there are any. `compared`: recordings before and after, in the figures of `evaluate`; `plans`: their tracks.
    `cautions`: clauses of the fit on itself. `issues`: sentences on undetermined parameters. `notes`: sentences on
    irregularities of the run. `commands`: to use the result and to repeat the run.
    """

    objective: str
    objective_about: str
    training: tuple[str, ...]
    held_out: tuple[str, ...]
    parameters: tuple[TunedParameter, ...]
    metrics: tuple[MetricChange, ...]
    traces: tuple[OptimiserTrace, ...]
    surface: Surface | None
    innovations: tuple[Innovations, Innovations] | None
    error_unit: str
    filter_runs: int
    commands: tuple[str, ...] = ()
    tracker: str = ""
    tracker_about: str = ""
    seconds: float = 0.0
    compared: Compared | None = None
    plans: TrackChanges = NO_PLANS
    cautions: tuple[str, ...] = ()
    issues: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


TITLES = {
    "nll": ("Negative log-likelihood per measured number", "nats"),
    "rmse": ("RMSE", ""),
    "rmse-3d": ("3-D RMSE", ""),
    "state-nll": ("Negative log-likelihood of the truth per row", "nats"),
}
"""Title and unit of each metric of `tuning.named_objectives`; without a unit it has that of the truth."""

HELD_OUT = "The held-out recordings were not fitted; they were used to select the best point and to stop the fit."
NO_DISTRIBUTION = "NIS is not shown: for this tracker its distribution is unknown."
MISSING = (float("nan"),) * 2


def collect(
    result: FitResult,
    data: FitData,
    objective: str,
    intervals: Mapping[str, Interval],
    issues: Sequence[IdentifiabilityIssue] = (),
) -> TuningReportData:
    """Metrics of both trackers on all trajectories; innovations on the held-out ones, if there are any.

    `intervals`: 95 %, by label, none where the fit was stopped; `issues`: undetermined parameters. The objective
    surface takes about as many evaluations as the fit took steps. What is not of the result is left to the caller.
    """
    training, held_out = data.training, data.held_out
    quantity = next(iter(training[0].recording.truth))
    angles = quantity == "direction"
    # The metric `rmse` is the horizontal error; the 3-D error has a name of its own.
    objective = "rmse-3d" if objective == "rmse" and data.dimensions == 3 else objective
    trackers = (result.before, result.tracker)
    runs = [_runs(tracker, held_out or training) for tracker in trackers]
    before, after = (
        innovations_of(tracker, [run for _, run in of_tracker])
        for tracker, of_tracker in zip(trackers, runs, strict=True)
    )
    innovations = None if before is None or after is None else (before, after)
    # A beam in a flat array's own plane has no direction: nothing to compare with the truth.
    comparable = all(hasattr(run.mean, quantity) for of_tracker in runs for _, run in of_tracker)
    rows = [[b if comparable else b._replace(truth={}) for b in data.rows(apart)] for apart in (False, True)]
    weights = [data.weights(apart) for apart in (False, True)]
    # A sum of several metrics, or with priors, is a metric of its own.
    sums = [] if objective in TITLES else [(result.start_value, result.value)]
    own = [MetricChange(objective, objective, "1", pair, MISSING) for pair in sums]
    return TuningReportData(
        objective=objective,
        objective_about=_about(objective, "rad" if angles else "m"),
        training=recording_names(training),
        held_out=recording_names(held_out),
        parameters=_parameters(result, intervals, issues, runs[1]),
        metrics=(*own, *_metrics(trackers, rows, weights, quantity, data.dimensions)),
        traces=traces_of(result),
        surface=surface_of(result),
        innovations=innovations,
        error_unit="°" if angles else "m",
        filter_runs=result.filter_runs,
        issues=tuple(issue.text for issue in issues),
        notes=(*([HELD_OUT] if held_out else []), *([] if innovations else [NO_DISTRIBUTION])),
    )


def _runs(tracker: AbstractTracker, trajectories: Sequence[Trajectory]) -> list[tuple[Trajectory, Estimates]]:
    """The tracker's estimates of each trajectory, without padding."""
    runs = []
    # With the compiled program of the recordings compared.
    tracker = tracker.for_positions()
    for group, batch in batches(trajectories):
        estimates = tracker.run(batch)
        runs += [(trajectory, estimates[k][: len(trajectory.recording)]) for k, trajectory in enumerate(group)]
    return runs


def _metrics(
    trackers: Sequence[AbstractTracker],
    recordings: Sequence[list[Batch]],
    weights: Sequence[Sequence[np.ndarray]],
    quantity: str,
    dimensions: int,
) -> tuple[MetricChange, ...]:
    """All defined metrics before and after, on the recordings tuned on and on those held out."""
    values = [
        [all_metrics(t, rows, quantity, dimensions, weights=of_rows) if rows else {} for t in trackers]
        for rows, of_rows in zip(recordings, weights, strict=True)
    ]
    unit = "rad" if quantity == "direction" else "m"
    metrics = []
    for key, (title, own_unit) in TITLES.items():
        pairs = [(old.get(key, np.nan), new.get(key, np.nan)) for old, new in values]
        if np.isfinite(pairs).any():
            full = f"Horizontal {title}" if key == "rmse" and dimensions == 3 else title
            metrics.append(MetricChange(key, full, own_unit or unit, pairs[0], pairs[1]))
    return tuple(metrics)


def _parameters(
    result: FitResult,
    intervals: Mapping[str, Interval],
    issues: Sequence[IdentifiabilityIssue],
    runs: Sequence[tuple[Trajectory, Estimates]] = (),
) -> tuple[TunedParameter, ...]:
    undetermined = {name for issue in issues for name in issue.names}
    names = component_names(result.parameters)
    units = [p.example.unit for p in result.parameters for _ in range(p.size)]
    old, new = (
        _flat(result.parameters, values) for values in ((result.starts or [result.trace])[0][0].values, result.values)
    )
    nothing = {label: (np.full(np.shape(x), np.nan),) * 2 for label, x in result.values.items()} | {**intervals}
    low, high = (_flat(result.parameters, {label: ends[k] for label, ends in nothing.items()}) for k in (0, 1))
    finite = np.isfinite(low) & np.isfinite(high)
    # Without any interval it is unknown what is determined; with some, a parameter without one is undetermined.
    known = bool(finite.any())
    spreads = [text for p in result.parameters for text in _spread(result, p, runs)]
    return tuple(
        TunedParameter(name, unit, float(a), float(b), float(lo) if ok else np.nan, float(hi) if ok else np.nan,
                       False if name in undetermined else bool(ok) if known else None, spread)
        for name, unit, a, b, lo, hi, ok, spread in zip(names, units, old, new, low, high, finite, spreads, strict=True)
    )  # fmt: skip


def _spread(result: FitResult, parameter: Parameter, runs: Sequence[tuple[Trajectory, Estimates]]) -> list[str]:
    """In words, the spread of readings that each number of a fitted parameter implies; empty where it implies none.

    And beside it the one about the estimates, of sensors whose readings follow from the position alone.
    """
    spread = implied_spread(result.tracker, parameter.names[0])
    if spread is None or parameter.size > 1:
        return [""] * parameter.size
    sensors: Any = getattr(result.tracker, "sensors", {})
    sensor, unit = parameter.names[0].split(".")[1], parameter.example.unit
    words, measured = f"{number(spread.value)} {unit}", ""
    if runs and sensors[sensor].view_fields == ("position",):
        columns = Trajectories.of([trajectory for trajectory, _ in runs]).columns
        place = Vector(*np.concatenate([np.array(run.mean.position, float) for _, run in runs], axis=1))
        of_channels = residuals_of({sensor: sensors[sensor]}, columns, place)
        low, high = np.nanquantile(np.concatenate([x[seen, 0] for _, x, seen in of_channels]), (0.16, 0.84))
        measured = f"; measured about the estimates: 68 % within ± {number((high - low) / 2)} {unit}"
    model = f"standard deviation {words}" if spread.is_deviation else f"68 % of the readings within ± {words}"
    return [f"by the model: {model}{measured}"]


def _flat(parameters: Sequence[Parameter], values: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([np.ravel(np.asarray(values[p.label], float)) for p in parameters])


def traces_of(result: FitResult) -> tuple[OptimiserTrace, ...]:
    """The steps of all starts, the best first."""
    ordered = sorted(result.starts or [result.trace], key=lambda steps: steps is not result.trace)
    return tuple(
        OptimiserTrace(
            np.array([step.value for step in steps]),
            np.stack([_flat(result.parameters, step.values) for step in steps]),
        )
        for steps in ordered
    )


def _about(objective: str, unit: str) -> str:
    if objective not in TITLES:
        return objective
    title, own_unit = TITLES[objective]
    shown = own_unit or unit
    return uncapitalised(title) + (f" ({shown})" if shown != "1" else "")


def recording_names(trajectories: Sequence[Trajectory]) -> tuple[str, ...]:
    """The recordings of trajectories."""
    return tuple(dict.fromkeys(trajectory.folder.name for trajectory in trajectories))

"""The report of a tuning run as an HTML page: charts, tables, and in words what speaks for and against the result."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

import numpy as np
from markupsafe import Markup

from trackwright.experiments.pages.charts import tuning as charts
from trackwright.experiments.pages.charts.tuning import OptimiserTrace, named
from trackwright.experiments.pages.reports.before_after import NO_PLANS, Compared, TrackChanges
from trackwright.experiments.pages.reports.pages import report_page
from trackwright.experiments.text.tables import Section
from trackwright.experiments.text.wording import MISSING, duration, number, percent_change, uncapitalised, yes_no
from trackwright.trackers.core.data.estimates import Estimates
from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.core.wording import counted
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

TITLES = {
    "nll": ("Negative log-likelihood per measured number", "nats"),
    "rmse": ("RMSE", ""),
    "rmse-3d": ("3-D RMSE", ""),
    "state-nll": ("Negative log-likelihood of the truth per row", "nats"),
}
"""Title and unit of each metric of `tuning.named_objectives`; without a unit it has that of the truth."""

HELD_OUT = "The held-out recordings were not fitted; they were used to select the best point and to stop the fit."
NO_DISTRIBUTION = "NIS is not shown: for this tracker its distribution is unknown."
UNKNOWN = (float("nan"),) * 2

SAME = 0.1
"""The relative difference of values up to which two starts end at one point, as the optimiser has it."""

WORSE = 0.02
"""Relative increase above which a metric counts as worse."""

WORSE_BY = 0.01
"""The same, absolute: in nats, which have no natural zero."""

ADVICE = "Do not use such values as measurements: freeze or tie these parameters, or record more motion."


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


def tuning_page(data: TuningReportData) -> str:
    """The report as HTML."""
    word, sentences, warnings = advice_on(data)
    return report_page(
        "tuning report",
        f"{data.tracker}, tuned on {counted(len(data.training), 'recording')}",
        [Markup('<b class="{}">{}</b> {}').format("better" if word == "Better." else "worse", word, sentences)],
        list(_sections(data)),
        data.commands,
        f"trackwright {version('trackwright')} · created {datetime.now(UTC):%Y-%m-%d %H:%M UTC}",
        warnings,
    )


def _sections(data: TuningReportData) -> Iterator[Section]:
    on = "held-out recordings" if data.held_out else "the recordings tuned on"
    settings = {
        "Tracker": f"{data.tracker}: {data.tracker_about}",
        "Objective": data.objective_about,
        "Tuned on": listed(data.training, 12),
        "Held out": listed(data.held_out, 12) or "none",
        "Effort": f"{data.filter_runs:,} filter runs in {duration(data.seconds)}".replace(",", "\u202f"),
    }
    yield Section("Settings", parts=[settings, *data.notes])
    yield _parameters_section(data)
    if data.compared is not None:
        yield data.compared.section
    lead = (
        "Tracks with the noise levels before and after the fit, tracked as by the command track. Circle: start, "
        "square: end. The 95 % ellipses before and after are of the same times."
    )
    plans, shown = [charts.plan_chart(change) for change in data.plans.shown], len(data.plans.shown)
    some = [f"{shown} of {data.plans.total} tracks are shown."] if 0 < shown < data.plans.total else []
    yield Section("Floor plans before and after", note=lead, parts=[plans, *some])
    yield _metrics_section(data)
    yield _optimisation(data)
    if data.innovations is not None and min(len(side.nis) for side in data.innovations):
        lead = (
            "For a consistent filter the normalised innovation squared (NIS) follows a known distribution, χ² for "
            f"normal noise, and is uncorrelated between rows. Evaluated on {on}."
        )
        yield Section("Consistency of the filter", note=lead, parts=[charts.innovation_charts(*data.innovations)])
    errors = [e for e in data.plans.errors if np.isfinite(e.before).any() and np.isfinite(e.after).any()]
    if errors:
        over_time = charts.error_charts(errors, data.error_unit)
        few = f", for the {len(over_time)} trajectories that changed most" if len(over_time) < len(errors) else ""
        pooled = [charts.rmse_chart(errors, data.error_unit), charts.distribution_chart(errors, data.error_unit)]
        yield Section("Errors against truth", note=f"Evaluated on {on}.", parts=[pooled, f"Over time{few}:", over_time])


def _parameters_section(data: TuningReportData) -> Section:
    lead = "No intervals: they require a likelihood or at least twenty trajectories, and a fit that converged."
    if any(p.determined is not None for p in data.parameters):
        lead = (
            "These recordings contain little information on a parameter whose interval spans a factor of ten, or that "
            "is not determined."
        )
    head = ["parameter", "before", "after", "unit", "95 % interval", "determined?"]
    rows = [
        [
            p.name,
            number(p.before),
            number(p.after),
            "" if p.unit == "1" else p.unit,
            f"{number(p.low)} … {number(p.high)}" if math.isfinite(p.low) else MISSING,
            MISSING if p.determined is None else yes_no(p.determined),
            p.spread,
        ]
        for p in data.parameters
    ]
    if any(p.spread for p in data.parameters):
        head.append("spread of the readings")
    looks = {"after": "after", "determined?": "answer", "spread of the readings": "long"}
    return Section("Tuned parameters", head, [row[: len(head)] for row in rows], 1, lead, looks)


def _metrics_section(data: TuningReportData) -> Section:
    lead = (
        "All metrics, not only the objective; lower is better. Overconfident covariances appear here even where the "
        "errors decrease. Every row counts, as in the objective; in the table of recordings and the charts of errors, "
        "rows of the same time count once."
    )
    sides = ["tuned on: ", "held out: "] if data.held_out else [""]
    head = ["metric", *(side + word for side in sides for word in ("before", "after", "change"))]
    rows = []
    for m in data.metrics:
        title = m.title + ("" if m.unit == "1" else f", {m.unit}") + (" (objective)" if m.key == data.objective else "")
        pairs = [m.training, m.held_out][: len(sides)]
        rows.append([title, *(cell for pair in pairs for cell in (*map(number, pair), changed(m, pair)))])
    return Section("Metrics before and after", head, rows, 1, lead)


def changed(metric: MetricChange, pair: tuple[float, float]) -> str:
    """The change as a difference or in per cent where that has a meaning, and as a word where it matters."""
    before, after = pair
    if not all(map(math.isfinite, pair)) or before == after:
        return "same" if before == after else MISSING
    # Log-densities have no natural zero; distances between distributions are near zero for a good filter.
    nats = metric.unit == "nats"
    change = ("+" if after > before else "") + number(after - before) if nats else percent_change(before, after)
    text = "" if metric.unit == "1" else change
    if after > before + (WORSE_BY if nats else WORSE * before):
        return Markup('<span class="worse">{}</span>').format(f"{text} worse".strip())
    better = before > after + (WORSE_BY if nats else WORSE * after)
    return Markup('<span class="better">{}</span>').format(text or "better") if better else text or "same"


def _optimisation(data: TuningReportData) -> Section:
    if not data.traces:
        return Section("Optimisation")
    lead = [agreement(data.traces)] if len(data.traces) > 1 else []
    if data.held_out:
        lead.append("The selected point has the least objective on the held-out recordings.")
    step = charts.selected_step(data.traces[0], [p.after for p in data.parameters])
    first = [charts.objective_chart(data.traces, data.objective_about, step)]
    if data.surface is not None:
        known = [data.parameters[k] for k in data.surface.axes]
        labels, best = [named(p.name, p.unit) for p in known], [p.after for p in known]
        names = [p.name for p in known]
        first.append(charts.surface_chart(data.surface, names, labels, best, data.objective_about, data.traces))
    others = [charts.parameter_chart(data.traces, k, p.name, p.unit) for k, p in enumerate(data.parameters)]
    return Section("Optimisation", note=" ".join(lead), parts=[first, others])


def agreement(traces: Sequence[OptimiserTrace]) -> str:
    """A sentence on how many starts end where the best one does: all values within a tenth."""
    least = [np.where(np.isfinite(t.objective), t.objective, np.inf) for t in traces]
    objectives = np.array([of.min() for of in least])
    values = np.stack([t.values[np.argmin(of)] for t, of in zip(traces, least, strict=True)])
    away = np.abs(values - values[0]) / np.maximum(np.abs(values[0]), np.finfo(float).tiny)
    same = away.max(axis=1) <= SAME
    if same.all():
        return f"All {len(same)} starts end at one point (values within a tenth)."
    lower = int(np.sum(objectives[~same] < objectives[0]))
    agreeing = f"{int(same.sum())} of {counted(len(same), 'start')} end at the selected point (values within a tenth)"
    below = f", {lower or 'none'}{' of them' if lower else ''} with a lower objective"
    return f"{agreeing}; {int((~same).sum())} end elsewhere{below}: the optimum is not certain."


def advice_on(data: TuningReportData) -> tuple[str, str, list[str]]:
    """The verdict in a word, a summary in sentences, and warnings with advice."""
    known = [p.determined for p in data.parameters]
    names = ", ".join(p.name for p in data.parameters if p.determined is False)
    issues = list(data.issues)
    if names and not issues:
        issues = [f"The recordings do not determine {names}: other values fit equally well"]
    warnings = [*map(_sentence, data.cautions), *(f"{text}." for text in issues)]
    if issues:
        warnings[-1] += f" {ADVICE}"
    sentence = f"{data.objective_about} was tuned"
    for best in (metric for metric in data.metrics if metric.key == data.objective):
        relative = "" if best.unit == "nats" else percent_change(*best.training)
        values = " to ".join(map(number, best.training))
        sentence = f"{best.title} changed from {values} {best.unit}" + (f" ({relative})" if relative else "")
    if None not in known:
        sentence += f"; the recordings determine {known.count(True)} of {counted(len(known), 'parameter')}"
    elif names:
        sentence += f"; the recordings do not determine {known.count(False)} of {counted(len(known), 'parameter')}"
    sentence = sentence if sentence.startswith(data.objective) else sentence[0].upper() + sentence[1:]
    if data.compared is None:
        return "Not judged.", f"{sentence}.", warnings
    verdict, about = data.compared.verdict, data.compared.about
    summary = f"{verdict.sentence(about)} {sentence}."
    return f"{verdict.word.capitalize()}.", summary, [*verdict.got_worse, *warnings]


def _sentence(clause: str) -> str:
    """A clause as a sentence; one that begins with the name of a parameter keeps its case."""
    first = clause.split(" ", 1)[0]
    return (clause if "." in first else clause[0].upper() + clause[1:]) + "."


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
    # A sum of several metrics, or with priors, is a metric of its own.
    sums = [] if objective in TITLES else [(result.start_value, result.value)]
    own = [MetricChange(objective, objective, "1", pair, UNKNOWN) for pair in sums]
    return TuningReportData(
        objective=objective,
        objective_about=_about(objective, "rad" if angles else "m"),
        training=recording_names(training),
        held_out=recording_names(held_out),
        parameters=tuned_parameters(result, intervals, issues, runs[1]),
        metrics=(*own, *_metrics(trackers, data, quantity, comparable)),
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
    trackers: Sequence[AbstractTracker], data: FitData, quantity: str, comparable: bool
) -> tuple[MetricChange, ...]:
    """All defined metrics before and after, on the recordings tuned on and on those held out."""
    values, dimensions = [], data.dimensions
    for apart in (False, True):
        rows = [b if comparable else b._replace(truth={}) for b in data.rows(apart)]
        given = rows, quantity, dimensions
        values.append([all_metrics(t, *given, weights=data.weights(apart)) if rows else {} for t in trackers])
    unit = "rad" if quantity == "direction" else "m"
    metrics = []
    for key, (title, own_unit) in TITLES.items():
        pairs = [(old.get(key, np.nan), new.get(key, np.nan)) for old, new in values]
        if np.isfinite(pairs).any():
            full = f"Horizontal {title}" if key == "rmse" and dimensions == 3 else title
            metrics.append(MetricChange(key, full, own_unit or unit, pairs[0], pairs[1]))
    return tuple(metrics)


def tuned_parameters(
    result: FitResult,
    intervals: Mapping[str, Interval],
    issues: Sequence[IdentifiabilityIssue] = (),
    runs: Sequence[tuple[Trajectory, Estimates]] = (),
) -> tuple[TunedParameter, ...]:
    """The numbers that a fit tuned; `intervals`: 95 %, by label; `runs`: recordings tracked with the result."""
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
        low, high = np.nanquantile(np.concatenate([rows["residual"] for _, rows in of_channels]), (0.16, 0.84))
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

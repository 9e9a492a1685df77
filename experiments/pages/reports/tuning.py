"""The report of a tuning run as an HTML page: charts, tables, and in words what speaks for and against the result."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from trackwright.experiments.pages.charts import tuning as charts
from trackwright.experiments.pages.charts.tuning import OptimiserTrace, named
from trackwright.experiments.pages.reports.before_after import NO_PLANS, Compared, TrackChanges
from trackwright.experiments.pages.reports.pages import report_page
from trackwright.experiments.text.tables import Section
from trackwright.experiments.text.wording import MISSING, duration, number, percent_change, uncapitalised, yes_no
from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.wording import counted
from trackwright.trackers.recordings.tracks import batches
from trackwright.trackers.recordings.trajectories import Trajectory
from trackwright.tuning.data import FitData
from trackwright.tuning.diagnostics import Innovations, implied_spread, innovations_of
from trackwright.tuning.fitting import FitResult
from trackwright.tuning.identifiability import IdentifiabilityIssue
from trackwright.tuning.intervals import Interval
from trackwright.tuning.named_objectives import all_metrics
from trackwright.tuning.parameters import component_names
from trackwright.tuning.sweeping import Surface, surface_of

TITLES = {
    "nll": ("Negative log-likelihood per measured number", "nats"),
    "rmse": ("RMSE", ""),
    "rmse-3d": ("3-D RMSE", ""),
    "state-nll": ("Negative log-likelihood of the truth per row", "nats"),
}
"""Title and unit of each metric of `tuning.named_objectives`; without a unit it has that of the truth."""

SAME, WORSE, WORSE_BY = 0.1, 0.02, 0.01
"""The relative difference of values up to which two starts end at one point, and the increase above which a metric
counts as worse: relative, and in nats, which have no natural zero."""


class TunedParameter(NamedTuple):
    """A parameter before and after; `low`, `high`: its 95 % interval, NaN where there is none.

    `determined`: whether the recordings determine it; None where the objective has no information on that. `spread`:
    in words, that of the readings which the scale of a Student's t implies; empty for other parameters.
    """

    name: str
    unit: str
    before: float
    after: float
    low: float = math.nan
    high: float = math.nan
    determined: bool | None = None
    spread: str = ""


class MetricChange(NamedTuple):
    """A metric before and after, on the recordings tuned on and on those held out; `key`: its name, as `rmse`."""

    key: str
    title: str
    unit: str
    training: tuple[float, float]
    held_out: tuple[float, float]


@dataclass(frozen=True)
class TuningReportData:
    """Everything that a tuning report shows.

    `traces`: one per start, the best first. `innovations`: before and after, of held-out recordings if there are any.
    `compared`: recordings before and after, in the figures of `evaluate`; `plans`: their tracks. `cautions`: clauses of
    the fit on itself. `issues`: sentences on undetermined parameters. `notes`: sentences on irregularities of the run.
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
    title = f"{data.tracker}, tuned on {counted(len(data.training), 'recording')}"
    summary = Markup('<b class="{}">{}</b> {}').format("better" if word == "Better." else "worse", word, sentences)
    foot = f"trackwright {version('trackwright')} · created {datetime.now(UTC):%Y-%m-%d %H:%M UTC}"
    return report_page("tuning report", title, [summary], list(_sections(data)), data.commands, foot, warnings)


def _sections(data: TuningReportData) -> Iterator[Section]:
    on = f"Evaluated on {'held-out recordings' if data.held_out else 'the recordings tuned on'}."
    settings = {
        "Tracker": f"{data.tracker}: {data.tracker_about}",
        "Objective": data.objective_about,
        "Tuned on": listed(data.training, 12),
        "Held out": listed(data.held_out, 12) or "none",
        "Effort": f"{data.filter_runs:,} filter runs in {duration(data.seconds)}".replace(",", "\u202f"),
    }
    yield Section("Settings", parts=[settings, *data.notes])
    yield parameters_section(data.parameters)
    if data.compared is not None:
        yield data.compared.section
    lead = "Circle: start, square: end. The 95 % ellipses before and after are of the same times."
    plans, shown = [charts.plan_chart(change) for change in data.plans.shown], len(data.plans.shown)
    some = [f"{shown} of {data.plans.total} tracks are shown."] if 0 < shown < data.plans.total else []
    yield Section("Floor plans before and after", note=lead, parts=[plans, *some])
    yield _metrics_section(data)
    if data.traces:
        yield _optimisation(data)
    if data.innovations is not None and min(len(side.nis) for side in data.innovations):
        lead = "For a consistent filter NIS is distributed as the line says and uncorrelated between rows. "
        yield Section("Consistency of the filter", note=lead + on, parts=[charts.innovation_charts(*data.innovations)])
    errors = [e for e in data.plans.errors if np.isfinite(e.before).any() and np.isfinite(e.after).any()]
    if errors:
        over_time = charts.error_charts(errors, data.error_unit)
        few = f", for the {len(over_time)} trajectories that changed most" * (len(over_time) < len(errors))
        pooled = [charts.rmse_chart(errors, data.error_unit), charts.distribution_chart(errors, data.error_unit)]
        yield Section("Errors against truth", note=on, parts=[pooled, f"Over time{few}:", over_time])


def parameters_section(parameters: Sequence[TunedParameter]) -> Section:
    """The table of the numbers that a fit tuned."""
    lead = "No intervals: they require a likelihood or at least twenty trajectories, and a fit that converged."
    if any(p.determined is not None for p in parameters):
        lead = "Recordings say little on a parameter that is not determined, or whose interval spans a factor of ten."
    rows = []
    for p in parameters:
        interval = f"{number(p.low)} … {number(p.high)}" if math.isfinite(p.low) else MISSING
        determined, unit = MISSING if p.determined is None else yes_no(p.determined), "" if p.unit == "1" else p.unit
        rows.append([p.name, number(p.before), number(p.after), unit, interval, determined, p.spread])
    head = ["parameter", "before", "after", "unit", "95 % interval", "determined?", "spread of the readings"]
    looks = {"after": "after", "determined?": "answer", "spread of the readings": "long"}
    shown = len(head) if any(p.spread for p in parameters) else len(head) - 1
    return Section("Tuned parameters", head[:shown], [row[:shown] for row in rows], 1, lead, looks)


def _metrics_section(data: TuningReportData) -> Section:
    lead = "Lower is better. Every row counts, as in the objective; elsewhere rows of the same time count once."
    sides, rows = ["tuned on: ", "held out: "] if data.held_out else [""], []
    for m in data.metrics:
        title = m.title + ("" if m.unit == "1" else f", {m.unit}") + " (objective)" * (m.key == data.objective)
        pairs = [m.training, m.held_out][: len(sides)]
        rows.append([title, *(cell for pair in pairs for cell in (*map(number, pair), changed(m.unit, *pair)))])
    head = ["metric", *(side + word for side in sides for word in ("before", "after", "change"))]
    return Section("Metrics before and after", head, rows, 1, lead)


def changed(unit: str, before: float, after: float) -> str:
    """The change as a difference or in per cent where that has a meaning, and as a word where it matters."""
    if not (math.isfinite(before) and math.isfinite(after)):
        return MISSING
    # Log-densities have no natural zero.
    nats = unit == "nats"
    text = ("+" if after > before else "") + number(after - before) if nats else percent_change(before, after)
    if abs(after - before) <= (WORSE_BY if nats else WORSE * min(before, after)):
        return text or "same"
    word = "worse" if after > before else "better"
    return Markup('<span class="{}">{} {}</span>').format(word, "" if unit == "1" else text, word)


def _optimisation(data: TuningReportData) -> Section:
    lead = agreement(data.traces) if len(data.traces) > 1 else ""
    lead += " The selected point has the least objective on the held-out recordings." if data.held_out else ""
    step = charts.selected_step(data.traces[0], [p.after for p in data.parameters])
    first = [charts.objective_chart(data.traces, data.objective_about, step)]
    if data.surface is not None:
        known = [data.parameters[k] for k in data.surface.axes]
        labels, best = [named(p.name, p.unit) for p in known], [p.after for p in known]
        first.append(charts.surface_chart(data.surface, labels, best, data.objective_about, data.traces))
    others = [charts.parameter_chart(data.traces, k, p.name, p.unit) for k, p in enumerate(data.parameters)]
    return Section("Optimisation", note=lead, parts=[first, others])


def agreement(traces: Sequence[OptimiserTrace]) -> str:
    """A sentence on how many starts end where the best one does: all values within a tenth."""
    least = [np.where(np.isfinite(t.objective), t.objective, np.inf) for t in traces]
    values = np.stack([t.values[np.argmin(of)] for t, of in zip(traces, least, strict=True)])
    away = np.abs(values - values[0]) / np.maximum(np.abs(values[0]), np.finfo(float).tiny)
    same = away.max(axis=1) <= SAME
    lower = sum(of.min() < least[0].min() for of, one in zip(least, same, strict=True) if not one)
    text = f"{same.sum()} of {counted(len(same), 'start')} end at the selected point (values within a tenth)"
    return text + (f", {lower or 'none'} elsewhere with a lower objective." if lower or not same.all() else ".")


def advice_on(data: TuningReportData) -> tuple[str, str, list[str]]:
    """The verdict in a word, a summary in sentences, and warnings with advice."""
    known, issues = [p.determined for p in data.parameters], [f"{text}." for text in data.issues]
    names = ", ".join(p.name for p in data.parameters if p.determined is False)
    if names and not issues:
        issues = [f"The recordings do not determine {names}: other values fit equally well."]
    if issues:
        issues[-1] += " Do not use such values as measurements: freeze or tie these parameters, or record more motion."
    sentence = f"{data.objective_about} was tuned"
    for best in (metric for metric in data.metrics if metric.key == data.objective):
        relative = "" if best.unit == "nats" else percent_change(*best.training)
        sentence = f"{best.title} changed from {' to '.join(map(number, best.training))} {best.unit}"
        sentence += f" ({relative})" * bool(relative)
    if None not in known or names:
        count = f"{known.count(True)} of " if None not in known else f"all but {known.count(False)} of "
        sentence += f"; the recordings determine {count}{counted(len(known), 'parameter')}"
    # A clause that begins with the name of a parameter keeps its case.
    sentence, *cautions = (
        f"{text if '.' in text.split(' ', 1)[0] else text[0].upper() + text[1:]}."
        for text in (sentence, *data.cautions)
    )
    if data.compared is None:
        return "Not judged.", sentence, [*cautions, *issues]
    verdict = data.compared.verdict
    summary = f"{verdict.sentence(data.compared.about)} {sentence}"
    return f"{verdict.word.capitalize()}.", summary, [*verdict.got_worse, *cautions, *issues]


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
    held_out, quantity = data.held_out, next(iter(data.training[0].recording.truth))
    unit = "rad" if quantity == "direction" else "m"
    # The metric `rmse` is the horizontal error; the 3-D error has a name of its own.
    objective = "rmse-3d" if objective == "rmse" and data.dimensions == 3 else objective
    title, own_unit = TITLES.get(objective, (objective, "1"))
    trackers, runs = (result.before, result.tracker), []
    for tracker in trackers:
        grouped = [(group, tracker.for_positions().run(batch)) for group, batch in batches(held_out or data.training)]
        runs.append([of[k][: len(one.recording)] for group, of in grouped for k, one in enumerate(group)])
    before, after = (innovations_of(tracker, of) for tracker, of in zip(trackers, runs, strict=True))
    innovations = None if before is None or after is None else (before, after)
    # A beam in a flat array's own plane has no direction: nothing to compare with the truth.
    comparable = all(hasattr(run.mean, quantity) for of_tracker in runs for run in of_tracker)
    # A sum of several metrics, or with priors, is a metric of its own.
    pair = result.start_value, result.value
    metrics = [] if objective in TITLES else [MetricChange(objective, objective, "1", pair, (math.nan,) * 2)]
    values = []
    for apart in (False, True):
        rows = [b if comparable else b._replace(truth={}) for b in data.batches(apart)]
        given = rows, quantity, data.dimensions
        values.append([all_metrics(t, *given, weights=data.weights(apart)) if rows else {} for t in trackers])
    for key, (full, own) in TITLES.items():
        pairs = [(old.get(key, np.nan), new.get(key, np.nan)) for old, new in values]
        if np.isfinite(pairs).any():
            full = f"Horizontal {full}" if key == "rmse" and data.dimensions == 3 else full
            metrics.append(MetricChange(key, full, own or unit, pairs[0], pairs[1]))
    notes = ["The held-out recordings were used to select the best point and to stop the fit."] if held_out else []
    notes += [] if innovations else ["NIS is not shown: for this tracker its distribution is unknown."]
    return TuningReportData(
        objective=objective,
        objective_about=objective if objective not in TITLES else f"{uncapitalised(title)} ({own_unit or unit})",
        training=recording_names(data.training),
        held_out=recording_names(held_out),
        parameters=tuned_parameters(result, intervals, issues),
        metrics=tuple(metrics),
        traces=traces_of(result),
        surface=surface_of(result),
        innovations=innovations,
        error_unit="°" if unit == "rad" else "m",
        filter_runs=result.filter_runs,
        issues=tuple(issue.text for issue in issues),
        notes=tuple(notes),
    )


def tuned_parameters(
    result: FitResult, intervals: Mapping[str, Interval], issues: Sequence[IdentifiabilityIssue] = ()
) -> tuple[TunedParameter, ...]:
    """The numbers that a fit tuned; `intervals`: 95 %, by label."""
    undetermined, names = {name for issue in issues for name in issue.names}, component_names(result.parameters)
    none = {label: (np.full(np.shape(x), np.nan),) * 2 for label, x in result.values.items()} | {**intervals}
    ends = ({label: pair[k] for label, pair in none.items()} for k in (0, 1))
    before = (result.starts or [result.trace])[0][0].values
    numbers = np.stack([_flat(result, values) for values in (before, result.values, *ends)])
    finite, made = np.isfinite(numbers[2:]).all(axis=0), []
    numbers[2:, ~finite] = np.nan
    parameters = [p for p in result.parameters for _ in range(p.size)]
    for name, p, values, ok in zip(names, parameters, numbers.T.tolist(), finite.tolist(), strict=True):
        # Without any interval it is unknown what is determined; with some, a parameter without one is undetermined.
        determined = False if name in undetermined else ok if finite.any() else None
        words, spread = "", implied_spread(result.tracker, p.names[0]) if p.size == 1 else None
        if spread is not None:
            form = "standard deviation {}" if spread.is_deviation else "68 % of the readings within ± {}"
            words = form.format(f"{number(spread.value)} {p.example.unit}")
        made.append(TunedParameter._make((name, p.example.unit, *values, determined, words)))
    return tuple(made)


def _flat(result: FitResult, values: Mapping[str, Any]) -> np.ndarray:
    return np.concatenate([np.ravel(np.asarray(values[p.label], float)) for p in result.parameters])


def traces_of(result: FitResult) -> tuple[OptimiserTrace, ...]:
    """The steps of all starts, the best first."""
    ordered = sorted(result.starts or [result.trace], key=lambda steps: steps is not result.trace)
    columns = (([step.value for step in steps], [_flat(result, step.values) for step in steps]) for steps in ordered)
    return tuple(OptimiserTrace(np.array(objective), np.stack(values)) for objective, values in columns)


def recording_names(trajectories: Sequence[Trajectory]) -> tuple[str, ...]:
    """The recordings of trajectories."""
    return tuple(dict.fromkeys(trajectory.folder.name for trajectory in trajectories))

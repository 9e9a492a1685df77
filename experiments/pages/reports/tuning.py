"""The report of a tuning run as an HTML page: charts, tables, and in words what speaks for and against the result."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from importlib.metadata import version

import numpy as np
from markupsafe import Markup

from trackwright.experiments.pages.charts import tuning as charts
from trackwright.experiments.pages.reports.pages import report_page
from trackwright.experiments.pages.reports.tuning_data import MetricChange, OptimiserTrace, TuningReportData
from trackwright.experiments.text.tables import Section
from trackwright.experiments.text.wording import MISSING, duration, number, percent_change, yes_no
from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.wording import counted

SAME = 0.1
"""The relative difference of values up to which two starts end at one point, as the optimiser has it."""

WORSE = 0.02
"""Relative increase above which a metric counts as worse."""

WORSE_BY = 0.01
"""The same, absolute: in nats, which have no natural zero."""

ADVICE = "Do not use such values as measurements: freeze or tie these parameters, or record more motion."


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
    yield _parameters(data)
    if data.compared is not None:
        about, head = data.compared.about, data.compared.head
        lead = (
            "Before → after, tracked as by the command track; figures as in evaluate. Regret: nats of the log density "
            "that the scale of the covariances loses."
        )
        looks = dict.fromkeys(head[1:], "after")
        yield Section(about.capitalize(), head, data.compared.rows, 1, lead, looks, data.compared.statements)
    lead = (
        "Tracks with the noise levels before and after the fit, tracked as by the command track. Circle: start, "
        "square: end. The 95 % ellipses before and after are of the same times."
    )
    plans, shown = [charts.plan_chart(change) for change in data.plans.shown], len(data.plans.shown)
    some = [f"{shown} of {data.plans.total} tracks are shown."] if 0 < shown < data.plans.total else []
    yield Section("Floor plans before and after", note=lead, parts=[plans, *some])
    yield _metrics(data)
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


def _parameters(data: TuningReportData) -> Section:
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


def _metrics(data: TuningReportData) -> Section:
    lead = (
        "All metrics, not only the objective; lower is better. Overconfident covariances appear here even where the "
        "errors decrease. Every row counts, as in the objective; in the table of recordings and the charts of errors, "
        "rows of the same time count once."
    )
    sides = ["", "held out: "] if data.held_out else [""]
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
    first = [charts.objective_chart(data.traces, data.objective_about, charts.selected_step(data))]
    if data.surface is not None:
        first.append(charts.surface_chart(data, data.surface))
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

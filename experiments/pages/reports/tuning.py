"""The report of a tuning run as an HTML page: charts, tables, and in words what speaks for and against the result."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from trackwright.experiments.pages.charts import tuning as charts
from trackwright.experiments.pages.charts.objective import named
from trackwright.experiments.pages.reports.pages import page
from trackwright.experiments.pages.reports.tuning_data import MetricChange, OptimiserTrace, TuningReportData
from trackwright.experiments.text.wording import MISSING, number, percent_change
from trackwright.trackers.core.wording import counted

SAME = 0.1
"""The relative difference of values up to which two starts end at one point, as the optimiser has it."""


def tuning_page(data: TuningReportData) -> str:
    """The report as HTML."""
    return page(
        "tuning.html",
        title=f"{data.tracker}, tuned on {counted(len(data.training), 'recording')}",
        data=data,
        advice=advice_on(data),
        parameters_lead=_parameters_lead(data),
        changed=_changed,
        agreement=agreement(data.traces) if data.traces else "",
        charts=_charts(data),
    )


def _parameters_lead(data: TuningReportData) -> str:
    if any(p.determined is not None for p in data.parameters):
        return (
            "These recordings contain little information on a parameter whose interval spans a factor of ten, or that "
            "is not determined."
        )
    return "No intervals: they require a likelihood or at least twenty trajectories, and a fit that converged."


def agreement(traces: Sequence[OptimiserTrace]) -> str:
    """A sentence on how many starts end where the best one does: all values within a tenth."""
    objectives = np.stack([np.where(np.isfinite(t.objective), t.objective, np.inf).min() for t in traces])
    values = np.stack([t.values[np.argmin(np.where(np.isfinite(t.objective), t.objective, np.inf))] for t in traces])
    away = np.abs(values - values[0]) / np.maximum(np.abs(values[0]), np.finfo(float).tiny)
    same = away.max(axis=1) <= SAME
    if same.all():
        return f"All {len(same)} starts end at one point (values within a tenth)."
    lower = int(np.sum(objectives[~same] < objectives[0]))
    agreeing = f"{int(same.sum())} of {counted(len(same), 'start')} end at the selected point (values within a tenth)"
    below = f", {lower or 'none'}{' of them' if lower else ''} with a lower objective"
    return f"{agreeing}; {int((~same).sum())} end elsewhere{below}: the optimum is not certain."


class Change(NamedTuple):
    """The change of a metric in words; `kind`: better, worse or neither."""

    text: str
    kind: str = ""


def _changed(metric: MetricChange, pair: tuple[float, float]) -> Change:
    """The change as a difference or in per cent where that has a meaning, and as a word where it matters."""
    before, after = pair
    if not all(map(math.isfinite, pair)) or before == after:
        return Change("same" if before == after else MISSING)
    # Log-densities have no natural zero; distances between distributions are near zero for a good filter.
    nats = metric.unit == "nats"
    change = ("+" if after > before else "") + number(after - before) if nats else percent_change(before, after)
    text = "" if metric.unit == "1" else change
    if after > before + (WORSE_BY if nats else WORSE * before):
        return Change(f"{text} worse".strip(), "worse")
    better = before > after + (WORSE_BY if nats else WORSE * after)
    return Change(text or "better", "better") if better else Change(text or "same")


def _charts(data: TuningReportData) -> dict[str, Any]:
    """The charts of the page by section."""
    drawn: dict[str, Any] = {"consistency": (), "errors": {}, "plans": ()}
    if data.plans is not None:
        drawn["plans"] = [(charts.plan_chart(change), change) for change in data.plans.shown]
    if data.traces:
        drawn["objective"] = charts.objective_chart(data.traces, data.objective_about, charts.selected_step(data))
        drawn["parameters"] = [
            charts.parameter_chart(data.traces, k, parameter.name, named(parameter.name, parameter.unit))
            for k, parameter in enumerate(data.parameters)
        ]
        if data.surface is not None:
            drawn["surface"] = charts.surface_chart(data, data.surface)
    if data.innovations is not None and min(len(side.nis) for side in data.innovations):
        drawn["consistency"] = charts.innovation_charts(*data.innovations)
    known = [e for e in data.errors if (e.before == e.before).any() and (e.after == e.after).any()]
    if known:
        drawn["errors"] = {
            "count": len(known),
            "rmse": charts.rmse_chart(known, data.error_unit),
            "distribution": charts.distribution_chart(known, data.error_unit),
            "over_time": charts.error_charts(known, data.error_unit),
        }
    return drawn


WORSE = 0.02
"""Relative increase above which a metric counts as worse."""

WORSE_BY = 0.01
"""The same, absolute: in nats, which have no natural zero."""

ADVICE = "Do not use such values as measurements: freeze or tie these parameters, or record more motion."


@dataclass(frozen=True)
class Advice:
    """`word`: the verdict; `summary`: in sentences; `good`: whether it is better."""

    word: str
    summary: str
    good: bool
    warnings: tuple[str, ...]


def advice_on(data: TuningReportData) -> Advice:
    """Summary, warnings and advice on a tuning result."""
    known = [p.determined for p in data.parameters]
    names = ", ".join(p.name for p in data.parameters if p.determined is False)
    issues = list(data.issues)
    if names and not issues:
        issues = [f"The recordings do not determine {names}: other values fit equally well"]
    warnings = [*map(_sentence, data.cautions), *(f"{text}." for text in issues)]
    if issues:
        warnings[-1] += f" {ADVICE}"
    best = data.metric(data.objective)
    sentence = f"{data.objective_about} was tuned"
    if best is not None:
        relative = "" if best.unit == "nats" else percent_change(*best.training)
        values = " to ".join(map(number, best.training))
        sentence = f"{best.title} changed from {values} {best.unit}" + (f" ({relative})" if relative else "")
    if None not in known:
        sentence += f"; the recordings determine {known.count(True)} of {counted(len(known), 'parameter')}"
    elif names:
        sentence += f"; the recordings do not determine {known.count(False)} of {counted(len(known), 'parameter')}"
    sentence = sentence if sentence.startswith(data.objective) else sentence[0].upper() + sentence[1:]
    if data.compared is None:
        return Advice("Not judged.", f"{sentence}.", False, tuple(warnings))
    verdict, about = data.compared.verdict, data.compared.about
    summary, word = f"{verdict.sentence(about)} {sentence}.", f"{verdict.word.capitalize()}."
    return Advice(word, summary, verdict.word == "better", (*verdict.got_worse, *warnings))


def _sentence(clause: str) -> str:
    """A clause as a sentence; one that begins with the name of a parameter keeps its case."""
    first = clause.split(" ", 1)[0]
    return (clause if "." in first else clause[0].upper() + clause[1:]) + "."

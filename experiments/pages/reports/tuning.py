"""The report of a tuning run as an HTML page: charts, tables, and in words what speaks for and against the result."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from trackwright.experiments.pages.charts.objective import named
from trackwright.experiments.pages.charts.tuning import (
    distribution_chart,
    error_charts,
    innovation_charts,
    objective_chart,
    parameter_chart,
    plan_chart,
    rmse_chart,
    selected_step,
    surface_chart,
)
from trackwright.experiments.pages.reports.pages import page, write_page
from trackwright.experiments.pages.reports.tuning_data import MetricChange, OptimiserTrace, TuningReportData
from trackwright.experiments.text.wording import MISSING, number, percent_change, uncapitalised
from trackwright.trackers.core.wording import counted

SAME = 0.1
"""The relative difference of values up to which two starts end at one point, as the optimiser has it."""


def write_tuning_report(path: Path | str, data: TuningReportData) -> Path:
    """Writes the page whole or not at all; returns the path. Raises UnusableInput where it can't be written."""
    return write_page(path, tuning_page(data))


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
    values, objectives = (np.array(x) for x in zip(*map(_end, traces), strict=True))
    away = np.abs(values - values[0]) / np.maximum(np.abs(values[0]), np.finfo(float).tiny)
    same = away.max(axis=1) <= SAME
    others = len(same) - int(same.sum())
    if not others:
        return f"All {len(same)} starts end at one point (values within a tenth)."
    lower = int(np.sum(objectives[~same] < objectives[0]))
    below = f", {lower} of them with a lower objective" if lower else ", none with a lower objective"
    agreeing = f"{int(same.sum())} of {counted(len(same), 'start')} end at the selected point (values within a tenth)"
    return f"{agreeing}; {others} end elsewhere{below}: the optimum is not certain."


def _end(trace: OptimiserTrace) -> tuple[np.ndarray, float]:
    """The values (p,) and the objective of the best step from a start."""
    best = int(np.argmin(np.where(np.isfinite(trace.objective), trace.objective, np.inf)))
    return trace.values[best], float(trace.objective[best])


class Change(NamedTuple):
    """The change of a metric in words; `kind`: better, worse or neither."""

    text: str
    kind: str = ""


def _changed(metric: MetricChange, pair: tuple[float, float]) -> Change:
    """The change as a difference or in per cent where that has a meaning, and as a word where it matters."""
    if not all(map(math.isfinite, pair)):
        return Change(MISSING)
    if pair[0] == pair[1]:
        return Change("same")
    change = ""
    if metric.unit == "nats":  # log-densities have no natural zero
        change = ("+" if pair[1] >= pair[0] else "") + number(pair[1] - pair[0])
    elif metric.unit != "1":  # distances between distributions are near zero for a good filter
        change = percent_change(*pair)
    if is_worse(metric, pair):
        return Change(f"{change} worse".strip(), "worse")
    if is_better(metric, pair):
        return Change(change or "better", "better")
    return Change(change or "same")


def _charts(data: TuningReportData) -> dict[str, Any]:
    """The charts of the page by section."""
    charts: dict[str, Any] = {"consistency": (), "errors": {}, "plans": ()}
    if data.plans is not None:
        charts["plans"] = [(plan_chart(change), change) for change in data.plans.shown]
    if data.traces:
        charts["objective"] = objective_chart(data.traces, data.objective_about, selected_step(data))
        charts["parameters"] = [
            parameter_chart(data.traces, k, parameter.name, named(parameter.name, parameter.unit))
            for k, parameter in enumerate(data.parameters)
        ]
        if data.surface is not None:
            charts["surface"] = surface_chart(data, data.surface)
    if data.innovations is not None and min(len(side.nis) for side in data.innovations):
        charts["consistency"] = innovation_charts(*data.innovations)
    known = [e for e in data.errors if (e.before == e.before).any() and (e.after == e.after).any()]
    if known:
        charts["errors"] = {
            "count": len(known),
            "rmse": rmse_chart(known, data.error_unit),
            "distribution": distribution_chart(known, data.error_unit),
            "over_time": error_charts(known, data.error_unit),
        }
    return charts


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
    warnings = [*(_sentence(text) for text in data.cautions), *_undetermined(data)]
    best = data.metric(data.objective)
    parts = [_change(best, best.training) if best else f"{data.objective_about} was tuned"]
    determined = [p.determined for p in data.parameters]
    if determined and None not in determined:
        parts.append(_determined(determined.count(True), len(determined)))
    elif False in determined:
        parts.append(f"the recordings do not determine {determined.count(False)} of {len(determined)} parameters")
    sentence = "; ".join(parts)
    if not sentence.startswith(data.objective):
        sentence = sentence[0].upper() + sentence[1:]
    if data.compared is None:
        return Advice("Not judged.", f"{sentence}.", False, tuple(warnings))
    verdict, about = data.compared.verdict, data.compared.about
    summary, word = f"{verdict.sentence(about)} {sentence}.", f"{verdict.word.capitalize()}."
    return Advice(word, summary, verdict.word == "better", (*verdict.got_worse, *warnings))


def is_worse(metric: MetricChange, pair: tuple[float, float]) -> bool:
    """Whether the metric increased by more than `WORSE`, or `WORSE_BY`."""
    before, after = pair
    if not (math.isfinite(before) and math.isfinite(after)):
        return math.isfinite(before)
    return after > before + (WORSE * before if metric.unit != "nats" else WORSE_BY)


def is_better(metric: MetricChange, pair: tuple[float, float]) -> bool:
    """Whether the metric decreased by as much."""
    return all(math.isfinite(x) for x in pair) and is_worse(metric, (pair[1], pair[0]))


def _change(metric: MetricChange, pair: tuple[float, float]) -> str:
    unit = f" {metric.unit}"
    relative = percent_change(*pair) if metric.unit != "nats" else ""
    change = f" ({relative})" if relative else ""
    return f"{uncapitalised(metric.title)} changed from {number(pair[0])} to {number(pair[1])}{unit}{change}"


def _undetermined(data: TuningReportData) -> list[str]:
    """Warnings on undetermined parameters: the sentences of the fit, else their names."""
    if data.issues:
        *others, last = data.issues
        return [*(f"{text}." for text in others), f"{last}. {ADVICE}"]
    names = [p.name for p in data.parameters if p.determined is False]
    return (
        [f"The recordings do not determine {', '.join(names)}: other values fit equally well. {ADVICE}"]
        if names
        else []
    )


def _sentence(clause: str) -> str:
    """A clause as a sentence; one that begins with the name of a parameter keeps its case."""
    first = clause.split(" ", 1)[0]
    return (clause if "." in first else clause[0].upper() + clause[1:]) + "."


def _determined(known: int, all_of_them: int) -> str:
    if all_of_them == 1:
        return f"the recordings {'determine' if known else 'do not determine'} the parameter"
    if known == all_of_them:
        return f"the recordings determine {'both' if known == 2 else f'all {known}'} parameters"
    return f"the recordings determine {known or 'none'} of {all_of_them} parameters"

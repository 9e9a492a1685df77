"""The report of a tuning run as an HTML page."""

from __future__ import annotations

import math
from collections.abc import Sequence
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
from trackwright.experiments.pages.reports.advice import advice_on, is_better, is_worse
from trackwright.experiments.pages.reports.pages import page, write_page
from trackwright.experiments.pages.reports.tuning_data import MetricChange, OptimiserTrace, TuningReportData
from trackwright.experiments.text.wording import MISSING, number, percent_change
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

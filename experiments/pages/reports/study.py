"""The report of a study: its metrics and expected results as text, as JSON, and as a page with charts."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from trackwright.experiments.monte_carlo.declaration import Study
from trackwright.experiments.monte_carlo.results import NAMES, Results
from trackwright.experiments.pages.charts.study import SHOWN_CONDITIONS, distribution_charts, metric_chart
from trackwright.experiments.pages.charts.style import Chart
from trackwright.experiments.pages.reports.pages import report_page, typed
from trackwright.experiments.text.expectations import (
    Claim,
    Conclusion,
    ExpectedResult,
    headline,
    ratio_text,
    with_interval,
)
from trackwright.experiments.text.tables import Section, aligned, sections_text
from trackwright.experiments.text.wording import Unit, heading, units_of, yes_no
from trackwright.trackers.recordings.atomic import json_text

WIDTH = 160
REPORT = "report.html"
MOST_CHARTS = 4

BOUNDS = {"rmse_m": "bound_m", "rmse_3d_m": "bound_3d_m"}
"""The bound that is drawn as a line among the values of a metric, instead of in a chart of its own."""


def study_page(results: Results, expected: Sequence[Claim], command: Sequence[str]) -> str:
    """The page."""
    study = results.study
    lead = "Bands and bars are 95 % intervals."
    if len(study.conditions) > SHOWN_CONDITIONS:
        lead += f" Distributions of the first {SHOWN_CONDITIONS} of {len(study.conditions)} conditions."
    metrics = metrics_section(results)
    metrics = metrics._replace(note=f"{metrics.note} {results.without_bound()}".rstrip())
    settings = {
        "Worlds": "; ".join(study.worlds),
        "Trackers": "; ".join(study.trackers),
        "Grid": "; ".join(f"{k}: {', '.join(map(str, v))}" for k, v in study.grid.items()) or "none",
        "Runs": f"{study.runs} per condition, seed {study.seed}, in chunks of {study.chunk}",
    }
    sections = [
        *expected_sections(expected),
        Section("Charts", note=lead, parts=[group for group in study_charts(results) if group]),
        metrics,
        ratios_section(results),
        Section("Settings", parts=[settings]),
    ]
    # A hyphen between numbers stays: "figures-6-7" are Figures 6-7.
    title = re.sub(r"-(?!\d)|(?<!\d)-", " ", study.name).capitalize()
    counts = headline_of(expected) if expected else ""
    return report_page("study", title, [study.about, counts], sections, [typed(command)])


def study_charts(results: Results) -> tuple[list[Chart], list[Chart]]:
    """The charts of the first metrics, and of the distributions of errors."""
    metrics, units = results.main_metrics(), main_units(results)
    drawn = [m for m in results.study.metrics if m != "us_per_row"][:MOST_CHARTS]
    bounds = {m: metrics[BOUNDS[m]] for m in drawn if BOUNDS.get(m) in metrics}
    drawn = [m for m in drawn if m not in {BOUNDS[error] for error in bounds}]
    drawings = (metric_chart(results, m, metrics[m], units[m], bounds.get(m)) for m in drawn)
    lengths = next((unit for metric, unit in units.items() if metric.endswith("_m")), None)
    return [chart for chart in drawings if chart is not None], distribution_charts(results, lengths)


def to_text(results: Results, expected: Sequence[Claim]) -> str:
    """The main metrics of every condition and tracker, and the expected results beside ours."""
    reproduced = expected_sections(expected)
    said = headline_of(expected) if any(section.rows for section in reproduced) else ""
    return sections_text([metrics_section(results), *reproduced], WIDTH, results.without_bound(), said)


def main_units(results: Results) -> dict[str, Unit]:
    """The units of the main metrics."""
    return units_of({m: [v.value for v in values.values()] for m, values in results.main_metrics().items()})


def headline_of(expected: Sequence[Claim]) -> str:
    """How many of the expected results are predicted, fitted and derived, and how many of them are reached."""
    return headline(
        [(c.origin, c.reached) for c in expected if isinstance(c, ExpectedResult)],
        [(c.origin, c.holds) for c in expected if isinstance(c, Conclusion)],
    )


def metrics_section(results: Results) -> Section:
    """The main metrics of every condition and tracker, with intervals."""
    study, units, shown = results.study, main_units(results), results.main_metrics()
    rows = [
        [c.label, t, *(with_interval(values[c.index, t], units[metric]) for metric, values in shown.items())]
        for c in study.conditions
        for t in study.trackers
    ]
    runs = " to ".join(map(str, dict.fromkeys(f(results.runs.values()) for f in (min, max))))
    note = f"{runs} trajectories per row, the same for all trackers. In brackets 95 % bootstrap intervals."
    if any(metric.startswith("bound") for metric in study.metrics):
        note += " The bound is for the tracker's own noise levels, over the second half of the rows."
    head = ["world", "tracker", *(heading(metric, units[metric], "\u00a0") for metric in shown)]
    return Section("Metrics", head, rows, 2, note)


def ratios_section(results: Results) -> Section:
    """All metrics relative to the first tracker's; no rows without another one."""
    study = results.study
    first, *others = study.trackers
    head, rows = ["world", "tracker"], [[c.label, t] for c in study.conditions for t in others]
    for metric in study.metrics:
        if metric in ("bound_m", "bound_3d_m", "us_per_row"):
            continue
        ratios = [results.compared(_divided, metric, c, t, first) for c in study.conditions for t in others]
        if any(np.isfinite(ratio.value) for ratio in ratios):
            head.append(heading(metric))
            for row, ratio in zip(rows, ratios, strict=True):
                row.append(with_interval(ratio))
    note = f"Each metric divided by that of “{first}”, paired: variation common to both does not widen the interval."
    return Section("Ratios to the first tracker", head, rows if len(head) > 2 else [], 2, note)


def _divided(a: Any, b: Any) -> Any:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.divide(a, b)


def expected_sections(expected: Sequence[Claim]) -> list[Section]:
    """The printed numbers beside ours, and the conclusions."""
    numbers = [c for c in expected if isinstance(c, ExpectedResult)]
    rows = [
        [r.quantity, f"{r.printed:g}\u00a0{r.unit}", with_interval(r.ours, Unit(r.unit, 1.0)),
         ratio_text(r.ratio, r.compares_rest), r.origin, yes_no(r.reached), r.note]
        for r in numbers
    ]  # fmt: skip
    asked = [r for r in numbers if r.reached is not None]
    within = " or ".join(f"{100 * width:g} %" for width in sorted({r.within for r in asked if r.within is not None}))
    note = f"Within tolerance: at most {within} from the printed value. " if asked else ""
    note += (
        "Fitted: parameters or a choice were adjusted to the printed value; derived: it follows from other numbers and "
        "is not judged again; predicted: neither."
    )
    if any(r.compares_rest for r in numbers):
        note += " Shares above one half are compared by the rest."
    head = ["result", "printed", "ours (95 % interval)", "ours / printed", "origin", "within tolerance", "remark"]
    shown = len(head) if any(r.note for r in numbers) else len(head) - 1
    looks = {"ours (95 % interval)": "after", "within tolerance": "answer", "remark": "long"}
    printed = Section("Printed and reproduced results", head[:shown], [r[:shown] for r in rows], 1, note, looks)
    held = [[c.statement, c.origin, yes_no(c.holds), c.evidence] for c in expected if isinstance(c, Conclusion)]
    looks = {"origin": "", "holds": "answer", "evidence": "long"}
    return [printed, Section("Conclusions", ["conclusion", *looks], held, 4, "", looks)]


def to_json(results: Results, expected: Sequence[Claim]) -> str:
    """All metrics of every condition and tracker with intervals, and the differences from the first tracker."""
    metrics = _all_metrics(results)
    return json_text(
        {
            "study": results.study.name,
            "about": results.study.about,
            "seed": results.study.seed,
            "sha256": digest(metrics),
            "computing_s": results.seconds,
            "cells": metrics,
            "us_per_row": {
                c.label: {t: results.at("us_per_row", c, t).value for t in results.study.trackers}
                for c in results.study.conditions
            },
            "claims": [_claim(c) for c in expected],
        }
    )


def digest(metrics: Any) -> str:
    """The SHA-256 of all metrics but the computing times, which differ from run to run."""
    return hashlib.sha256(json_text(metrics).encode()).hexdigest()


def _all_metrics(results: Results) -> list[dict[str, Any]]:
    study, made = results.study, []
    names = [*(n for n in NAMES if n != "us_per_row"), *study.measures]
    reference = next(iter(study.trackers))
    for condition in study.conditions:
        for tracker in study.trackers:
            values = {n: results.at(n, condition, tracker) for n in names}
            known = {n: v for n, v in values.items() if v.value == v.value}
            paired = known if tracker != reference else ()
            compared = {n: results.compared(np.subtract, n, condition, tracker, reference) for n in paired}
            differences = {n: v._asdict() for n, v in compared.items() if v.value == v.value}
            made.append(
                {
                    "world": condition.world,
                    "point": dict(condition.point),
                    "tracker": tracker,
                    "runs": results.runs[condition.index],
                    "figures": {n: v._asdict() for n, v in known.items()},
                    f"less {reference}": differences,
                }
            )
    return made


def _claim(claim: Claim) -> dict[str, Any]:
    if isinstance(claim, Conclusion):
        return {"says": claim.statement, "holds": claim.holds, "evidence": claim.evidence, "origin": claim.origin.value}
    names = "printed", "unit", "ratio", "compares_rest", "origin", "reached", "note"
    same = {name: getattr(claim, name) for name in names}
    return {"figure": claim.quantity, **same, "ours": claim.ours._asdict(), "origin": claim.origin.value}


def study_names(studies: Sequence[Study]) -> str:
    """Names and questions of the studies, for `--list`."""
    return aligned([(s.name, s.about) for s in studies])

"""The report of a study as an HTML page, for desktop, phone and paper."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from trackwright.experiments.monte_carlo.declaration import Study
from trackwright.experiments.monte_carlo.results import Results
from trackwright.experiments.pages.charts.study import SHOWN_CONDITIONS, distribution_charts, metric_chart
from trackwright.experiments.pages.charts.style import Chart
from trackwright.experiments.pages.reports.pages import page, write_page
from trackwright.experiments.pages.reports.study_text import conclusion_rows, headline_of, main_units
from trackwright.experiments.text.expectations import Conclusion, ExpectedResult, ratio_text, with_interval
from trackwright.experiments.text.wording import Unit, heading, yes_no

REPORT = "report.html"
MOST_CHARTS = 4

BOUNDS = {"rmse_m": "bound_m", "rmse_3d_m": "bound_3d_m"}
"""The bound that is drawn as a line among the values of a metric, instead of in a chart of its own."""

Expected = Sequence[ExpectedResult | Conclusion]


class Table(NamedTuple):
    """A table of the page with the sentence above it; `classes` of its columns as in the template."""

    lead: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    classes: Sequence[str]


def write_study_report(folder: Path, results: Results, expected: Expected, command: Sequence[str]) -> Path:
    """Writes the page into the folder, whole or not at all; returns its path."""
    return write_page(folder / REPORT, study_page(results, expected, command))


def study_page(results: Results, expected: Expected, command: Sequence[str]) -> str:
    """The report as HTML."""
    study, units = results.study, main_units(results)
    charts, distributions = study_charts(results)
    more = len(study.conditions) > SHOWN_CONDITIONS
    return page(
        "study.html",
        command,
        # A hyphen between numbers stays: "figures-6-7" are Figures 6-7.
        title=re.sub(r"-(?!\d)|(?<!\d)-", " ", study.name).capitalize(),
        about=study.about,
        expected=_expected([c for c in expected if isinstance(c, ExpectedResult)]),
        conclusions=conclusion_rows(expected),
        counts=headline_of(expected),
        charts=charts,
        distributions=distributions,
        charts_lead="Bands and bars are 95 % intervals."
        + (f" Distributions of the first {SHOWN_CONDITIONS} of {len(study.conditions)} conditions." if more else ""),
        metrics=_metrics(results, units),
        ratios=_ratios(results),
        settings=_settings(study),
    )


def study_charts(results: Results) -> tuple[list[Chart], list[Chart]]:
    """The charts of the first metrics, and of the distributions of errors."""
    metrics, units = results.main_metrics(), main_units(results)
    drawn = [m for m in results.study.metrics if m != "us_per_row"][:MOST_CHARTS]
    bounds = {m: metrics[BOUNDS[m]] for m in drawn if BOUNDS.get(m) in metrics}
    drawn = [m for m in drawn if m not in {BOUNDS[error] for error in bounds}]
    drawings = (metric_chart(results, m, metrics[m], units[m], bounds.get(m)) for m in drawn)
    lengths = next((unit for metric, unit in units.items() if metric.endswith("_m")), None)
    return [chart for chart in drawings if chart is not None], distribution_charts(results, lengths)


def _expected(results: Sequence[ExpectedResult]) -> Table:
    rows = [
        [r.quantity, f"{r.printed:g}\u00a0{r.unit}", with_interval(r.ours, Unit(r.unit, 1.0)),
         ratio_text(r.ratio, r.compares_rest), r.origin, yes_no(r.reached), r.note]
        for r in results
    ]  # fmt: skip
    asked = [r for r in results if r.reached is not None]
    within = " or ".join(f"{100 * width:g} %" for width in sorted({r.within for r in asked if r.within is not None}))
    lead = (
        "Fitted: parameters or a choice were adjusted to the printed value; derived: it follows from other numbers and "
        "is not judged again; predicted: neither."
    )
    if asked:
        lead = f"Within tolerance: at most {within} from the printed value. {lead}"
    if any(r.compares_rest for r in results):
        lead += " Shares above one half are compared by the rest."
    head = ["result", "printed", "ours (95 % interval)", "ours / printed", "origin", "within tolerance", "remark"]
    shown = len(head) if any(r.note for r in results) else len(head) - 1
    return Table(lead, head[:shown], [row[:shown] for row in rows], ["", "", "after", "", "", "answer", "long"][:shown])


def _metrics(results: Results, units: dict[str, Unit]) -> Table:
    study, columns = results.study, []
    head = ["world", "tracker"]
    for metric, values in results.main_metrics().items():
        head.append(heading(metric, units[metric], "\u00a0"))
        columns.append({k: with_interval(v, units[metric]) for k, v in values.items()})
    rows = [[c.label, t, *(column[c.index, t] for column in columns)] for c in study.conditions for t in study.trackers]
    counts = sorted(set(results.runs.values()))
    runs = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    lead = f"{runs} trajectories per row, the same for all trackers. In brackets 95 % bootstrap intervals."
    if any(metric.startswith("bound") for metric in study.metrics):
        lead += " The bound is for the tracker's own noise levels, over the second half of the rows."
        lead += f" {results.without_bound()}".rstrip()
    return Table(lead, head, rows, ["", "text", *[""] * len(columns)])


def _ratios(results: Results) -> Table | None:
    """All metrics relative to those of the first tracker."""
    study = results.study
    first, *others = study.trackers
    head, columns = ["world", "tracker"], []
    pairs = [(c, t) for c in study.conditions for t in others]
    for metric in study.metrics:
        if not others or metric in ("bound_m", "bound_3d_m", "us_per_row"):
            continue
        ratios = [results.compared(_divided, metric, c, t, first) for c, t in pairs]
        if any(np.isfinite(v.value) for v in ratios):
            head.append(heading(metric))
            columns.append([with_interval(v) for v in ratios])
    if not columns:
        return None
    rows = [[c.label, t, *(column[k] for column in columns)] for k, (c, t) in enumerate(pairs)]
    lead = f"Each metric divided by that of “{first}”, paired: variation common to both does not widen the interval."
    return Table(lead, head, rows, ["", "text", *[""] * len(columns)])


def _divided(a: Any, b: Any) -> Any:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.divide(a, b)


def _settings(study: Study) -> list[tuple[str, str]]:
    grid = "; ".join(f"{k}: {', '.join(map(str, v))}" for k, v in study.grid.items())
    return [
        ("Worlds", "; ".join(study.worlds)),
        ("Trackers", "; ".join(study.trackers)),
        ("Grid", grid or "none"),
        ("Runs", f"{study.runs} per condition, seed {study.seed}, in chunks of {study.chunk}"),
    ]

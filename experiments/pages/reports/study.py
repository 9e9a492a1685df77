"""The report of a study as an HTML page, for desktop, phone and paper."""

from __future__ import annotations

import re
from collections.abc import Sequence

from trackwright.experiments.monte_carlo.declaration import Study
from trackwright.experiments.monte_carlo.results import Results
from trackwright.experiments.pages.charts.study import SHOWN_CONDITIONS, distribution_charts, metric_chart
from trackwright.experiments.pages.charts.style import Chart
from trackwright.experiments.pages.reports.pages import page
from trackwright.experiments.pages.reports.study_text import (
    expected_sections,
    headline_of,
    main_units,
    metrics_section,
    ratios_section,
)
from trackwright.experiments.text.expectations import Claim

REPORT = "report.html"
MOST_CHARTS = 4

BOUNDS = {"rmse_m": "bound_m", "rmse_3d_m": "bound_3d_m"}
"""The bound that is drawn as a line among the values of a metric, instead of in a chart of its own."""


def study_page(results: Results, expected: Sequence[Claim], command: Sequence[str]) -> str:
    """The page."""
    study = results.study
    charts, distributions = study_charts(results)
    more = len(study.conditions) > SHOWN_CONDITIONS
    metrics = metrics_section(results)
    metrics = metrics._replace(note=f"{metrics.note} {results.without_bound()}".rstrip())
    return page(
        "study.html",
        command,
        # A hyphen between numbers stays: "figures-6-7" are Figures 6-7.
        title=re.sub(r"-(?!\d)|(?<!\d)-", " ", study.name).capitalize(),
        about=study.about,
        counts=headline_of(expected) if expected else "",
        reproduced=[section for section in expected_sections(expected) if section.rows],
        charts=charts,
        distributions=distributions,
        charts_lead="Bands and bars are 95 % intervals."
        + (f" Distributions of the first {SHOWN_CONDITIONS} of {len(study.conditions)} conditions." if more else ""),
        measured=[section for section in (metrics, ratios_section(results)) if section.rows],
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


def _settings(study: Study) -> list[tuple[str, str]]:
    grid = "; ".join(f"{k}: {', '.join(map(str, v))}" for k, v in study.grid.items())
    return [
        ("Worlds", "; ".join(study.worlds)),
        ("Trackers", "; ".join(study.trackers)),
        ("Grid", grid or "none"),
        ("Runs", f"{study.runs} per condition, seed {study.seed}, in chunks of {study.chunk}"),
    ]

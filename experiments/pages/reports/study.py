"""The report of a study: its metrics and expected results as text, as JSON, and as a page with charts."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from trackwright.experiments.monte_carlo.declaration import Study, short
from trackwright.experiments.monte_carlo.results import NAMES, Results
from trackwright.experiments.pages.charts.distributions import Curve, distribution
from trackwright.experiments.pages.charts.style import INK, LINES, Chart, Line, band, is_logarithmic, rule
from trackwright.experiments.pages.reports.pages import report_page, typed
from trackwright.experiments.text.expectations import (
    Claim,
    Conclusion,
    ExpectedResult,
    Value,
    headline,
    ratio_text,
    with_interval,
)
from trackwright.experiments.text.tables import Section, aligned, sections_text
from trackwright.experiments.text.wording import Unit, heading, unit_of, units_of, yes_no
from trackwright.trackers.evaluation.metrics import ERROR_KINDS, METRICS
from trackwright.trackers.recordings.atomic import json_text

REPORT = "report.html"
MOST_CHARTS, SHOWN_CONDITIONS, LINES_SHOWN, ROWS_SHOWN = 4, 6, 8, 40
"""The most metrics with a chart, conditions with distributions, and lines and rows in a chart."""

DECADES = 30.0
"""Ratio of the largest to the smallest value from which an axis is logarithmic."""

DASHES, MARKS = ("solid", "dash", "dashdot", "dot"), ("circle", "square", "diamond", "triangle-up", "triangle-down")
BOUNDS = {"rmse_m": "bound_m", "rmse_3d_m": "bound_3d_m"}
"""The bound that is drawn as a line among the values of a metric, instead of in a chart of its own."""

Values = Mapping[tuple[int, str], Value]


def study_page(results: Results, expected: Sequence[Claim], command: Sequence[str]) -> str:
    """The page."""
    study, metrics = results.study, metrics_section(results)
    lead = "Bands and bars are 95 % intervals."
    if len(study.conditions) > SHOWN_CONDITIONS:
        lead += f" Distributions of the first {SHOWN_CONDITIONS} of {len(study.conditions)} conditions."
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
    return report_page(
        "study", title, [study.about, headline_of(expected) if expected else ""], sections, [typed(command)]
    )


def to_text(results: Results, expected: Sequence[Claim]) -> str:
    """The main metrics of every condition and tracker, and the expected results beside ours."""
    reproduced = expected_sections(expected)
    said = headline_of(expected) if any(section.rows for section in reproduced) else ""
    return sections_text([metrics_section(results), *reproduced], 160, said)


def study_charts(results: Results) -> tuple[list[Chart], list[Chart]]:
    """The charts of the first metrics, and of the distributions of errors."""
    metrics, units = results.main_metrics(), _units(results)
    drawn = [m for m in results.study.metrics if m != "us_per_row"][:MOST_CHARTS]
    bounds = {m: metrics[BOUNDS[m]] for m in drawn if BOUNDS.get(m) in metrics}
    drawn = [m for m in drawn if m not in {BOUNDS[error] for error in bounds}]
    drawings = [metric_chart(results, m, metrics[m], units[m], bounds.get(m, {})) for m in drawn]
    lengths = next((unit for metric, unit in units.items() if metric.endswith("_m")), None)
    return [chart for chart in drawings if chart is not None], [*_distributions(results, lengths)]


def metric_chart(results: Results, metric: str, found: Values, unit: Unit, bounds: Values) -> Chart | None:
    """A metric with its intervals: along the grid where that is one list of numbers, else by condition.

    None where a chart has no room for all lines or rows, and where all values are zero or missing. `bounds`: Cramér–Rao
    bounds on the metric, drawn as lines, or as strokes in rows.
    """
    study, grid = results.study, _grid(results.study)
    values = {k: np.array(v.times(unit.factor)) for k, v in found.items() if np.isfinite(v.value)}
    room = len(values) <= ROWS_SHOWN if grid is None else len(study.worlds) * len(study.trackers) <= LINES_SHOWN
    if not room or not any(v[0] for v in values.values()):
        return None
    limits = {k: v.value * unit.factor for k, v in bounds.items() if np.isfinite(v.value)}
    right, pooled = METRICS[metric].right if metric in METRICS else None, np.concatenate([*values.values()])
    target = None if right is None else right * unit.factor
    log = is_logarithmic(pooled, DECADES)
    ends = (None, None) if log else (0.0, 1.04 * max(target or 0.0, float(np.nanmax(pooled)), *limits.values(), 0.0))
    title = heading(metric, unit)
    title = title[0].upper() + title[1:]
    look: dict[str, Any] = {"colour": INK, "dash": "dash", "name": f"{target:g} expected" if target else ""}
    if grid is None:
        lines, names = _rows(study, values, limits)
        if target is not None:
            lines.append(rule(target, (-0.6, len(names) - 0.4), upright=True, **look))
        more: dict[str, Any] = {"yticks": dict(enumerate(names)), "height": max(1.3, 0.9 + 0.24 * len(names))}
        return Chart(metric, title, "", "", lines, ends, (len(names) - 0.4, -0.6), log="x" * log, **more)
    along, points = grid
    lines = _lines(study, values, limits, along)
    lines += [] if target is None else [rule(target, (points[0], points[-1]), **look)]
    logs = "x" * is_logarithmic(points, 8.0) + "y" * log
    ticks = {v: f"{v:g}" for v in points} if "x" in logs else None
    return Chart(metric, title, short(along), "", lines, ylim=ends, log=logs, xticks=ticks)


def _grid(study: Study) -> tuple[str, list[float]] | None:
    """The grid's only axis, where that has more than two values, all numbers, and these in order; else None."""
    axes = [(name, sorted(of)) for name, of in study.grid.items() if all(type(v) in (int, float) for v in of)]
    return axes[0] if len(axes) == len(study.grid) == 1 and len(axes[0][1]) > 2 else None


def _look(number: int) -> dict[str, Any]:
    return {"colour": LINES[number % len(LINES)], "dash": DASHES[number % len(DASHES)]}


def _lines(study: Study, values: Mapping[Any, np.ndarray], limits: Mapping[Any, float], along: str) -> list[Line]:
    """A line with its band for every world and tracker over the grid, and its bound."""
    parts = list[Line]()
    for number, (world, tracker) in enumerate((w, t) for w in study.worlds for t in study.trackers):
        there = [c for c in study.conditions if c.world == world and (c.index, tracker) in values]
        if there:
            middle, low, high = np.array([values[c.index, tracker] for c in there]).T
            look, x = _look(number), [float(c.point[along]) for c in there]
            name = tracker if len(study.worlds) == 1 else f"{world}: {tracker}"
            parts.append(band(x, low, high, "", look["colour"], 0.18))
            parts.append(Line(x, middle, name, **look, marker=MARKS[number % len(MARKS)], size=4))
            bound = np.array([limits.get((c.index, tracker), np.nan) for c in there])
            if np.isfinite(bound).any():
                parts.append(Line(x, bound, f"{name}: Cramér–Rao bound", look["colour"], dash="dot"))
    return parts


def _rows(study: Study, values: Mapping[Any, np.ndarray], limits: Mapping[Any, float]) -> tuple[list[Line], list[str]]:
    """Points with intervals, a row for every condition and tracker, strokes for bounds; and the names of the rows."""
    names, parts = list[str](), list[Line]()
    pairs = [(c, t) for c in study.conditions for t in study.trackers if (c.index, t) in values]
    for k, (condition, tracker) in enumerate(pairs):
        number, key = list(study.trackers).index(tracker), (condition.index, tracker)
        colour, (middle, low, high) = LINES[number % len(LINES)], values[key]
        parts.append(Line([low, high], [k, k], "", colour, 3.0, opacity=0.35))
        parts.append(Line([middle], [k], "", colour, 0.0, marker=MARKS[number % len(MARKS)]))
        words = [condition.label] * (len(study.conditions) > 1) + [tracker] * (len(study.trackers) > 1)
        names.append(": ".join(words) or condition.label)
    strokes = {k: limits[c.index, t] for k, (c, t) in enumerate(pairs) if (c.index, t) in limits}
    if strokes:
        parts.append(Line([*strokes.values()], [*strokes], "Cramér–Rao bound", INK, 0.0, marker="line-ns-open", size=9))
    return parts, names


def _distributions(results: Results, lengths: Unit | None) -> Iterator[Chart]:
    """Distribution functions of every tracker's errors, for the first conditions, up to 98 % of the largest.

    `lengths`: the page's unit of lengths, or None.
    """
    study = results.study
    for number, condition in enumerate(study.conditions[:SHOWN_CONDITIONS], 1):
        there = {t: results.totals[condition.index, t].histograms for t in study.trackers}
        # The kind of error of the first metric that has one; the longer suffixes first: `3d_m` ends in `m` too.
        kinds = sorted({kind for histograms in there.values() for kind in histograms}, key=len, reverse=True)
        asked = (k for metric in study.metrics for k in kinds if metric.endswith(f"_{k}"))
        kind = next(asked, next(k for k in ERROR_KINDS if k in kinds))
        medians = [results.at(f"median_{kind}", condition, tracker).value for tracker in study.trackers]
        unit = lengths if lengths and kind.endswith("m") else unit_of(f"median_{kind}", medians)
        curves = {}
        for k, tracker in enumerate(study.trackers):
            if kind in there[tracker]:
                edges, share = results.cdf(condition.world, tracker, kind, **condition.point)
                curves[k] = Curve(tracker, edges * unit.factor, 100 * share)
        end = max(float(curve.errors[np.searchsorted(curve.shares, 98.0)]) for curve in curves.values())
        quantity, looks = f"{f'error {ERROR_KINDS[kind]}'.strip()}, {unit.name}", [*map(_look, curves)]
        title = f"Distribution of errors: {condition.label}"
        yield distribution(f"errors-{number}", title, [*curves.values()], quantity, end, looks=looks)


def _units(results: Results) -> dict[str, Unit]:
    return units_of({m: [v.value for v in values.values()] for m, values in results.main_metrics().items()})


def headline_of(expected: Sequence[Claim]) -> str:
    """How many of the expected results are predicted, fitted and derived, and how many of them are reached."""
    return headline(
        [(c.origin, c.reached) for c in expected if isinstance(c, ExpectedResult)],
        [(c.origin, c.holds) for c in expected if isinstance(c, Conclusion)],
    )


def metrics_section(results: Results) -> Section:
    """The main metrics of every condition and tracker, with intervals."""
    study, units, shown = results.study, _units(results), results.main_metrics()
    rows = [
        [c.label, t, *(with_interval(values[c.index, t], units[metric]) for metric, values in shown.items())]
        for c in study.conditions
        for t in study.trackers
    ]
    note = (
        f"{results.study.runs} trajectories per row, the same for all trackers. In brackets 95 % bootstrap intervals."
    )
    if any(metric.startswith("bound") for metric in study.metrics):
        note += " The bound is for the tracker's own noise levels, over the second half of the rows."
    head = ["world", "tracker", *(heading(metric, units[metric], "\u00a0") for metric in shown)]
    return Section("Metrics", head, rows, 2, note)


def ratios_section(results: Results) -> Section:
    """All metrics relative to the first tracker's; no rows without another one."""
    study = results.study
    first, *others = study.trackers
    pairs, ratios = [(c, t) for c in study.conditions for t in others], {}
    for metric in (m for m in study.metrics if m not in ("bound_m", "bound_3d_m", "us_per_row")):
        of = [results.compared(_divided, metric, c, t, first) for c, t in pairs]
        if any(np.isfinite(ratio.value) for ratio in of):
            ratios[heading(metric)] = of
    rows = [[c.label, t, *(with_interval(of[k]) for of in ratios.values())] for k, (c, t) in enumerate(pairs)]
    note = f"Each metric over that of “{first}”, paired: variation common to both does not widen the interval."
    return Section("Ratios to the first tracker", ["world", "tracker", *ratios], rows if ratios else [], 2, note)


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
    widths = sorted({r.within for r in numbers if r.reached is not None and r.within is not None})
    within = " or ".join(f"{100 * width:g} %" for width in widths)
    note = f"Within tolerance: at most {within} from the printed value. " if within else ""
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
    """All metrics of every condition and tracker with intervals, and the differences from the first tracker.

    `sha256`: of all metrics but the computing times, which differ from run to run.
    """
    study, cells = results.study, [*_cells(results)]
    times = {c.label: {t: results.at("us_per_row", c, t).value for t in study.trackers} for c in study.conditions}
    digest = hashlib.sha256(json_text(cells).encode()).hexdigest()
    head = {"study": study.name, "about": study.about, "seed": study.seed, "sha256": digest}
    claims = [*map(_claim, expected)]
    return json_text({**head, "computing_s": results.seconds, "cells": cells, "us_per_row": times, "claims": claims})


def _cells(results: Results) -> Iterator[dict[str, Any]]:
    study = results.study
    names, reference = [*(n for n in NAMES if n != "us_per_row"), *study.measures], next(iter(study.trackers))
    for c, tracker in ((c, tracker) for c in study.conditions for tracker in study.trackers):
        known = {n: v for n in names if (v := results.at(n, c, tracker)).value == v.value}
        compared = {n: results.compared(np.subtract, n, c, tracker, reference) for n in known if tracker != reference}
        cell = {"world": c.world, "point": dict(c.point), "tracker": tracker, "runs": results.study.runs}
        yield cell | {
            "figures": {n: v._asdict() for n, v in known.items()},
            f"less {reference}": {n: v._asdict() for n, v in compared.items() if v.value == v.value},
        }


def _claim(claim: Claim) -> dict[str, Any]:
    if isinstance(claim, Conclusion):
        return {"says": claim.statement, "holds": claim.holds, "evidence": claim.evidence, "origin": claim.origin.value}
    names = "printed", "unit", "ratio", "compares_rest", "origin", "reached", "note"
    same = {name: getattr(claim, name) for name in names}
    return {"figure": claim.quantity, **same, "ours": claim.ours._asdict(), "origin": claim.origin.value}


def study_names(studies: Sequence[Study]) -> str:
    """Names and questions of the studies, for `--list`."""
    return aligned([(s.name, s.about) for s in studies])

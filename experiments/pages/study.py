"""The report of a study: its metrics and expected results as text, as JSON, and as a page with a chart."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from trackwright.experiments.monte_carlo.declaration import short
from trackwright.experiments.monte_carlo.results import NAMES, Results
from trackwright.experiments.pages.chart import LINES, Chart, Line, band, is_logarithmic
from trackwright.experiments.pages.report import report_page, typed
from trackwright.experiments.text.expectations import (
    Claim,
    Conclusion,
    ExpectedResult,
    headline,
    ratio_text,
    with_interval,
)
from trackwright.experiments.text.tables import Section, Unit, heading, sections_text, units_of, yes_no
from trackwright.trackers.recordings.files import json_text

REPORT = "report.html"


def study_page(results: Results, expected: Sequence[Claim], command: Sequence[str]) -> str:
    """The page."""
    study, metrics = results.study, metrics_section(results)
    settings = {
        "Worlds": "; ".join(study.worlds),
        "Trackers": "; ".join(study.trackers),
        "Grid": "; ".join(f"{k}: {', '.join(map(str, v))}" for k, v in study.grid.items()) or "none",
        "Runs": f"{study.runs} per condition, seed {study.seed}, in chunks of {study.chunk}",
    }
    sections = [
        *expected_sections(expected),
        Section("Chart", note="Bands and bars are 95 % intervals.", parts=[study_charts(results)]),
        metrics,
        Section("Settings", parts=[settings]),
    ]
    # A hyphen between numbers stays: "figures-6-7" are Figures 6-7.
    title = re.sub(r"-(?!\d)|(?<!\d)-", " ", study.name).capitalize()
    summary = [study.about, headline_of(expected) if expected else ""]
    return report_page("study", title, summary, sections, [typed(command)])


def to_text(results: Results, expected: Sequence[Claim]) -> str:
    """The main metrics of every condition and tracker, and the expected results beside ours."""
    said = headline_of(expected) if expected else ""
    return sections_text([metrics_section(results), *expected_sections(expected)], 160, said)


def study_charts(results: Results) -> list[Chart]:
    """The chart of the first metric with values and intervals, along a grid of one list of numbers, or by condition."""
    study, units = results.study, _units(results)
    for metric, found in results.main_metrics().items():
        known = {k: np.array(v.times(units[metric].factor)) for k, v in found.items() if np.isfinite(v.value)}
        if any(value[0] for value in known.values()):
            break
    else:
        return []
    grid, title = study.grid, heading(metric, units[metric])
    along = next(iter(grid), "")
    numeric = len(grid) == 1 and len(grid[along]) > 2 and all(type(v) in (int, float) for v in grid[along])
    lines = [(w, t) for w in study.worlds for t in study.trackers] if numeric else [(None, t) for t in study.trackers]
    parts = list[Line]()
    for k, (world, tracker) in enumerate(lines):
        own = [c for c in study.conditions if world in (None, c.world) and (c.index, tracker) in known]
        own = sorted(own, key=lambda c: c.point[along]) if numeric else own
        middle, low, high = np.reshape([known[c.index, tracker] for c in own], (-1, 3)).T
        name = tracker if world is None or len(study.worlds) == 1 else f"{world}: {tracker}"
        colour, none = LINES[k % len(LINES)], np.full(len(own), np.nan)
        if numeric:
            x = np.array([float(c.point[along]) for c in own])
            parts += [band(x, low, high, "", colour, 0.18), Line(x, middle, name, colour, marker="circle", size=4)]
        else:
            place = np.array([c.index for c in own]) + 0.6 * ((k + 0.5) / len(lines) - 0.5)
            ends = np.stack([low, high, none], 1).ravel()
            parts.append(Line(ends, np.repeat(place, 3), "", colour, 3.0, opacity=0.35))
            parts.append(Line(middle, place, name, colour, 0.0, marker="circle"))
    title = title[0].upper() + title[1:]
    if numeric:
        log = "x" * is_logarithmic(grid[along], 8.0)
        return [Chart(metric, title, short(along), "", parts, ylim=(0, None), log=log)]
    names, height = {c.index: c.label for c in study.conditions}, max(1.6, 1.1 + 0.16 * len(known))
    return [Chart(metric, title, "", "", parts, (0, None), (len(names) - 0.4, -0.6), yticks=names, height=height)]


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
    note = f"Trajectories per row: {study.runs}, the same for all trackers. In brackets 95 % bootstrap intervals."
    if any(metric.startswith("bound") for metric in study.metrics):
        note += " The bound is for the tracker's own noise levels, over the second half of the rows."
    head = ["world", "tracker", *(heading(metric, units[metric], "\u00a0") for metric in shown)]
    return Section("Metrics", head, rows, 2, note)


def expected_sections(expected: Sequence[Claim]) -> list[Section]:
    """The printed numbers beside ours, and the conclusions."""
    rows = [
        [r.quantity, r.note, f"{r.printed:g}\u00a0{r.unit}", with_interval(r.ours, Unit(r.unit, 1.0)),
         ratio_text(r.ratio, r.compares_rest), r.origin, yes_no(r.reached)]
        for r in expected if isinstance(r, ExpectedResult)
    ]  # fmt: skip
    note = (
        "Fitted: parameters or a choice were adjusted to the printed value; derived: it follows from other numbers and "
        "is not judged again; predicted: neither. Shares above one half are compared by the rest."
    )
    head = ["result", "remark", "printed", "ours (95 % interval)", "ours / printed", "origin", "within tolerance"]
    held = [[c.statement, c.evidence, c.origin, yes_no(c.holds)] for c in expected if isinstance(c, Conclusion)]
    return [
        Section("Printed and reproduced results", head, rows, 2, note),
        Section("Conclusions", ["conclusion", "evidence", "origin", "holds"], held, 2),
    ]


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
        cell = {"world": c.world, "point": dict(c.point), "tracker": tracker, "runs": study.runs}
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

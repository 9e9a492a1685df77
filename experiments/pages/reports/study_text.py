"""A study's metrics and expected results as tables for a terminal, and as JSON."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.table import Table

from trackwright.experiments.monte_carlo.declaration import Study
from trackwright.experiments.monte_carlo.results import NAMES, Results
from trackwright.experiments.text.expectations import (
    Conclusion,
    ExpectedResult,
    Value,
    headline,
    ratio_text,
    with_interval,
)
from trackwright.experiments.text.tables import aligned, rendered, ruled_table, terminal_width
from trackwright.experiments.text.wording import Unit, heading, units_of, yes_no
from trackwright.trackers.recordings.atomic import json_text

WIDTH = 160


def to_text(results: Results, expected: Sequence[ExpectedResult | Conclusion]) -> str:
    """The main metrics of every condition and tracker, and the expected results beside ours."""
    shown, units = results.main_metrics(), main_units(results)
    tables = [
        _table(results.study, heading(metric, units[metric]), values, units[metric]) for metric, values in shown.items()
    ]
    reproduced = [t for t in (_expected(expected), _conclusions(expected)) if t is not None]
    text = rendered(terminal_width(WIDTH), *tables, *reproduced)
    text += f"\n{without}\n" if (without := results.without_bound()) else ""
    return f"{text}\n{headline_of(expected)}\n" if reproduced else text


def main_units(results: Results) -> dict[str, Unit]:
    """The units of the main metrics."""
    return units_of({m: [v.value for v in values.values()] for m, values in results.main_metrics().items()})


def headline_of(expected: Sequence[ExpectedResult | Conclusion]) -> str:
    """How many of the expected results are predicted, fitted and derived, and how many of them are reached."""
    return headline(
        [(c.origin, c.reached) for c in expected if isinstance(c, ExpectedResult)],
        [(c.origin, c.holds) for c in expected if isinstance(c, Conclusion)],
    )


def _table(study: Study, title: str, values: Mapping[tuple[int, str], Value], unit: Unit) -> Table:
    rows = [[c.label, *(with_interval(values[c.index, t], unit) for t in study.trackers)] for c in study.conditions]
    return ruled_table(title, ["world", *study.trackers], 1, rows)


def _expected(expected: Sequence[ExpectedResult | Conclusion]) -> Table | None:
    rows = [
        [r.quantity, r.unit, r.origin, f"{r.printed:g}",
         with_interval(r.ours, Unit(r.unit, 1.0)), ratio_text(r.ratio, r.compares_rest), yes_no(r.reached)]
        for r in expected if isinstance(r, ExpectedResult)
    ]  # fmt: skip
    head = ("result", "unit", "origin", "printed", "ours (95 %)", "ratio", "within tolerance")
    return ruled_table("Printed and ours", head, 3, rows) if rows else None


def _conclusions(expected: Sequence[ExpectedResult | Conclusion]) -> Table | None:
    rows = conclusion_rows(expected)
    return ruled_table("Conclusions", ("conclusion", "origin", "holds", "evidence"), 4, rows) if rows else None


def conclusion_rows(expected: Sequence[ExpectedResult | Conclusion]) -> list[list[str]]:
    """Of each conclusion its statement, origin, whether it holds and the evidence."""
    return [[c.statement, c.origin, yes_no(c.holds), c.evidence] for c in expected if isinstance(c, Conclusion)]


def to_json(results: Results, expected: Sequence[ExpectedResult | Conclusion]) -> str:
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


def _claim(claim: ExpectedResult | Conclusion) -> dict[str, Any]:
    if isinstance(claim, Conclusion):
        return {"says": claim.statement, "holds": claim.holds, "evidence": claim.evidence, "origin": claim.origin.value}
    ours: Value = claim.ours
    return {
        "figure": claim.quantity,
        "printed": claim.printed,
        "ours": ours._asdict(),
        "unit": claim.unit,
        "ratio": claim.ratio,
        "compares_rest": claim.compares_rest,
        "origin": claim.origin.value,
        "reached": claim.reached,
        "note": claim.note,
    }


def study_names(studies: Sequence[Study]) -> str:
    """Names and questions of the studies, for `--list`."""
    return aligned([(s.name, s.about) for s in studies])

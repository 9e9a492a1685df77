"""A study's figures and claims as tables on a terminal, and as JSON."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.table import Table

from experiments.cli.console import rendered
from experiments.monte_carlo.declaration import Study
from experiments.monte_carlo.expectations import Conclusion, ExpectedResult, Value
from experiments.monte_carlo.results import NAMES, Results
from experiments.reports.wording import Unit, heading, units_of, with_interval
from trackers.recordings.atomic import json_text

WIDTH = 160


def to_text(results: Results, claims: Sequence[ExpectedResult | Conclusion]) -> str:
    """The main figures of every cell and tracker, and what was printed beside ours."""
    shown = results.main_metrics()
    units = units_of({f: [v.value for v in found.values()] for f, found in shown.items()})
    tables = [_table(results.study, figure, found, units[figure]) for figure, found in shown.items()]
    printed = [t for t in (_claims(claims), _conclusions(claims)) if t is not None]
    return rendered(WIDTH, *tables, *printed)


def _table(study: Study, figure: str, found: Mapping[tuple[int, str], Value], unit: Unit) -> Table:
    title = heading(figure) + (f", {unit.name}" if unit.name else "")
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("world")
    for name in study.trackers:
        table.add_column(name, justify="right")
    for condition in study.conditions:
        table.add_row(condition.label, *(with_interval(found[condition.index, t], unit) for t in study.trackers))
    return table


def _claims(claims: Sequence[ExpectedResult | Conclusion]) -> Table | None:
    own = [c for c in claims if isinstance(c, ExpectedResult)]
    if not own:
        return None
    table = Table(title="Printed and ours", title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for name in ("figure", "printed", "ours (95 %)", "unit", "ratio", "", "reached"):
        table.add_column(name, justify="left" if name in ("figure", "unit", "", "reached") else "right")
    for c in own:
        reached = "" if c.reached is None else "yes" if c.reached else "no"
        interval = with_interval(c.ours, Unit(c.unit, 1.0))
        kind = "fitted" if c.fitted else "predicted"
        table.add_row(c.quantity, f"{c.printed:g}", interval, c.unit, f"{c.ratio:.2f}", kind, reached)
    return table


def _conclusions(claims: Sequence[ExpectedResult | Conclusion]) -> Table | None:
    own = [c for c in claims if isinstance(c, Conclusion)]
    if not own:
        return None
    table = Table(title="Conclusions", title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for name in ("says", "holds", "evidence"):
        table.add_column(name)
    for c in own:
        table.add_row(c.statement, "yes" if c.holds else "no", c.evidence)
    return table


def to_json(results: Results, claims: Sequence[ExpectedResult | Conclusion]) -> str:
    """Every figure of every cell and tracker with its interval, and the differences from the first tracker."""
    figures = _all_figures(results)
    return json_text(
        {
            "study": results.study.name,
            "about": results.study.about,
            "seed": results.study.seed,
            "sha256": digest(figures),
            "computing_s": results.seconds,
            "cells": figures,
            "us_per_row": {
                c.label: {t: results.at("us_per_row", c, t).value for t in results.study.trackers}
                for c in results.study.conditions
            },
            "claims": [_claim(c) for c in claims],
        }
    )


def digest(figures: Any) -> str:
    """The SHA-256 of all figures but the computing times, which differ from run to run."""
    return hashlib.sha256(json_text(figures).encode()).hexdigest()


def _all_figures(results: Results) -> list[dict[str, Any]]:
    study, made = results.study, []
    names = [*(n for n in NAMES if n != "us_per_row"), *study.measures]
    reference = next(iter(study.trackers))
    for condition in study.conditions:
        for tracker in study.trackers:
            values = {n: results.at(n, condition, tracker) for n in names if _has(results, n, condition.index, tracker)}
            known = {n: v for n, v in values.items() if v.value == v.value}
            differences = {
                n: results.compared(_less, n, condition, tracker, reference)._asdict()
                for n in known
                if tracker != reference and _has(results, n, condition.index, reference)
            }
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


def _less(a: Any, b: Any) -> Any:
    return a - b


def _has(results: Results, figure: str, condition: int, tracker: str) -> bool:
    """Whether a figure of a kind of error that the tracker doesn't have is asked for."""
    kept = results.totals[condition, tracker]
    kinds = ("3d_m", "direction_rad", "azimuth_rad", "elevation_rad", "m")
    if figure in kept.measures or figure.startswith("bound"):
        return True
    kind = next((k for k in kinds if figure.endswith(f"_{k}")), None)
    return kind is None or kind in kept.histograms


def _claim(claim: ExpectedResult | Conclusion) -> dict[str, Any]:
    if isinstance(claim, Conclusion):
        return {"says": claim.statement, "holds": claim.holds, "evidence": claim.evidence}
    own: Value = claim.ours
    return {
        "figure": claim.quantity,
        "printed": claim.printed,
        "ours": own._asdict(),
        "unit": claim.unit,
        "ratio": claim.ratio,
        "fitted": claim.fitted,
        "reached": claim.reached,
        "note": claim.note,
    }


def study_names(studies: Sequence[Study]) -> str:
    """The studies with what they ask, for `--list`."""
    width = max(len(s.name) for s in studies)
    return "\n".join(f"{s.name:{width}}  {s.about}" for s in studies)

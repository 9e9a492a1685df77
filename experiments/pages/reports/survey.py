"""The report of a survey: its numbers for JSON, and a page with the sensors over the walks, before and after."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from trackwright.experiments.pages.charts.floor import PlanPath, draw_plan, ellipses, plan_corners
from trackwright.experiments.pages.charts.style import BLUE, GREEN, GREY, Chart, write_panels
from trackwright.experiments.pages.reports.pages import page, write_page
from trackwright.tuning.survey.result import Survey


def survey_data(survey: Survey) -> dict[str, Any]:
    """The sensors by id with their numbers, half-widths of 95 % intervals and verdicts; the effect, and the notes."""
    sensors = {name: survey.numbers(k) | {"verdict": survey.verdict(name)} for k, name in enumerate(survey.names)}
    return {f"{survey.noun}s": sensors, "effect": survey.effect, "notes": survey.notes}


def write_survey_report(out: Path, survey: Survey, command: Sequence[str]) -> tuple[Path, Path]:
    """Writes the figure and the page beside the file `out`, with its name; returns their paths."""
    figure = write_panels(
        out.with_suffix(".png"), [partial(_plan, survey=survey)], None, f"Survey of {survey.rig.name}"
    )
    nouns = f"{survey.noun.capitalize()}s"
    text = page(
        "survey.html",
        command,
        title=f"Survey of {survey.rig.name}",
        survey=survey,
        chart_of=Chart(
            "survey", f"{nouns} with 95 % ellipses over the walks", partial(_plan, survey=survey), 7.0, None
        ),
        nouns=nouns,
        head=survey.head,
        rows=survey.rows(),
        reading=survey.reading,
        out=str(out),
    )
    return figure, write_page(out.with_suffix(".html"), text)


def _plan(axes: Axes, survey: Survey) -> None:
    """Walks, sensors with the ellipses of their intervals, and where the rig had them."""
    whole = np.concatenate(survey.paths)[:, :2]
    rows = np.arange(len(survey.names))
    covs = np.stack([survey.block(k)[:2, :2] for k in rows.tolist()])
    drawn = np.array([survey.half_widths[k, :2].max() < 2.0 for k in rows])
    paths = [PlanPath("" if k else "walk", GREY, path[:, :2]) for k, path in enumerate(survey.paths)]
    paths.append(
        PlanPath("", BLUE, np.full((1, 2), np.nan), survey.positions[drawn, :2], covs[drawn], "95 % ellipse")
    )  # fmt: skip
    shown = [whole, ellipses(survey.positions[drawn, :2], covs[drawn])]
    draw_plan(axes, paths, [], survey.rig, plan_corners(shown, [], survey.rig))
    before = survey.before_onto()
    if len(before):
        axes.plot(*before[:, :2].T, "X", color=GREEN, label="before", zorder=6)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=4)

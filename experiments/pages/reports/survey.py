"""The report of a survey: its numbers for JSON, and a page with the anchors over the walks, before and after."""

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
from trackwright.tuning.survey.frames import aligned
from trackwright.tuning.survey.result import Survey


def survey_data(survey: Survey) -> dict[str, Any]:
    """The anchors with positions, half-widths of 95 % intervals and delays, m, and verdicts, by id; and the notes."""
    anchors = {
        name: {
            "position_m": survey.positions[k], "half_width_m": survey.half_widths[k, :3], "delay_m": survey.delays[k],
            "delay_half_width_m": survey.half_widths[k, 3], "delay_determined": survey.delay_determined[k],
            "rms_m": survey.rms[k], "ranges": survey.readings[k], "verdict": survey.verdict(name),
        }
        for k, name in enumerate(survey.names)
    }  # fmt: skip
    return {"anchors": anchors, "effect": survey.effect, "notes": survey.notes}


def write_survey_report(out: Path, survey: Survey, command: Sequence[str]) -> tuple[Path, Path]:
    """Writes the figure and the page beside the file `out`, with its name; returns their paths."""
    figure = write_panels(
        out.with_suffix(".png"), [partial(_plan, survey=survey)], None, f"Survey of {survey.rig.name}"
    )
    text = page(
        "survey.html",
        command,
        title=f"Survey of {survey.rig.name}",
        survey=survey,
        chart_of=Chart("survey", "Anchors with 95 % ellipses over the walks", partial(_plan, survey=survey), 7.0, None),
        head=HEAD,
        rows=survey.rows(),
        reading=survey.reading,
        out=str(out),
    )
    return figure, write_page(out.with_suffix(".html"), text)


def _plan(axes: Axes, survey: Survey) -> None:
    """Walks, anchors with the ellipses of their intervals, and where the rig had them, turned onto the survey."""
    whole = np.concatenate(survey.paths)[:, :2]
    rows = np.arange(len(survey.names))
    covs = np.stack([survey.covariance[4 * k : 4 * k + 2, 4 * k : 4 * k + 2] for k in rows])
    drawn = np.array([survey.half_widths[k, :2].max() < 2.0 for k in rows])
    paths = [PlanPath("" if k else "walk", GREY, path[:, :2]) for k, path in enumerate(survey.paths)]
    paths.append(
        PlanPath("", BLUE, np.full((1, 2), np.nan), survey.positions[drawn, :2], covs[drawn], "95 % ellipse")
    )  # fmt: skip
    shown = [whole, ellipses(survey.positions[drawn, :2], covs[drawn])]
    draw_plan(axes, paths, [], survey.rig, plan_corners(shown, [], survey.rig))
    known = [k for k, name in enumerate(survey.names) if name in survey.before.anchors]
    if len(known) > 2:
        before = np.array([survey.before.anchors[survey.names[k]] for k in known])
        turn, shift = aligned(before, survey.positions[known], 2)[0]
        axes.plot(*(before @ turn.T + shift)[:, :2].T, "X", color=GREEN, label="before, aligned", zorder=6)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=4)

"""The report of a survey: a table of anchors, and a page with the anchors over the walks, before and after."""

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
from trackwright.experiments.text.tables import rendered, ruled_table, terminal_width
from trackwright.experiments.text.wording import MISSING, fixed
from trackwright.tuning.survey.surveying import Survey, aligned

WIDTH = 150
UNSEEN = 100.0
"""Half-width of an interval, m, from which a number says nothing."""

HEAD = ("anchor", "x, m", "y, m", "z, m", "delay, m", "rms, cm", "ranges", "verdict")


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


def survey_rows(survey: Survey) -> list[list[str]]:
    """A row for each anchor; numbers that the walks do not determine are in brackets."""
    rows = []
    for k, name in enumerate(survey.names):
        over, height = survey.determined(name)
        known = (over, over, height, bool(survey.delay_determined[k]))
        values = np.append(survey.positions[k], survey.delays[k])
        cells = [_with_interval(*of) for of in zip(values, survey.half_widths[k], known, strict=True)]
        rows.append([name, *cells, fixed(100 * survey.rms[k], 1), str(survey.readings[k]), survey.verdict(name)])
    return rows


def _with_interval(value: float, half_width: float, known: bool) -> str:
    if half_width == 0.0:
        return fixed(value, 3)
    if half_width > UNSEEN:
        return MISSING
    text = f"{fixed(value, 2)}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{fixed(half_width, 2)}"
    return text if known else f"({text})"


def survey_text(survey: Survey) -> str:
    """The table for a terminal, with a line on how to read it."""
    table = ruled_table(f"Anchors of {survey.rig.name}", HEAD)
    table.columns[-1].justify = "left"
    for row in survey_rows(survey):
        table.add_row(*row)
    return rendered(terminal_width(WIDTH), table, _reading(survey))


def _reading(survey: Survey) -> str:
    wider = fixed(survey.effect**0.5, 1)
    return (
        f"± half the 95 % interval; in brackets: not determined. As errors last, intervals are {wider} times as wide "
        "as with independent ones."
    )


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
        rows=survey_rows(survey),
        reading=_reading(survey),
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

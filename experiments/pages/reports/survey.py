"""The report of a survey: its numbers for JSON, and a page with the anchors over the walks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from trackwright.experiments.pages.charts.floor import PlanPath, plan
from trackwright.experiments.pages.charts.style import BLUE, GREY
from trackwright.experiments.pages.reports.pages import report_page, typed, write_page
from trackwright.experiments.text.tables import Section
from trackwright.trackers.core.wording import counted
from trackwright.tuning.survey import DELAY_DETERMINED, Survey


def survey_data(survey: Survey) -> dict[str, Any]:
    """The anchors by id with their numbers, half-widths of 95 % intervals and verdicts; the effect, and the notes."""
    anchors = {
        name: {
            "position_m": survey.positions[k], "half_width_m": survey.half_widths[k, :3], "delay_m": survey.delays[k],
            "delay_half_width_m": (half := survey.half_widths[k, 3]), "delay_determined": half < DELAY_DETERMINED,
            "rms_m": survey.rms[k], "ranges": survey.readings[k], "verdict": survey.verdict(name),
        }
        for k, name in enumerate(survey.names)
    }  # fmt: skip
    return {"anchors": anchors, "effect": survey.effect, "notes": survey.notes}


def write_survey_page(out: Path, survey: Survey, command: Sequence[str]) -> Path:
    """Writes the page beside the file `out`, with its name; returns its path."""
    drawn = np.flatnonzero(survey.half_widths[:, :2].max(axis=1) < 2.0).tolist()
    places, covs = survey.positions[drawn, :2], np.reshape([survey.block(k)[:2, :2] for k in drawn], (-1, 2, 2))
    paths = [PlanPath("" if k else "walk", GREY, path[:, :2]) for k, path in enumerate(survey.paths)]
    paths.append(PlanPath("", BLUE, np.full((1, 2), np.nan), places, covs, "95 % ellipse"))
    chart = plan("survey", "Anchors with 95 % ellipses over the walks", paths, [], survey.rig)
    walks, anchors = counted(len(survey.paths), "walk"), counted(len(survey.names), "anchor")
    notes = "".join(f" {note[0].upper()}{note[1:]}." for note in survey.notes)
    summary = f"Positions and delays of {anchors} from {walks} without truth.{notes}"
    table = Section("Anchors", survey.head, survey.rows(), 1, survey.reading, {survey.head[-1]: "long"}, [[chart]])
    use = f"trackwright track RECORDING --out out/tracks, with {out} as its rig.toml"
    text = report_page("survey", f"Survey of {survey.rig.name}", [summary], [table], [use, typed(command)])
    return write_page(out.with_suffix(".html"), text)

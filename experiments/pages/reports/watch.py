"""The report of a watch: its verdict for JSON, and a figure of the statistics over time."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from trackwright.experiments.pages.charts.style import BLACK, GREY, VERMILION, write_panels
from trackwright.tuning.watch.readings import SLOT_S
from trackwright.tuning.watch.result import Watch

MOST_PANELS = 8
"""Sources with a panel, those with the largest statistics."""


def watch_data(watch: Watch) -> dict[str, Any]:
    """The verdict, the causes that it names with sizes and intervals, m, m/s or rad, and what it rests on."""
    causes = [
        {
            "cause": cause.name, "sources": list(map(str, cause.sources)), "onset_s": SLOT_S * cause.onset,
            "size": cause.size, "half_width": watch.half_widths(cause), "score": cause.score,
            "words": watch.what(cause), "to_do": watch.advice(cause),
        }
        for cause in watch.named
    ]  # fmt: skip
    known = {"alarm_s": watch.alarm_s, "runs_begin_s": watch.starts} if watch.changed else {}
    return {"changed": watch.changed, **known, "causes": causes, "lines": watch.lines()}


def write_watch_figure(out: Path, watch: Watch) -> Path:
    """Writes the figure of the statistics of each source over time; returns its path."""
    bank, highest = watch.site.bank, watch.course.statistic.max(axis=0, initial=0.0)
    of_source = np.tile(bank.source, 2)
    largest = [highest[of_source == k].max() for k in range(len(watch.site.sources))]
    shown = sorted(np.argsort(largest)[::-1][:MOST_PANELS])
    panels = [partial(_statistics, watch=watch, number=int(k)) for k in shown]
    return write_panels(out, panels, (8.0, 0.8 + 1.1 * len(panels)), "Statistics of the watch, and their threshold")


def _statistics(axes: Axes, watch: Watch, number: int) -> None:
    """The largest statistic of a source over time, with its threshold, and the onset of a change of it."""
    of_source = np.tile(watch.site.bank.source, 2) == number
    seconds = SLOT_S * (watch.blocks.slot + 1.0)
    axes.plot(seconds, watch.course.statistic[:, of_source].max(axis=1), color=GREY, linewidth=0.9)
    axes.axhline(watch.course.threshold, color=VERMILION, linestyle="--", linewidth=0.9)
    source = watch.site.sources[number]
    if watch.cause is not None and source in watch.cause.sources:
        axes.axvline(watch.onset_s, color=BLACK, linewidth=0.9)
    axes.set_yscale("symlog", linthresh=watch.course.threshold)
    axes.set(xlabel="time, s", ylabel=source.name)

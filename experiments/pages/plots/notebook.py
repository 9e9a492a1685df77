"""Plots for notebooks, `trackwright.plot`: on given or new axes of matplotlib, which they return, or as a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from trackwright.experiments.pages.interactive.playback import playback
from trackwright.experiments.pages.plots.style import BLACK, GREY, LINES, SKY, broken_at_gaps
from trackwright.experiments.text.wording import length_unit
from trackwright.trackers.core.data.estimates import Estimates
from trackwright.trackers.core.data.recording import Recording
from trackwright.trackers.core.data.seconds import time_label, zero_of
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.association import Association
from trackwright.trackers.evaluation.evaluate import associate
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracks import Tracks
from trackwright.trackers.recordings.tracks_table import is_bearing

__all__ = ["error_cdf", "error_over_time", "floor_plan", "playback"]

AnyEstimates = Tracks | Estimates
AnyRecording = RecordingFolder | Recording


def floor_plan(
    estimates: AnyEstimates, recording: AnyRecording | None = None, tags: Sequence[str] = (), ax: Axes | None = None
) -> Axes:
    """The estimated paths over the floor, m, with truth, anchors and stations where the recording has any.

    `tags`: those drawn, by default the first six. Returns the axes, new ones where `ax` is not given.
    """
    table = estimates.to_polars()
    table = table if "tag" in table.columns else table.rename({"recording": "tag"})
    axes = _axes(ax, xlabel="x (m)", ylabel="y (m)", aspect="equal")
    names = list(tags) or table["tag"].unique().sort().to_list()[: len(LINES)]
    for name, colour in zip(names, LINES, strict=False):
        rows = table.filter(table["tag"] == name)
        if not rows.height:
            raise UnusableInput(
                f"floor_plan: no estimate of tag '{name}'; tags: {', '.join(table['tag'].unique().sort())}"
            )
        place = np.stack([float_column(rows, "x_m"), float_column(rows, "y_m")], axis=1)
        axes.plot(*broken_at_gaps(float_column(rows, "t_s"), place)[1].T, color=colour, label=str(name))
    for k, (times, place) in enumerate(_true_paths(recording, names)):
        drawn = broken_at_gaps(times, place)[1]
        axes.plot(*drawn.T, color=BLACK, lw=0.8, ls="--", label="truth" if k == 0 else None)
    if isinstance(recording, RecordingFolder):
        rig = recording.rig
        mounted = [*rig.anchors.items(), *((name, station.position) for name, station in rig.stations.items())]
        for name, position in mounted:
            axes.plot(*position[:2], "^", color=GREY)
            axes.annotate(
                str(name),
                (float(position[0]), float(position[1])),
                xytext=(3, 3),
                textcoords="offset points",
                color=GREY,
                fontsize=8,
            )
        for x1, y1, x2, y2 in [] if rig.all_walls() is None else rig.all_walls():
            axes.plot([x1, x2], [y1, y2], color=GREY, lw=2)
    axes.legend()
    return axes


def error_over_time(
    estimates: AnyEstimates, recording: AnyRecording, tag: str | None = None, ax: Axes | None = None
) -> Axes:
    """The horizontal position error of a tag, m, over time, with the reported standard deviation of that distance.

    `tag`: by default the first. Returns the axes, new ones where `ax` is not given. Raises UnusableInput without truth.
    """
    association = _associated(estimates, recording)
    tags = association.rows["tag"].to_numpy()
    chosen = tags[0] if tag is None else tag
    if chosen not in tags:
        raise UnusableInput(f"error_over_time: no estimate of tag '{tag}'; tags: {', '.join(sorted(set(tags)))}")
    rows = association.rows.filter(tags == chosen)
    error = _horizontal(association)[tags == chosen]
    sigma = np.hypot(float_column(rows, "std_x_m"), float_column(rows, "std_y_m"))
    times = float_column(rows, "t_s")
    zero = zero_of(times[0])
    axes = _axes(ax, xlabel=time_label(zero), ylabel="horizontal error (m)")
    at, error, sigma = broken_at_gaps(times - zero, error, sigma)
    axes.fill_between(at, 0, sigma, color=SKY, alpha=0.35, lw=0, label="reported standard deviation")
    axes.plot(at, error, color=LINES[0], label=f"error, tag {chosen}" if chosen else "error")
    axes.set_ylim(bottom=0)
    axes.legend()
    return axes


def error_cdf(
    estimates: AnyEstimates | Mapping[str, AnyEstimates], recording: AnyRecording, ax: Axes | None = None
) -> Axes:
    """The distribution function of the horizontal position errors; of several runs by name, a curve each.

    Returns the axes, new ones where `ax` is not given. Raises UnusableInput without truth.
    """
    runs = estimates if isinstance(estimates, Mapping) else {"": estimates}
    errors = {name: _horizontal(_associated(run, recording)) for name, run in runs.items()}
    ordered = {name: np.sort(values[np.isfinite(values)]) for name, values in errors.items()}
    unit, scale = length_unit(max(float(np.median(values)) for values in ordered.values()))
    axes = _axes(ax, xlabel=f"horizontal error ({unit})", ylabel="estimates with at most this error (%)")
    for (name, values), colour in zip(ordered.items(), LINES, strict=False):
        share = 100 * np.arange(1, len(values) + 1) / len(values)
        words = f"RMSE {scale * np.sqrt(np.mean(values**2)):.3g} {unit}"
        axes.plot(scale * values, share, color=colour, label=f"{name}: {words}" if name else words)
    axes.set(ylim=(0, 101))
    axes.set_xlim(left=0)
    axes.legend(loc="lower right")
    return axes


def _axes(ax: Axes | None, **labels: str) -> Axes:
    axes = plt.subplots(layout="constrained")[1] if ax is None else ax
    axes.set(**labels)
    axes.grid(alpha=0.3)
    return axes


def _associated(estimates: AnyEstimates, recording: AnyRecording) -> Association:
    association = associate(estimates, recording)
    if is_bearing(association.rows):
        raise UnusableInput("plot: found bearings; expected estimates of positions")
    return association


def _horizontal(association: Association) -> np.ndarray:
    """The horizontal errors (n,), m, NaN without truth."""
    rows, truth = association.rows, association.truth
    return np.hypot(float_column(rows, "x_m") - truth[:, 0], float_column(rows, "y_m") - truth[:, 1])


def _true_paths(recording: AnyRecording | None, tags: Sequence[str]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Times (n,) and positions (n, 2) of the truth of each tag that has one."""
    if isinstance(recording, Recording) and "position" in recording.truth:
        values, known = recording.truth["position"]
        return [(recording.times[known], values[known, :2])]
    if not isinstance(recording, RecordingFolder) or "truth" not in recording.tables:
        return []
    table = recording.tables["truth"]
    each = [table.filter(table["tag"] == tag) for tag in tags]
    return [
        (float_column(rows, "t_s"), np.stack([float_column(rows, "x_m"), float_column(rows, "y_m")], axis=1))
        for rows in each
        if rows.height
    ]

"""The charts of a recording's estimates, each one function, for a notebook (`trackwright.plot`), files and the page.

A chart takes estimates and their recording, or both already scored, draws on given or new axes and returns them. Every
function here is in `trackwright.plot`; what `figures.py` lists is a file of `track`, a chart of its page, or both.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from inspect import isfunction
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes

from trackwright.experiments.pages.charts.distributions import (
    Curve,
    draw_coverage,
    draw_distributions,
    draw_nis,
    law_of,
    levels_of,
)
from trackwright.experiments.pages.charts.floor import PlanPath, draw_plan, ellipse_rows, natural, plan_corners
from trackwright.experiments.pages.charts.over_time import (
    draw_angle,
    draw_band,
    draw_consistency,
    draw_error,
    draw_rmse,
    half_heights,
)
from trackwright.experiments.pages.charts.style import (
    BLUE,
    GREY,
    LINES,
    broken_at_gaps,
    legend_above,
    literal,
)
from trackwright.experiments.pages.scored_tracks import (
    AnyEstimates,
    AnyRecording,
    ScoredRecording,
    drawn_of,
    scored_tracks,
)
from trackwright.experiments.text.wording import Unit, length_unit
from trackwright.trackers.core.data.seconds import time_label
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.scoring import covariances
from trackwright.trackers.recordings.columns import float_column
from trackwright.tuning.diagnostics import Innovations

Shown = ScoredRecording | AnyEstimates
"""Estimates scored against the truth of their recording, or alone: the recording is then the next argument."""

MARKED = (50.0, 90.0, 95.0)
"""Percentiles marked on the distribution of errors."""

ELLIPSES = 24
"""The most ellipses in all, at most half of them along one track; more would hide the tracks."""


def floor_plan(
    estimates: Shown, recording: AnyRecording | None = None, tags: Sequence[str] = (), ax: Axes | None = None
) -> Axes:
    """The estimated paths over the floor, m, with truth, anchors and stations where the recording has any.

    Some estimates have their reported 95 % ellipse. `tags`: those drawn, at most six; by default all, or of more the
    worst, the median and the best. Outliers don't set the scale; a note names their number. Raises UnusableInput for
    bearings, and for an unknown tag.
    """
    scored = _scored(estimates, recording, "floor_plan")
    starts, rows = scored.association.starts, scored.association.rows
    places = np.stack([float_column(rows, "x_m"), float_column(rows, "y_m")], axis=1)
    covs, times, truth = covariances(rows)[:, :2, :2], scored.times - scored.zero, _truth_of(scored)
    all_tags = [str(tag) for tag in rows["tag"].gather(starts[:-1])]
    shown = dict.fromkeys(tags[: len(LINES)], "") or _worst_median_best(all_tags, scored.rmse)
    paths, truths = [], []
    for (tag, remark), colour in zip(shown.items(), LINES, strict=False):
        k = _track(scored, tag, None, "floor_plan")
        of_tag = np.arange(starts[k], starts[k + 1])
        of_tag = of_tag[np.isfinite(places[of_tag]).all(axis=1)]
        at, path = broken_at_gaps(times[of_tag], places[of_tag])
        some = of_tag[ellipse_rows([places[of_tag]], [covs[of_tag]], min(ELLIPSES // len(shown), ELLIPSES // 2))]
        name = (f"tag {tag}" if tag else "estimates") + (f"\n{remark}" if remark else "")
        stamps = at if len(shown) <= 3 else None
        paths.append(PlanPath(name, colour, path, places[some], covs[some], times=stamps))
        truths += [truth[tag]] if tag in truth else []
    rig = scored.folder.rig
    corners = plan_corners(truths, [path.positions for path in paths], rig)
    axes = _axes(ax)
    draw_plan(axes, paths, truths, rig, corners)
    if paths or truths or rig.anchors or rig.stations:
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0)
    notes = ["dots: estimates with their reported 95 % ellipses"] if any(len(path.covs) for path in paths) else []
    if len(all_tags) > len(paths):
        notes.append(f"{len(paths)} of {len(all_tags)} tags are shown")
    drawn = np.concatenate([path.positions[np.isfinite(path.positions[:, 0])] for path in paths] or [np.zeros((0, 2))])
    outside = int(((drawn < corners.low) | (drawn > corners.high)).any(axis=1).sum())
    if outside:
        notes.append(f"{outside} of {len(drawn)} estimates lie outside the axes")
    axes.set_title("\n".join(notes), color=GREY, fontsize=8)
    return axes


def error_over_time(
    estimates: Shown,
    recording: AnyRecording | None = None,
    tag: str | None = None,
    ax: Axes | None = None,
    axis: str = "",
) -> Axes:
    """The horizontal position error of a tag over time, with the reported standard deviation of that distance.

    `tag`: by default the one with the largest RMSE. `axis`: x, y or z for the error along that axis, with ± 3 σ and the
    Cramér–Rao bound. Raises UnusableInput without truth, and for an unknown tag.
    """
    scored = _scored(estimates, recording, "error_over_time", truth=True)
    k = _track(scored, tag, None, "error_over_time")
    of_track = slice(scored.association.starts[k], scored.association.starts[k + 1])
    times, errors, sigmas = scored.times[of_track] - scored.zero, scored.errors[of_track], scored.sigmas()[of_track]
    axes = _axes(ax)
    if axis:
        columns = [c for c in range(3) if np.isfinite(errors[:, c]).any()]
        if axis not in ("xyz"[c] for c in columns):
            raise UnusableInput(f"error_over_time: no error along '{axis}'; expected one of x, y and z with a truth")
        known = np.abs(errors[np.isfinite(errors)])
        unit = length_unit(float(np.quantile(known, 0.95)))
        halves = half_heights([*errors[:, columns].T], [*sigmas[:, columns].T])
        c, half = "xyz".index(axis), unit.factor * halves[columns.index("xyz".index(axis))]
        limits = _bounds_at(scored, scored.times[of_track])
        bound = None if limits is None else unit.factor * limits[:, c]
        draw_error(axes, times, unit.factor * errors[:, c], unit.factor * sigmas[:, c], bound, half)
        axes.set_ylabel(f"error in {axis} ({unit.name})")
    else:
        error, sigma = scored.miss[of_track], np.hypot(sigmas[:, 0], sigmas[:, 1])
        draw_band(axes, times, np.zeros_like(sigma), sigma, "reported standard deviation")
        axes.plot(*broken_at_gaps(times, error), color=BLUE, label="error")
        axes.set(ylabel="horizontal error (m)", ylim=(0, None))
        legend_above(axes)
    name = scored.association.rows["tag"][int(of_track.start)]
    rank = f", the largest RMSE of {len(scored.rmse)}" if tag is None and len(scored.rmse) > 1 else ""
    axes.set_title(literal(f"tag {name}{rank}" if name else ""), loc="right", fontsize=8, color=GREY)
    axes.set_xlabel(time_label(scored.zero))
    return axes


def error_cdf(
    estimates: Shown | Mapping[str, Shown], recording: AnyRecording | None = None, ax: Axes | None = None
) -> Axes:
    """The distribution function of the errors, horizontal and 3-D or of angles; of several runs by name, a curve each.

    Raises UnusableInput without truth.
    """
    runs = {name: _scored(run, recording, "error_cdf", truth=True, bearings=True) for name, run in _runs(estimates)}
    first = next(iter(runs.values()))
    if isinstance(estimates, Mapping):
        errors = {name: scored.miss for name, scored in runs.items()}
    elif first.angles:
        errors = {part.name: np.radians(np.abs(part.errors)) for part in first.components()}
    else:
        errors = {"horizontal": first.miss, "3-D": np.sqrt((first.errors**2).sum(axis=1))}
    known = {name: values[np.isfinite(values)] for name, values in errors.items() if np.isfinite(values).any()}
    furthest = max(float(np.quantile(values, 0.995)) for values in known.values()) or 1.0
    unit = Unit("°", 180 / np.pi) if first.angles else length_unit(furthest / 2)
    curves = []
    for name, values in known.items():
        curve = Curve.of(name, unit.factor * values)
        if isinstance(estimates, Mapping):
            words = f"RMSE {unit.factor * np.sqrt(np.mean(values**2)):.3g}"
        else:
            words = ", ".join(f"p{p:.0f} {v:.3g}" for p, v in zip(MARKED, curve.quantiles(MARKED), strict=True))
        curves.append(curve._replace(name=f"{name}: {words} {unit.name}"))
    axes = _axes(ax)
    what = "horizontal error" if isinstance(estimates, Mapping) and not first.angles else "error"
    draw_distributions(axes, curves, f"{what} ({unit.name})", 1.05 * unit.factor * furthest, MARKED)
    axes.legend(loc="lower right")
    axes.set_title(f"{int(np.isfinite(first.miss).sum())} estimates", color=GREY, fontsize=8)
    return axes


def coverage(
    estimates: Shown | Mapping[str, Shown],
    recording: AnyRecording | None = None,
    ax: Axes | None = None,
    spatial: bool = False,
) -> Axes:
    """The observed share of the truth inside the reported ellipses against their level: the diagonal is correct.

    Of several runs by name a curve each, of ellipses, or `spatial` of ellipsoids; of one run both, or those of angles.
    Raises UnusableInput without truth.
    """
    runs = {name: _scored(run, recording, "coverage", truth=True, bearings=True) for name, run in _runs(estimates)}
    if isinstance(estimates, Mapping):
        shape = [*next(iter(runs.values())).nees_by_shape()][int(spatial)]
        nees = {name: scored.nees_by_shape()[shape] for name, scored in runs.items()}
    else:
        shape, nees = "", runs[""].nees_by_shape()
    levels = {name: levels_of(*pair) for name, pair in nees.items() if np.isfinite(pair[0]).any()}
    pooled = "" if not shape else "all rows" if len(levels) > 1 else next(iter(levels))
    axes = _axes(ax)
    draw_coverage(axes, levels, pooled)
    axes.set_title(shape if spatial or shape == "horizontal" else "")
    words = "ellipsoid" if spatial else "ellipse"
    axes.set(xlabel=f"level of the reported {words} (%)", ylabel=f"truth inside the {words} (% of rows)")
    return axes


def nees_over_time(estimates: Shown, recording: AnyRecording | None = None, ax: Axes | None = None) -> Axes:
    """The mean of the horizontal NEES per degree of freedom over time, with its band: 1 for correct covariances.

    Raises UnusableInput without truth.
    """
    scored = _scored(estimates, recording, "nees_over_time", truth=True)
    at, nees = _by_run(scored, scored.nees)
    axes = _axes(ax)
    draw_consistency(axes, at, nees, 2.0, "NEES")
    axes.set_xlabel(time_label(scored.zero))
    return axes


def nis_over_time(estimates: Shown, recording: AnyRecording | None = None, ax: Axes | None = None) -> Axes:
    """The mean of the NIS per degree of freedom over time, with its band where its distribution is known."""
    scored = _scored(estimates, recording, "nis_over_time", bearings=True)
    rows = scored.association.rows
    at, nis, dof = _by_run(scored, float_column(rows, "nis"), float_column(rows, "nis_dof"))
    axes = _axes(ax)
    draw_consistency(axes, at, nis, dof, "NIS", law_of(scored.student_t_dof), scored.student_t_dof)
    axes.set_xlabel(time_label(scored.zero))
    return axes


def nis_histogram(estimates: Shown, recording: AnyRecording | None = None, ax: Axes | None = None) -> Axes:
    """The histogram of the NIS of all rows, and its density for a consistent filter where that is known."""
    scored = _scored(estimates, recording, "nis_histogram", bearings=True)
    nis, dof = (float_column(scored.association.rows, name) for name in ("nis", "nis_dof"))
    known = np.isfinite(nis) & (dof > 0)
    axes = _axes(ax)
    if known.any():
        draw_nis(axes, Innovations(nis[known], dof[known], np.zeros(known.sum(), int), scored.student_t_dof))
    return axes


def rmse_over_time(
    estimates: Shown, recording: AnyRecording | None = None, ax: Axes | None = None, axis: str = "x"
) -> Axes:
    """The RMSE along an axis over time, of all tags, with the reported σ and the Cramér–Rao bound.

    Raises UnusableInput without truth.
    """
    scored = _scored(estimates, recording, "rmse_over_time", truth=True)
    times, errors, sigmas = _by_run(scored, scored.errors, scored.sigmas())
    rmse, reported = _root_means(errors), _root_means(sigmas)
    known = rmse[np.isfinite(rmse)]
    unit, c = length_unit(float(np.median(known)) if len(known) else np.nan), "xyz".index(axis)
    limits = _bounds_at(scored, times + scored.zero)
    bound = None if limits is None else unit.factor * limits[:, c]
    axes = _axes(ax)
    draw_rmse(axes, times, unit.factor * rmse[:, c], unit.factor * reported[:, c], bound, len(errors))
    axes.set(xlabel=time_label(scored.zero), ylabel=f"{axis} ({unit.name})")
    return axes


def bearing_over_time(
    estimates: Shown,
    recording: AnyRecording | None = None,
    tag: str | None = None,
    station: str | None = None,
    ax: Axes | None = None,
    angle: str = "",
) -> Axes:
    """An angle of a tag's bearings at a station over time, °, with the reported ± 3 σ and the truth.

    `tag`, `station`: by default those with the largest error. `angle`: azimuth or elevation; in the plane of a flat
    array there is one angle alone. Raises UnusableInput for positions.
    """
    scored = _scored(estimates, recording, "bearing_over_time", bearings=True)
    if not scored.angles:
        raise UnusableInput("bearing_over_time: found positions; expected bearings")
    k = _track(scored, tag, station, "bearing_over_time")
    of_track = slice(scored.association.starts[k], scored.association.starts[k + 1])
    parts = {part.name: part for part in scored.components()}
    part = parts.get(angle) or next(iter(parts.values()))
    truth = part.values[of_track] - part.errors[of_track]
    axes = _axes(ax)
    times = scored.times[of_track] - scored.zero
    draw_angle(axes, times, part.values[of_track], part.sigmas[of_track], truth if np.isfinite(truth).any() else None)
    axes.set(xlabel=time_label(scored.zero), ylabel=f"{part.name} (°)")
    return axes


def _runs(estimates: Shown | Mapping[str, Shown]) -> Iterable[tuple[str, Shown]]:
    return estimates.items() if isinstance(estimates, Mapping) else [("", estimates)]


def _scored(
    estimates: Shown, recording: AnyRecording | None, chart: str, truth: bool = False, bearings: bool = False
) -> ScoredRecording:
    """The estimates with their errors. `truth`: whether the chart needs one; `bearings`: whether it can show them.

    Raises UnusableInput for what the chart cannot show.
    """
    scored = (
        estimates
        if isinstance(estimates, ScoredRecording)
        else scored_tracks(estimates, recording, truth).recordings[0]
    )
    if scored.angles and not bearings:
        raise UnusableInput(f"{chart}: found bearings; expected estimates of positions")
    if truth and not scored.association.scored.any():
        raise UnusableInput(f"{chart}: no estimate has a truth at its time")
    return scored


def _axes(ax: Axes | None) -> Axes:
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots(layout="constrained")[1]


def _track(scored: ScoredRecording, tag: str | None, station: str | None, chart: str) -> int:
    """The number of the track of a tag, and of a station; of none that with the largest RMSE."""
    rows, starts = scored.association.rows, scored.association.starts
    if tag is None and station is None:
        return scored.worst_first()[0]
    tags = [str(name) for name in rows["tag"].gather(starts[:-1])]
    stations = [str(name) for name in rows["station"].gather(starts[:-1])] if scored.angles else [station] * len(tags)
    matches = [k for k in scored.worst_first() if tag in (None, tags[k]) and station in (None, stations[k])]
    if not matches:
        named = f"tag '{tag}'" + ("" if station is None else f" at station '{station}'")
        raise UnusableInput(f"{chart}: no estimate of {named}; tags: {', '.join(sorted({*tags}, key=natural))}")
    return matches[0]


def _worst_median_best(tags: Sequence[str], rmse: np.ndarray) -> dict[str, str]:
    """The tags of a floor plan with remarks for its legend: all, or of many the worst, the median and the best."""
    order = sorted(range(len(tags)), key=lambda k: natural(tags[k]))
    return {tags[order[k]]: why for k, why in drawn_of(rmse[order], False, len(LINES)).items()}


def _truth_of(scored: ScoredRecording) -> dict[str, np.ndarray]:
    """The true path (n, 2), m, of each tag, NaN in gaps: of the truth table, else at the times of the estimates."""
    association, paths = scored.association, {}
    for begin, end in pairwise(association.starts):
        tag, known = str(association.rows["tag"][int(begin)]), association.scored[begin:end]
        times, path = scored.times[begin:end][known], association.truth[begin:end][known]
        if tag in scored.folder.paths.number:
            times, path = scored.folder.paths.of_tag(tag)
        if len(path):
            paths[tag] = broken_at_gaps(times, path[:, :2])[1]
    return paths


def _by_run(scored: ScoredRecording, *columns: np.ndarray) -> tuple[np.ndarray, ...]:
    """Times (t,), s, and columns (runs, t): tracks with the times of the first; the first alone if lengths differ."""
    starts, times = scored.association.starts, scored.times - scored.zero
    lengths = np.diff(starts)
    first = times[starts[0] : starts[1]]
    runs = [0]
    if len(lengths) > 1 and np.all(lengths == lengths[0]):
        runs = list(np.flatnonzero(np.all(times.reshape(len(lengths), -1) == first, axis=1)))
    index = np.stack([np.arange(starts[k], starts[k + 1]) for k in runs])
    return first, *(column[index] for column in columns)


def _root_means(values: np.ndarray) -> np.ndarray:
    """The root mean squares (t, d) over runs of the finite values (runs, t, d), NaN where there are none."""
    finite = np.isfinite(values)
    count = finite.sum(axis=0)
    means = np.where(finite, values**2, 0).sum(axis=0) / np.maximum(count, 1)
    return np.where(count > 0, np.sqrt(means), np.nan)


def _bounds_at(scored: ScoredRecording, times: np.ndarray) -> np.ndarray | None:
    """The bounds (t, 3), m, interpolated to other times, s, NaN outside their own; None without."""
    if scored.bounds is None:
        return None
    return np.stack([np.interp(times, scored.bounds[0], b, np.nan, np.nan) for b in scored.bounds[1].T], axis=1)


_FUNCTIONS = [value for value in globals().values() if isfunction(value) and value.__module__ == __name__]
__all__ = [function.__name__ for function in _FUNCTIONS if not function.__name__.startswith("_")]

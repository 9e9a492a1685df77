"""The charts of a recording's estimates, each one function, for a notebook (`trackwright.plot`), files and the page.

A chart takes estimates and their recording, or both already scored, draws on given or new axes and returns them. Every
function here is in `trackwright.plot`; what `figures.py` lists is a file of `track`, a chart of its page, or both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from inspect import isfunction

import numpy as np
from matplotlib.axes import Axes

from trackwright.experiments.pages.charts.distributions import Curve, draw_distributions, draw_nis, law_of
from trackwright.experiments.pages.charts.floor import PlanPath, draw_plan, natural, track_paths, true_path
from trackwright.experiments.pages.charts.style import (
    BLACK,
    BLUE,
    GREY,
    LINES,
    SKY,
    VERMILION,
    broken_at_gaps,
    legend_above,
    literal,
    logarithmic,
)
from trackwright.experiments.pages.scored_tracks import (
    AnyEstimates,
    AnyRecording,
    ScoredRecording,
    drawn_of,
    scored_tracks,
)
from trackwright.experiments.text.wording import Unit, length_unit
from trackwright.trackers.core.data.consistency import chi_square_probability
from trackwright.trackers.core.data.seconds import time_label
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.columns import float_column
from trackwright.tuning.diagnostics import Innovations, nis_band

Shown = ScoredRecording | AnyEstimates
"""Estimates scored against the truth of their recording, or alone: the recording is then the next argument."""

MARKED = (50.0, 90.0, 95.0)
"""Percentiles marked on the distribution of errors."""

LEVELS = np.array([0, 25, 50, 75, 90, 95, 99, 100])
"""Levels of ellipses, %, with a tick; those from 50 to 99 % are marked on the curve of all rows."""

ELLIPSES = 24
"""The most ellipses in all, at most half of them along one track; more would hide the tracks."""

WINDOW, WINDOWS = 20, 120
"""The fewest rows of a mean of NEES or NIS over time, and the most means."""


def floor_plan(
    estimates: Shown, recording: AnyRecording | None = None, tags: Sequence[str] = (), ax: Axes | None = None
) -> Axes:
    """The estimated paths over the floor, m, with truth, anchors and stations where the recording has any.

    Some estimates have their reported 95 % ellipse. `tags`: those drawn, at most six; by default all, or of more the
    worst, the median and the best. Outliers don't set the scale; a note names their number. Raises UnusableInput for
    bearings, and for an unknown tag.
    """
    scored = _scored(estimates, recording, "floor_plan")
    rig, names = scored.folder.rig, [str(tag) for tag in scored.first["tag"]]
    order = sorted(range(len(names)), key=lambda k: natural(names[k]))
    chosen = drawn_of(scored.rmse[order], False, len(LINES))
    shown = dict.fromkeys(tags[: len(LINES)], "") or {names[order[k]]: why for k, why in chosen.items()}
    paths, truths = list[PlanPath](), list[np.ndarray]()
    for (tag, remark), colour in zip(shown.items(), LINES, strict=False):
        k, most = _track(scored, tag, None, "floor_plan"), min(ELLIPSES // len(shown), ELLIPSES // 2)
        name = (f"tag {tag}" if tag else "estimates") + (f"\n{remark}" if remark else "")
        paths += track_paths([scored], k, [(name, colour, "_")], most)
        truths += true_path(scored, k)
    axes = _axes(ax)
    low, high = draw_plan(axes, paths, truths, rig)
    if paths or truths or rig.anchors or rig.stations:
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0)
    notes = ["dots: estimates with their reported 95 % ellipses"] if any(len(path.covs) for path in paths) else []
    notes += [f"{len(paths)} of {len(names)} tags are shown"] if len(names) > len(paths) else []
    drawn = np.concatenate([path.positions for path in paths] or [np.zeros((0, 2))])
    outside = int(((drawn < low) | (drawn > high)).any(axis=1).sum())
    notes += [f"{outside} of {np.isfinite(drawn[:, 0]).sum()} estimates lie outside the axes"] if outside else []
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
    rows = scored.rows_of(_track(scored, tag, None, "error_over_time"))
    times, errors, sigmas = scored.times[rows] - scored.zero, scored.errors[rows], scored.sigmas()[rows]
    axes = _axes(ax)
    if axis:
        halves = [_half_height(errors[:, c], sigmas[:, c]) for c in range(3)]
        c = "xyz".find(axis)
        if c < 0 or not np.isfinite(errors[:, c]).any():
            raise UnusableInput(f"error_over_time: no error along '{axis}'; expected one of x, y and z with a truth")
        unit = length_unit(float(np.quantile(np.abs(errors[np.isfinite(errors)]), 0.95)))
        error, sigma = unit.factor * errors[:, c], unit.factor * sigmas[:, c]
        _band(axes, times, -3 * sigma, 3 * sigma, "reported ± 3 σ")
        axes.plot(*broken_at_gaps(times, error), color=BLUE, linewidth=0.9, label="error")
        if scored.bounds is not None:
            at, bound = scored.bounds[0] - scored.zero, 3 * unit.factor * scored.bounds[1][:, c]
            for limit, label in ((bound, "± 3 × Cramér–Rao bound of this model"), (-bound, "_")):
                axes.plot(*broken_at_gaps(at, limit), color=VERMILION, linewidth=1.1, linestyle="--", label=label)
        # A height that is held fixed is not magnified to its rounding.
        half = unit.factor * max(halves[c], 0.05 * max(halves)) or 1e-9
        axes.set(ylabel=f"error in {axis} ({unit.name})", ylim=(-half, half), xlim=_ends(times))
        outside = int((np.abs(error) > half).sum())
        note = f"{outside} outside the axes" if outside else ""
        axes.text(0.995, 0.03, note, transform=axes.transAxes, ha="right", va="bottom", fontsize=7, color=GREY)
    else:
        sigma = np.hypot(sigmas[:, 0], sigmas[:, 1])
        _band(axes, times, np.zeros_like(sigma), sigma, "reported standard deviation")
        axes.plot(*broken_at_gaps(times, scored.miss[rows]), color=BLUE, label="error")
        axes.set(ylabel="horizontal error (m)", ylim=(0, None))
    legend_above(axes)
    name = scored.rows["tag"][int(rows.start)]
    rank = f", the largest RMSE of {len(scored.rmse)}" if tag is None and len(scored.rmse) > 1 else ""
    axes.set_title(literal(f"tag {name}{rank}" if name else ""), loc="right", fontsize=8, color=GREY)
    axes.set_xlabel(time_label(scored.zero))
    return axes


def _half_height(error: np.ndarray, sigma: np.ndarray) -> float:
    """Half the height that errors (n,), but for a few alone, and usual bands of 3 σ need; bands up to four times it."""
    size, known = np.sort(np.abs(error[np.isfinite(error)])), sigma[np.isfinite(sigma)]
    most = float(size[-1 - len(size) // 500]) if len(size) else 0.0
    return 1.15 * max(most, min(3 * float(np.quantile(known, 0.9)), 4 * most) if len(known) else 0.0)


def _band(axes: Axes, times: np.ndarray, low: np.ndarray, high: np.ndarray, label: str) -> None:
    at, low, high = broken_at_gaps(times, low, high)
    axes.fill_between(at, low, high, color=SKY, alpha=0.35, lw=0, label=label)


def _ends(times: np.ndarray) -> tuple[float, float] | None:
    margin = 0.01 * float(np.ptp(times)) if len(times) else 0.0
    return (float(times.min()) - margin, float(times.max()) + margin) if margin else None


def error_cdf(
    estimates: Shown | Mapping[str, Shown], recording: AnyRecording | None = None, ax: Axes | None = None
) -> Axes:
    """The distribution function of the errors, horizontal and 3-D or of angles; of several runs by name, a curve each.

    Raises UnusableInput without truth.
    """
    several = isinstance(estimates, Mapping)
    runs = _runs(estimates, recording, "error_cdf")
    first = next(iter(runs.values()))
    if several:
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
        words = ", ".join(f"p{p:.0f} {v:.3g}" for p, v in zip(MARKED, curve.quantiles(MARKED), strict=True))
        words = f"RMSE {unit.factor * np.sqrt(np.mean(values**2)):.3g}" if several else words
        curves.append(curve._replace(name=f"{name}: {words} {unit.name}"))
    axes = _axes(ax)
    for share in MARKED:
        axes.axhline(share, color=GREY, linewidth=0.7, linestyle=":")
    what = "horizontal error" if several and not first.angles else "error"
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
    runs = _runs(estimates, recording, "coverage")
    first = next(iter(runs.values())).nees_by_shape()
    shape = [*first][int(spatial)] if isinstance(estimates, Mapping) else ""
    nees = {name: scored.nees_by_shape()[shape] for name, scored in runs.items()} if shape else first
    levels = {k: chi_square_probability(v[np.isfinite(v)], dof) for k, (v, dof) in nees.items() if np.isfinite(v).any()}
    axes, at = _axes(ax), np.linspace(0, 100, 201)
    axes.plot([0, 100], [0, 100], color=GREY, linewidth=1.0, linestyle="--", label="correct covariances")
    pooled = np.concatenate([*levels.values()])
    # Of many curves none has a colour and a name of its own.
    named, width = len(levels) <= len(LINES), 0.9 if shape and len(levels) > 1 else 1.6
    for (name, values), colour in zip(levels.items(), LINES if named else [GREY] * len(levels), strict=False):
        label = _share_in_words(name, values) if named else "_"
        axes.plot(at, _inside(values, at), color=colour, linewidth=width, label=label)
    if shape and len(levels) > 1:
        axes.plot(at, _inside(pooled, at), color=BLACK, linewidth=1.9, label=_share_in_words("all rows", pooled))
        axes.plot(LEVELS[2:-1], _inside(pooled, LEVELS[2:-1]), "o", color=BLACK, markersize=4, label="_")
    ticks = LEVELS[[0, 1, 2, 3, 4, 7]]
    words = "ellipsoid" if spatial else "ellipse"
    axes.set(xlim=(0, 100.8), ylim=(0, 100.8), xticks=ticks, yticks=ticks, aspect="equal")
    axes.set(xlabel=f"level of the reported {words} (%)", ylabel=f"truth inside the {words} (% of rows)")
    axes.legend(loc="upper left" if np.mean(_inside(pooled, at) - at) < 0 else "lower right")
    axes.set_title(shape if spatial or shape == "horizontal" else "")
    return axes


def _inside(levels: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The rows, %, whose truth is inside the ellipse of each level, %; `levels` (n,): through the truth of each row."""
    return 100 * np.searchsorted(np.sort(levels), at / 100, side="right") / max(len(levels), 1)


def _share_in_words(name: str, levels: np.ndarray) -> str:
    return literal(f"{name}: {_inside(levels, np.array([95.0]))[0]:.0f} % inside 95 %")


def nees_over_time(estimates: Shown, recording: AnyRecording | None = None, ax: Axes | None = None) -> Axes:
    """The mean of the horizontal NEES per degree of freedom over time, with its band: 1 for correct covariances.

    Raises UnusableInput without truth.
    """
    scored = _scored(estimates, recording, "nees_over_time", truth=True)
    return _consistency(_axes(ax), scored, float_column(scored.rows, "nees"), np.full(len(scored.rows), 2.0), "NEES")


def nis_over_time(estimates: Shown, recording: AnyRecording | None = None, ax: Axes | None = None) -> Axes:
    """The mean of the NIS per degree of freedom over time, with its band where its distribution is known."""
    scored = _scored(estimates, recording, "nis_over_time", bearings=True)
    return _consistency(_axes(ax), scored, *_nis(scored), "NIS", scored.student_t_dof)


def _nis(scored: ScoredRecording) -> tuple[np.ndarray, np.ndarray]:
    """The NIS (n,) of all rows and its degrees of freedom (n,)."""
    return float_column(scored.rows, "nis"), float_column(scored.rows, "nis_dof")


def _consistency(
    axes: Axes, scored: ScoredRecording, values: np.ndarray, dof: np.ndarray, name: str, nu: float | None = None
) -> Axes:
    """Means of NEES or NIS (n,) over the rows of all tracks in windows of time; `nu`: as `student_t_dof`."""
    known = np.flatnonzero(np.isfinite(values) & (dof > 0))
    order, law = known[np.argsort(scored.times[known], kind="stable")], law_of(nu)
    axes.axhline(1.0, color=GREY, linewidth=0.8)
    axes.set(xlabel=time_label(scored.zero), ylabel=f"{name} / dof")
    if not len(order):
        return axes
    windows = np.array_split(order, int(np.clip(len(order) // WINDOW, 1, WINDOWS)))
    total, freedom = (np.array([x[rows].sum() for rows in windows]) for x in (values, dof))
    at = np.array([scored.times[rows].mean() for rows in windows]) - scored.zero
    ratio, band = total / freedom, np.ones((2, len(windows)))
    if law:
        band = np.stack(nis_band(freedom / _inflation(values[order] / dof[order], len(windows[0])), nu))
        axes.fill_between(at, *band, color=SKY, alpha=0.35, lw=0, label="95 % band, rows as correlated as these")
    axes.plot(at, ratio, ".-", color=BLUE, markersize=3, label=f"mean of {len(windows[0])} rows")
    legend_above(axes)
    # The first rows, with the covariance of the start, do not set the axis.
    least, largest = np.quantile(ratio, (0.02, 0.98))
    if largest > 5 or least < 0.1:
        logarithmic(axes, "y")
    bottom, top = np.median(band, axis=1)
    axes.set(ylim=(0.8 * max(min(least, bottom), 1e-3), 1.25 * max(largest, top)), xlim=_ends(at))
    text = f"mean {total.sum() / freedom.sum():.2f}, 1 expected{f' ({law})' if law else ''}"
    axes.text(0.995, 1.02, text, transform=axes.transAxes, ha="right", fontsize=8, color=GREY)
    return axes


def _inflation(values: np.ndarray, window: int) -> float:
    """So many rows carry the information of one in means of values (n,) over `window` rows; 1 at least.

    1 + 2 Σ (1 − k/w) ρₖ, w = `window` (Bartlett 1946).
    """
    # A few rows that lie far out, as of a start, do not decide.
    centred = np.minimum(values, np.quantile(values, 0.99))
    centred = centred - centred.mean()
    total = sum((1 - k / window) * float(centred[k:] @ centred[:-k]) for k in range(1, min(window, len(centred))))
    power = float(centred @ centred)
    return max(1.0, 1 + 2 * total / power) if power > 0 else 1.0


def nis_histogram(estimates: Shown, recording: AnyRecording | None = None, ax: Axes | None = None) -> Axes:
    """The histogram of the NIS of all rows, and its density for a consistent filter where that is known."""
    scored = _scored(estimates, recording, "nis_histogram", bearings=True)
    nis, dof = _nis(scored)
    known = np.isfinite(nis) & (dof > 0)
    axes = _axes(ax)
    if known.any():
        draw_nis(axes, Innovations(nis[known], dof[known], np.zeros(known.sum(), int), scored.student_t_dof))
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
    rows = scored.rows_of(_track(scored, tag, station, "bearing_over_time"))
    parts = {part.name: part for part in scored.components()}
    part = parts.get(angle) or next(iter(parts.values()))
    truth = part.values[rows] - part.errors[rows]
    known = np.isfinite(truth)
    times, reference = scored.times[rows] - scored.zero, truth[known] if known.any() else part.values[rows]
    turned = np.radians(reference[np.isfinite(reference)])
    middle = float(np.degrees(np.angle(np.exp(1j * turned).sum())))
    axes = _axes(ax)
    at, shown, sigma = broken_at_gaps(times, part.values[rows], part.sigmas[rows])
    shown = _about(middle, shown)
    if np.isfinite(sigma).any():
        _band(axes, at, shown - 3 * sigma, shown + 3 * sigma, "reported ± 3 σ")
    axes.plot(at, shown, color=BLUE, linewidth=0.9, label="estimate")
    if known.any():
        at, true = broken_at_gaps(times[known], truth[known])
        axes.plot(at, _about(middle, true), color=BLACK, linewidth=1.0, linestyle="--", label="truth")
        shown = np.concatenate([shown, _about(middle, true)])
    low, high = np.nanquantile(shown, (0.005, 0.995)) if np.isfinite(shown).any() else (0.0, 0.0)
    margin = max(0.15 * (high - low), 1.0)
    axes.set(ylim=(low - margin, high + margin), xlim=_ends(times))
    axes.set(xlabel=time_label(scored.zero), ylabel=f"{part.name} (°)")
    legend_above(axes)
    return axes


def _about(middle: float, degrees: np.ndarray) -> np.ndarray:
    """The angles within half a turn of `middle`, NaN at jumps, no line crosses the axes where one turns."""
    within = middle + 180 - (180 - (degrees - middle)) % 360
    return np.where(np.append(np.abs(np.diff(within)) > 180, False), np.nan, within)


def _runs(
    estimates: Shown | Mapping[str, Shown], recording: AnyRecording | None, chart: str
) -> dict[str, ScoredRecording]:
    runs = estimates if isinstance(estimates, Mapping) else {"": estimates}
    return {name: _scored(run, recording, chart, truth=True, bearings=True) for name, run in runs.items()}


def _scored(
    estimates: Shown, recording: AnyRecording | None, chart: str, truth: bool = False, bearings: bool = False
) -> ScoredRecording:
    """The estimates with their errors. `truth`: whether the chart needs one; `bearings`: whether it can show them.

    Raises UnusableInput for what the chart cannot show.
    """
    if isinstance(estimates, ScoredRecording):
        scored = estimates
    else:
        scored = scored_tracks(estimates, recording, truth).recordings[0]
    if scored.angles and not bearings:
        raise UnusableInput(f"{chart}: found bearings; expected estimates of positions")
    if truth and not scored.scored.any():
        raise UnusableInput(f"{chart}: no estimate has a truth at its time")
    return scored


def _axes(ax: Axes | None) -> Axes:
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots(layout="constrained")[1]


def _track(scored: ScoredRecording, tag: str | None, station: str | None, chart: str) -> int:
    """The number of the track of a tag, and of a station; of none that with the largest RMSE."""
    if tag is None and station is None:
        return scored.worst_first()[0]
    tags = [str(name) for name in scored.first["tag"]]
    stations = [str(name) for name in scored.first["station"]] if scored.angles else [station] * len(tags)
    matches = [k for k in scored.worst_first() if tag in (None, tags[k]) and station in (None, stations[k])]
    if not matches:
        named = f"tag '{tag}'" + ("" if station is None else f" at station '{station}'")
        raise UnusableInput(f"{chart}: no estimate of {named}; tags: {', '.join(sorted({*tags}, key=natural))}")
    return matches[0]


_FUNCTIONS = [value for value in globals().values() if isfunction(value) and value.__module__ == __name__]
__all__ = [function.__name__ for function in _FUNCTIONS if not function.__name__.startswith("_")]

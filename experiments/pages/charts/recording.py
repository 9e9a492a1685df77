"""The charts of a recording's estimates, each one function of scored estimates: for a notebook, a file and the page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from trackwright.experiments.pages.charts import style
from trackwright.experiments.pages.charts.distributions import Curve, distribution, law_of, nis_chart
from trackwright.experiments.pages.charts.floor import PlanPath, natural, plan, track_paths, true_path
from trackwright.experiments.pages.charts.residuals import Residuals, error_map, residual_charts
from trackwright.experiments.pages.charts.style import Chart, Line, band, broken_at_gaps, rule
from trackwright.experiments.pages.scored_tracks import ScoredRecording, ScoredTracks, drawn_of
from trackwright.experiments.text.wording import SHOWN, length_unit
from trackwright.trackers.core.data.consistency import chi_square_probability
from trackwright.trackers.core.data.seconds import time_label
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.columns import float_column
from trackwright.tuning.diagnostics import Innovations, nis_band

MARKED = (50.0, 90.0, 95.0)
"""Percentiles marked on the distribution of errors."""

LEVELS = {level: str(level) for level in (0, 25, 50, 75, 90, 100)}
"""Ticks of levels of ellipses, %."""

ELLIPSES = 24
"""The most ellipses in all, at most half of them along one track; more would hide the tracks."""

WINDOW, WINDOWS = 20, 120
"""The fewest rows of a mean of NEES or NIS over time, and the most means."""

WIDE: dict[str, Any] = {"width": 8.0, "height": 2.6}


def floor_plan(scored: ScoredRecording, tags: Sequence[str] = ()) -> Chart:
    """The estimated paths over the floor, m, with truth, anchors and stations where the recording has any.

    Some estimates have their reported 95 % ellipse. `tags`: those drawn, at most six; by default all, or of more the
    worst, the median and the best. Outliers don't set the scale; a note names their number. Raises UnusableInput for
    bearings, and for an unknown tag.
    """
    names = [str(tag) for tag in scored.first["tag"]]
    order = sorted(range(len(names)), key=lambda k: natural(names[k]))
    chosen = drawn_of(scored.rmse[order], False, len(style.LINES))
    shown = dict.fromkeys(tags[: len(style.LINES)], "") or {names[order[k]]: why for k, why in chosen.items()}
    paths, truths = list[PlanPath](), list[np.ndarray]()
    for (tag, remark), colour in zip(shown.items(), style.LINES, strict=False):
        k, most = track_number(scored, tag), min(ELLIPSES // len(shown), ELLIPSES // 2)
        name = (f"tag {tag}" if tag else "estimates") + (f": {remark}" if remark else "")
        paths += track_paths([scored], k, [(name, colour, "")], most)
        truths += true_path(scored, k)
    notes = ["Dots: estimates with their reported 95 % ellipses."] if any(len(path.covs) for path in paths) else []
    notes += [f"{len(paths)} of {len(names)} tags are shown."] if len(names) > len(paths) else []
    chart = plan("floor-plan", "Floor plan", paths, truths, scored.folder.rig)
    drawn = np.concatenate([path.positions for path in paths] or [np.zeros((0, 2))])
    (left, right), (bottom, top) = chart.limits("x"), chart.limits("y")
    outside = int(((drawn < (left, bottom)) | (drawn > (right, top))).any(axis=1).sum())
    notes += [f"{outside} of {np.isfinite(drawn[:, 0]).sum()} estimates lie outside the axes."] if outside else []
    return replace(chart, note=" ".join(notes))


def error_over_time(scored: ScoredRecording, tag: str | None = None, axis: str = "") -> Chart:
    """The horizontal position error of a tag over time, with the reported standard deviation of that distance.

    `tag`: by default the one with the largest RMSE. `axis`: x, y or z for the error along that axis, with ± 3 σ.
    Raises UnusableInput without truth, and for an unknown tag.
    """
    rows, several = scored.rows_of(track_number(scored, tag)), tag is None and len(scored.rmse) > 1
    errors, sigmas = scored.errors[rows], scored.sigmas[rows]
    name = scored.rows["tag"][int(rows.start)]
    note = f"Tag {name}{f', the largest RMSE of {len(scored.rmse)}' * several}." if name else ""
    known = {name: k for k, name in enumerate("xyz") if np.isfinite(errors[:, k]).any()}
    if axis and axis not in known:
        raise UnusableInput(f"error_over_time: no error along '{axis}'; expected one of x, y and z with a truth")
    if axis:
        error, sigma, low, word = errors[:, known[axis]], 3 * sigmas[:, known[axis]], -1.0, "± 3 σ"
    else:
        error, sigma, low, word = scored.miss[rows], np.hypot(sigmas[:, 0], sigmas[:, 1]), 0.0, "standard deviation"
    at, error, sigma = broken_at_gaps(scored.times[rows] - scored.zero, error, sigma)
    parts = [band(at, low * sigma, sigma, f"reported {word}"), Line(at, error, "error", width=0.9)]
    name, label = f"error-over-time{axis and f'-{axis}'}", f"error in {axis} (m)" if axis else "horizontal error (m)"
    look: dict[str, Any] = {"ylim": (None if axis else 0, None), "robust": True, "note": note, **WIDE}
    return Chart(name, "Error over time", time_label(scored.zero), label, parts, **look)


def error_cdf(scored: ScoredRecording | Mapping[str, ScoredRecording]) -> Chart:
    """The distribution function of the errors, horizontal and 3-D or of angles; of several runs by name, a curve each.

    Raises UnusableInput without truth.
    """
    several = isinstance(scored, Mapping)
    runs = scored if isinstance(scored, Mapping) else {"": scored}
    first = next(iter(runs.values()))
    if several:
        errors = {name: run.miss for name, run in runs.items()}
    elif first.angles:
        errors = {part.name: np.radians(np.abs(part.errors)) for part in first.components()}
    else:
        errors = {"horizontal": first.miss, "3-D": np.sqrt((first.errors**2).sum(axis=1))}
    known = {name: values[np.isfinite(values)] for name, values in errors.items() if np.isfinite(values).any()}
    furthest = max(float(np.quantile(values, 0.995)) for values in known.values()) or 1.0
    unit = SHOWN["rad"] if first.angles else length_unit(furthest / 2)
    curves = []
    for name, values in known.items():
        curve = Curve.of(name, unit.factor * values)
        words = ", ".join(f"p{p:.0f} {v:.3g}" for p, v in zip(MARKED, curve.quantiles(MARKED), strict=True))
        words = f"RMSE {unit.factor * np.sqrt(np.mean(values**2)):.3g}" if several else words
        curves.append(curve._replace(name=f"{name}: {words} {unit.name}"))
    quantity = f"{'horizontal error' if several and not first.angles else 'error'} ({unit.name})"
    note, end = f"{int(np.isfinite(first.miss).sum())} estimates.", 1.05 * unit.factor * furthest
    return distribution(
        "error-cdf", "Distribution of errors", curves, quantity, end, MARKED, note=note, width=6.4, height=3.4
    )


def coverage(scored: ScoredRecording | Mapping[str, ScoredRecording], spatial: bool = False) -> Chart:
    """The observed share of the truth inside the reported ellipses against their level: the diagonal is correct.

    Of several runs by name a curve each, of ellipses, or `spatial` of ellipsoids; of one run both, or those of angles.
    Raises UnusableInput without truth.
    """
    runs = scored if isinstance(scored, Mapping) else {"": scored}
    first = next(iter(runs.values())).nees_by_shape()
    shape = [*first][int(spatial)] if isinstance(scored, Mapping) else ""
    nees = {name: run.nees_by_shape()[shape] for name, run in runs.items()} if shape else first
    levels = {k: chi_square_probability(v[np.isfinite(v)], dof) for k, (v, dof) in nees.items() if np.isfinite(v).any()}
    if shape and len(levels) > 1:
        levels["all rows"] = np.concatenate([*levels.values()])
    at, parts = np.linspace(0, 100, 201), [Line([0, 100], [0, 100], "correct covariances", style.GREY, 1.0, "dash")]
    # Of many curves none has a colour and a name of its own.
    named = len(levels) <= len(style.LINES) + 1
    for k, (name, values) in enumerate(levels.items()):
        inside, label = _inside(values, at), f"{name}: {_inside(values, np.array([95.0]))[0]:.0f} % inside 95 %"
        pooled = name == "all rows" and k > 0
        colour = style.BLACK if pooled else style.LINES[k % len(style.LINES)] if named else style.GREY
        parts.append(Line(at, inside, label if named or pooled else "", colour, 1.9 if pooled else 1.3))
    words, title = ("ellipsoid", "ellipsoids") if spatial else ("ellipse", "ellipses")
    ends: dict[str, Any] = {"xlim": (0, 100.8), "ylim": (0, 100.8), "xticks": LEVELS, "yticks": LEVELS, "equal": True}
    return Chart("coverage-3d" if spatial else "coverage", f"Truth inside the reported {title}",
                 f"level of the reported {words} (%)", f"truth inside the {words} (% of rows)", parts, **ends,
                 note=f"{shape}.".capitalize() if shape else "", width=4.7, height=4.6)  # fmt: skip


def _inside(levels: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The rows, %, whose truth is inside the ellipse of each level, %; `levels` (n,): through the truth of each row."""
    return 100 * np.searchsorted(np.sort(levels), at / 100, side="right") / max(len(levels), 1)


def nees_over_time(scored: ScoredRecording) -> Chart:
    """The mean of the horizontal NEES per degree of freedom over time, with its band: 1 for correct covariances.

    Raises UnusableInput without truth.
    """
    return _consistency(scored, "NEES", np.full(len(scored.rows), 2.0), "slow", None)


def nis_over_time(scored: ScoredRecording) -> Chart:
    """The mean of the NIS per degree of freedom over time, with its band where its distribution is known."""
    return _consistency(scored, "NIS", float_column(scored.rows, "nis_dof"), "slow_nis", scored.student_t_dof)


def _consistency(scored: ScoredRecording, name: str, dof: np.ndarray, slow: str, nu: float | None) -> Chart:
    """Means of NEES or NIS over the rows of all tracks in windows of time; `slow`: rows with the information of one."""
    values, of_one = (float_column(scored.rows, column) for column in (name.lower(), slow))
    known = np.flatnonzero(np.isfinite(values) & (dof > 0))
    order, law, parts, note = known[np.argsort(scored.times[known], kind="stable")], law_of(nu), list[Line](), ""
    if len(order):
        windows = np.array_split(order, int(np.clip(len(order) // WINDOW, 1, WINDOWS)))
        total, freedom = (np.array([x[rows].sum() for rows in windows]) for x in (values, dof))
        at = np.array([scored.times[rows].mean() for rows in windows]) - scored.zero
        if law:
            several = of_one[order][np.isfinite(of_one[order])]
            one = float(np.clip(several.mean(), 1.0, len(windows[0]))) if len(several) else 1.0
            ends = nis_band(freedom / one, nu)
            parts.append(band(at, *ends, "95 % band, rows as correlated as these"))
        mean = Line(at, total / freedom, f"mean of {len(windows[0])} rows", marker="circle", size=3)
        parts += [rule(1.0, (at[0], at[-1])), mean]
        note = f"Mean {total.sum() / freedom.sum():.2f}, 1 expected{f' ({law})' if law else ''}."
    labels = f"{name.lower()}-over-time", f"{name} over time", time_label(scored.zero), f"{name} / dof"
    return Chart(*labels, parts, robust=True, log="y", note=note, **WIDE)


def nis_histogram(scored: ScoredRecording) -> Chart:
    """The histogram of the NIS of all rows, and its density for a consistent filter where that is known."""
    nis, dof = (float_column(scored.rows, name) for name in ("nis", "nis_dof"))
    known = np.isfinite(nis) & (dof > 0)
    if not known.any():
        return Chart("nis-histogram", "NIS of all rows", "NIS of a row", "density", [], **WIDE)
    innovations = Innovations(nis[known], dof[known], np.zeros(known.sum(), int), scored.student_t_dof)
    return nis_chart("nis-histogram", "NIS of all rows", innovations, **WIDE)


def bearing_over_time(
    scored: ScoredRecording, tag: str | None = None, station: str | None = None, angle: str = ""
) -> Chart:
    """An angle of a tag's bearings at a station over time, °, with the reported ± 3 σ and the truth.

    `tag`, `station`: by default those with the largest error. `angle`: azimuth or elevation; in the plane of a flat
    array there is one angle alone. Raises UnusableInput for positions.
    """
    if not scored.angles:
        raise UnusableInput("bearing_over_time: found positions; expected bearings")
    rows = scored.rows_of(track_number(scored, tag, station))
    parts = {part.name: part for part in scored.components()}
    part = parts.get(angle) or next(iter(parts.values()))
    truth = part.values[rows] - part.errors[rows]
    known = np.isfinite(truth)
    times, reference = scored.times[rows] - scored.zero, truth[known] if known.any() else part.values[rows]
    turned = np.radians(reference[np.isfinite(reference)])
    middle = float(np.degrees(np.angle(np.exp(1j * turned).sum())))

    def about(degrees: np.ndarray) -> np.ndarray:
        """Within half a turn of the middle, NaN at jumps: no line crosses the axes where an angle turns."""
        within = middle + 180 - (180 - (degrees - middle)) % 360
        return np.where(np.append(np.abs(np.diff(within)) > 180, False), np.nan, within)

    at, shown, sigma = broken_at_gaps(times, part.values[rows], part.sigmas[rows])
    shown = about(shown)
    lines = [band(at, shown - 3 * sigma, shown + 3 * sigma, "reported ± 3 σ"), Line(at, shown, "estimate", width=0.9)]
    if known.any():
        at, true = broken_at_gaps(times[known], truth[known])
        lines.append(Line(at, about(true), "truth", style.BLACK, 1.0, "dash"))
    label = time_label(scored.zero), f"{part.name} (°)"
    return Chart("bearings", "Bearing over time", *label, lines, robust=True, **WIDE)


def track_number(scored: ScoredRecording, tag: str | None, station: str | None = None) -> int:
    """The number of the track of a tag, and of a station; of none that with the largest RMSE."""
    tags = [str(name) for name in scored.first["tag"]]
    stations = [str(name) for name in scored.first["station"]] if scored.angles else [station] * len(tags)
    matches = [k for k in scored.worst_first() if tag in (None, tags[k]) and station in (None, stations[k])]
    if not matches:
        named = f"tag '{tag}'" + ("" if station is None else f" at station '{station}'")
        raise UnusableInput(f"plot: no estimate of {named}; tags: {', '.join(sorted({*tags}, key=natural))}")
    return matches[0]


def page_charts(scored: ScoredRecording, found: list[Residuals]) -> list[Chart]:
    """The charts of all rows on the page of a recording with these residuals."""
    shown = [*residual_charts(found), *error_map(scored)]
    shown += [error_cdf(scored)] if scored.scored.any() else []
    return [*shown, coverage(scored)] if scored.is_covered else shown


def plot_tracks(out: Path, tracks: ScoredTracks, kind: str = "png") -> list[str]:
    """Writes the charts of tracks and their errors into the folder `out`; returns the names of the files.

    `kind`: the ending of the files, png or pdf. Of many recordings those in `tracks.drawn` have charts, all together
    the coverage of their ellipses; of bearings a few tracks have one of each angle instead.
    """
    # matplotlib takes a third of a second to import, which a page need not wait for.
    from trackwright.experiments.pages.charts.drawing import write_charts

    figures = [*_bearings(tracks)] if tracks.bearing else []
    for k, why in ({} if tracks.bearing else tracks.drawn).items():
        scored, name = tracks.recordings[k], tracks.recordings[k].folder.name
        charts = [floor_plan(scored)]
        if scored.scored.any():
            known = np.isfinite(scored.errors[scored.rows_of(scored.worst_first()[0])]).any(axis=0)
            over_time = [error_over_time(scored, axis="xyz"[c]) for c in np.flatnonzero(known)]
            charts += [
                error_cdf(scored),
                *over_time,
                nees_over_time(scored),
                nis_over_time(scored),
                nis_histogram(scored),
            ]
        suffix = "" if len(tracks.folders) == 1 else f"-{name}"
        figures += [_renamed(chart, chart.name + suffix, chart.title, name, why) for chart in charts]
    covered = {scored.folder.name: scored for scored in tracks.recordings if scored.is_covered}
    spatial = bool(np.isfinite(float_column(tracks.rows, "nees_3d")).any())
    figures += [coverage(covered, one) for one in [False, *[True] * spatial] if covered]
    return write_charts(out, figures, kind)


def _bearings(tracks: ScoredTracks) -> Iterator[Chart]:
    """Of a few tracks their angles over time."""
    ordered = sorted(tracks.recordings, key=lambda recording: recording.folder.name)
    pairs = [(scored, k) for scored in ordered for k in range(len(scored.rmse))]
    for place, why in drawn_of(np.concatenate([scored.rmse for scored in ordered]), True).items():
        scored, k = pairs[place]
        key = scored.first.select("tag", "station").row(k, named=True)
        words = scored.folder.name, f"tag {key['tag']}", f"station {key['station']}"
        for part in scored.components():
            name = f"bearings-{'-'.join(words)}-{part.name}".replace(" ", "_")
            yield _renamed(bearing_over_time(scored, **key, angle=part.name), name, *words, why)


def _renamed(chart: Chart, name: str, *title: str) -> Chart:
    return replace(chart, name=name, title=", ".join(filter(None, title)))

"""Figures of a comparison of runs: distributions of their errors, boxes and violins, and floor plans side by side."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import polars as pl
from matplotlib.axes import Axes

from trackwright.experiments.pages.charts.distributions import Curve, draw_distributions
from trackwright.experiments.pages.charts.floor import draw_plan, track_paths, true_path
from trackwright.experiments.pages.charts.style import BLACK, LINES, Chart, legend_above, literal, plain
from trackwright.experiments.pages.reports.comparison import Contrast
from trackwright.experiments.pages.reports.runs import StudyRun, TrackRun
from trackwright.experiments.pages.scored_tracks import ScoredTracks, drawn_of
from trackwright.experiments.text.wording import SHOWN, Unit, heading, length_unit, unit_of
from trackwright.trackers.evaluation.comparison import main_size
from trackwright.trackers.evaluation.metrics import metrics, sums

MOST_PLANS = 3
"""Recordings with floor plans: of more the worst, the median and the best by the RMSE of the first run."""

MOST_TAGS = 4
"""Tags of a floor plan."""

MOST_POINTS = 2000
"""Errors of a violin."""


def comparison_charts(runs: Sequence[StudyRun] | Sequence[TrackRun], contrasts: Sequence[Contrast]) -> list[Chart]:
    """The charts of the page, which are files beside it, too."""
    tracks = [run for run in runs if isinstance(run, TrackRun) and run.rows is not None]
    if not tracks:
        wanted = bool(contrasts) and isinstance(runs[0], StudyRun)
        return [Chart("differences", "Differences", partial(_draw_intervals, contrasts=contrasts))] if wanted else []
    furthest, unit = _scale(tracks)
    of_errors = {"errors": ("Distribution of errors", _draw_distributions), "boxes": ("Boxes of errors", _draw_violins)}
    charts = [
        Chart(name, title, partial(draw, runs=tracks, furthest=furthest, unit=unit))
        for name, (title, draw) in of_errors.items()
    ]
    plans = [run for run in tracks if not run.bearing]
    for name, why in _planned(plans).items():
        for run, colour in zip(plans, _colours(len(plans)), strict=True):
            draw = partial(_draw_plan, run=run, name=name, colour=colour, why=why)
            charts.append(
                Chart(f"floor_plan-{name}-{run.name}", f"Floor plan of {name} by {run.name}", draw, height=None)
            )
    return charts


def all_errors(run: TrackRun) -> np.ndarray:
    """The sorted horizontal errors, m, of all tracks, or the angles, rad, of bearings."""
    assert run.rows is not None
    return np.sort(run.rows[main_size(run.rows)].drop_nulls().to_numpy())


def _scale(runs: Sequence[TrackRun]) -> tuple[float, Unit]:
    """The end of the axes of errors, in that unit, and the unit: the tail of one run alone shall not set it.

    The second largest 99th percentile of the runs, or the largest 95th where that is more.
    """
    p95, p99 = (sorted(float(np.quantile(all_errors(run), share)) for run in runs) for share in (0.95, 0.99))
    furthest = max(p95[-1], p99[-2:][0])
    unit = SHOWN["rad"] if runs[0].bearing else length_unit(furthest / 2)
    return unit.factor * furthest, unit


def _quantity(runs: Sequence[TrackRun], unit: Unit) -> str:
    return f"{'angle to the true direction' if runs[0].bearing else 'horizontal error'} ({unit.name})"


def _draw_distributions(axes: Axes, runs: Sequence[TrackRun], furthest: float, unit: Unit) -> None:
    curves = []
    for run in runs:
        errors = unit.factor * all_errors(run)
        beyond = 100 * np.mean(errors > 1.02 * furthest)
        curves.append(Curve.of(run.name + (f", {beyond:.1f} % beyond" if beyond >= 0.1 else ""), errors))
    draw_distributions(axes, curves, _quantity(runs, unit), 1.02 * furthest)
    legend_above(axes, 3)


def _draw_violins(axes: Axes, runs: Sequence[TrackRun], furthest: float, unit: Unit) -> None:
    errors = [unit.factor * all_errors(run) for run in runs]
    places, colours = np.arange(len(errors)), _colours(len(errors))
    thinned = [e[np.linspace(0, len(e) - 1, min(len(e), MOST_POINTS)).astype(int)] for e in errors]
    spread = [k for k, e in enumerate(thinned) if np.ptp(e) > 0]
    if spread:
        drawn = axes.violinplot([thinned[k] for k in spread], spread, widths=0.85, showextrema=False)
        for k, body in zip(spread, list(drawn["bodies"]), strict=True):  # type: ignore[call-overload]
            body.set(facecolor=colours[k], alpha=0.35)
    black = {"color": BLACK}
    axes.boxplot(thinned, positions=places, widths=0.2, whis=(5, 95), showfliers=False, medianprops=black)
    for place, error, colour in zip(places, errors, colours, strict=True):
        axes.plot(place, np.sqrt(np.mean(error**2)), "o", color=colour, markeredgecolor="white", markersize=6, zorder=5)
    axes.set_xticks(places, [literal(run.name) for run in runs], rotation=20 if len(errors) > 3 else 0)
    axes.set(ylim=(0, 1.02 * furthest), xlim=(-0.7, len(errors) - 0.3))
    axes.set(ylabel=_quantity(runs, unit), xlabel="box: quartiles, whiskers: 5 and 95 %, point: RMSE")
    axes.set_title("Errors by run")
    plain(axes, "y")


def _planned(runs: Sequence[TrackRun]) -> dict[str, str]:
    """The recordings of all runs with floor plans, and why these."""
    if not runs:
        return {}
    rows = [run.rows.filter(pl.col("why").is_null()) for run in runs if run.rows is not None]
    first, *others = (sums(of_run, "recording", of=["rmse_m"]) for of_run in rows)
    for other in others:
        first = first.join(other, "recording", "semi", maintain_order="left")
    names = first["recording"].to_list()
    chosen = drawn_of(metrics(first)["rmse_m"].to_numpy(), False, MOST_PLANS) if names else {}
    return {names[k]: f"{why} by {runs[0].name}" if why else "" for k, why in chosen.items()}


def _draw_plan(axes: Axes, run: TrackRun, name: str, colour: str, why: str) -> None:
    """Estimates in the run's colour over the truth, with anchors, stations and their names."""
    assert run.rows is not None
    (scored,) = ScoredTracks(run.rows, [run.recordings[name]], ()).recordings
    shown = range(len(scored.rmse))[:MOST_TAGS]
    paths = [path for k in shown for path in track_paths([scored], k, [("" if k else "estimates", colour, "_")], 0)]
    # Around the truth: the runs share their axes, and the worst of them shall not set these.
    truths = [truth for k in shown for truth in true_path(scored, k)]
    draw_plan(axes, paths, truths, scored.folder.rig, around_estimates=False)
    title = literal(f"{run.name}, {name}" + (f",\n{why}" if why else ""))
    axes.set_title(title, fontsize=8.5, pad=30)
    legend_above(axes, 3)


def _draw_intervals(axes: Axes, contrasts: Sequence[Contrast]) -> None:
    """The metrics of studies with their intervals less the first study's."""
    metric = next((m for m in ("rmse_m", "rmse_direction_rad") if any(c.metric == m for c in contrasts)), "")
    shown = [contrast for contrast in contrasts if contrast.metric == (metric or contrasts[0].metric)][:60]
    names = list(dict.fromkeys(contrast.run for contrast in shown))
    subjects = list(dict.fromkeys(contrast.subject for contrast in shown))
    unit = unit_of(shown[0].metric, [contrast.difference.first for contrast in shown])
    for contrast in shown:
        k, n = subjects.index(contrast.subject), names.index(contrast.run)
        d, colour = contrast.difference, _colours(len(names))[n]
        height = len(subjects) - 1 - k + 0.12 * (n - (len(names) - 1) / 2)
        ends = [unit.factor * x for x in (d.low, d.high)]
        axes.plot(ends, [height] * 2, color=colour, label=literal(contrast.run) if k == 0 else None)
        axes.plot(unit.factor * d.value, height, "o" if contrast.differs else ".", color=colour)
    axes.axvline(0, color=BLACK, linewidth=0.7)
    axes.set_yticks(np.arange(len(subjects))[::-1], [literal(s) for s in subjects])
    axes.set(xlabel=f"{heading(shown[0].metric, unit)}, less the first study's; large point: differs")
    plain(axes, "x")
    legend_above(axes, 3)


def _colours(count: int) -> list[str]:
    return [LINES[k % len(LINES)] for k in range(count)]

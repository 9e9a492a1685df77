"""Drawings of what the filter says and does, before and after: NIS against χ², its autocorrelation, errors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from experiments.plots.drawings import NARROW, WIDTH, drawn, plain
from experiments.plots.style import BLUE, VERMILION, broken_at_gaps, literal
from experiments.reports.tuning_data import ErrorTrack
from trackers.core.metrics import chi_square_quantile
from tuning.diagnostics import Innovations, autocorrelation, expected_density, probabilities

BEFORE = "#7b8794"
LAGS = 30
POINTS = 250
SHOWN = 6
"""The most trajectories whose errors are drawn over time."""


def density_chart(before: Innovations, after: Innovations) -> str:
    """The histograms of NIS before and after, and the density of χ² with the rows' degrees of freedom."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        end = 1.25 * chi_square_quantile(0.995, float(np.quantile(after.dof, 0.9)))
        bins = np.linspace(0, end, 36)
        old, new = (np.histogram(v.nis, bins)[0] / (len(v.nis) * (bins[1] - bins[0])) for v in (before, after))
        axes.stairs(new, bins, fill=True, color=BLUE, alpha=0.35, label="after")
        axes.stairs(old, bins, color=BEFORE, linewidth=1.3, label="before")
        x = np.linspace(end / 400, end, 400)
        density = expected_density(x, after)
        axes.plot(x, density, color=VERMILION, linewidth=1.6, label=f"consistent ({_expected(after)})")
        # Before a fit the first bin may tower over all the rest, which is then cut off.
        peak = float(density[x > bins[1] / 2].max())
        highest = max(peak, min(float(max(old.max(), new.max())), 2.5 * peak))
        axes.set(xlim=(0, end), ylim=(0, 1.12 * highest), xlabel="NIS of a row", yticks=())
        beyond = [f"{np.mean(values.nis > end):.1%}".replace("%", " %") for values in (before, after)]
        axes.legend(loc="upper right", title=f"beyond the axis: {beyond[0]} before, {beyond[1]} after",
                    title_fontsize=8, alignment="left")  # fmt: skip
        axes.set_title("NIS of all rows")
        plain(axes, "")

    return drawn(draw, NARROW, NARROW * 0.92)


def probability_chart(before: Innovations, after: Innovations) -> str:
    """The histograms of the χ² probabilities of NIS, which are level where the filter is consistent."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        bins = np.linspace(0, 1, 21)
        heights = {}
        for name, values in (("before", before), ("after", after)):
            counts = np.histogram(probabilities(values), bins)[0]
            heights[name] = counts / max(counts.sum(), 1) * (len(bins) - 1)
        axes.stairs(heights["after"], bins, fill=True, color=BLUE, alpha=0.35, label="after")
        axes.stairs(heights["before"], bins, color=BEFORE, linewidth=1.3, label="before")
        axes.axhline(1.0, color=VERMILION, linewidth=1.6, label="consistent")
        highest = max(2.0, float(heights["after"].max()), min(float(heights["before"].max()), 6.0))
        axes.set(xlim=(0, 1), ylim=(0, 1.3 * highest), xlabel="probability of a smaller NIS", ylabel="density")
        axes.legend(loc="upper center", ncols=3)
        axes.set_title("Every row by its own degrees of freedom")
        plain(axes)

    return drawn(draw, NARROW, NARROW * 0.92)


def autocorrelation_chart(before: Innovations, after: Innovations) -> str:
    """The autocorrelation of NIS, as normal scores, over rows; near zero where the innovations are white."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        lags = np.arange(1, LAGS + 1)
        old, _ = autocorrelation(before, LAGS)
        new, pairs = autocorrelation(after, LAGS)
        band = 1.96 / np.sqrt(max(pairs, 1))
        axes.axhspan(-band, band, color=VERMILION, alpha=0.16, linewidth=0, label="95 % of white noise")
        axes.axhline(0, color=VERMILION, linewidth=0.8)
        axes.vlines(lags, 0, new, color=BLUE, linewidth=2.4, alpha=0.55)
        axes.plot(lags, new, "o", color=BLUE, markersize=3.5, label="after")
        axes.plot(lags, old, "o-", color=BEFORE, markersize=2.5, linewidth=0.8, label="before")
        known = np.concatenate([old, new, [band, -band]])
        low, high = float(np.nanmin(known)), float(np.nanmax(known))
        axes.set(xlabel="rows apart", xlim=(0, LAGS + 1), ylim=(low - 0.1 * (high - low), high + 0.4 * (high - low)))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.legend(loc="upper right", ncols=2)
        axes.set_title("Autocorrelation of NIS as normal scores")
        plain(axes)

    return drawn(draw, NARROW, NARROW * 0.92)


def rmse_chart(errors: Sequence[ErrorTrack], unit: str) -> str:
    """The RMSE of every trajectory before and after, the largest on top."""
    rows = sorted(((_rms(e.before), _rms(e.after), e.name) for e in errors), key=lambda row: row[0])
    kept = rows if len(rows) <= 24 else rows[-24:]

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for k, (old, new, _) in enumerate(kept):
            axes.plot([old, new], [k, k], color=BLUE if new <= old else VERMILION, linewidth=1.6, alpha=0.6, zorder=1)
        places = np.arange(len(kept))
        axes.plot([r[0] for r in kept], places, "o", markerfacecolor="white", color=BEFORE, markersize=6,
                  label="before")  # fmt: skip
        axes.plot([r[1] for r in kept], places, "o", color=BLUE, markersize=6, label="after")
        axes.set_yticks(places, [literal(_short(r[2])) for r in kept])
        axes.set(xlabel=f"RMSE ({unit})", ylim=(-0.6, len(kept) - 0.4))
        axes.set_xlim(0, 1.06 * max(max(r[:2]) for r in kept))
        axes.legend(loc="lower left", bbox_to_anchor=(-0.01, 1.0), ncols=2)
        plain(axes, "x")

    return drawn(draw, WIDTH, max(2.0, 1.0 + 0.24 * len(kept)))


def distribution_chart(errors: Sequence[ErrorTrack], unit: str) -> str:
    """The share of rows whose error is at most so large, before and after."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        longest = 0.0
        for name, colour, width in (("before", BEFORE, 1.3), ("after", BLUE, 1.9)):
            pooled = np.concatenate([getattr(e, name) for e in errors])
            ordered = np.sort(pooled[np.isfinite(pooled)])
            shares = np.linspace(0, 1, min(len(ordered), 400))
            at = np.quantile(ordered, shares)
            marked = np.quantile(ordered, 0.95)
            axes.plot(at, shares, color=colour, linewidth=width, label=f"{name}: 95 % within {marked:.3g} {unit}")
            axes.plot([marked], [0.95], "o", color=colour, markersize=4.5, markeredgecolor="white")
            longest = max(longest, float(np.quantile(ordered, 0.99)))
        axes.set(xlim=(0, 1.05 * longest), ylim=(0, 1.02), xlabel=f"error ({unit})")
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0, symbol=" %"))
        axes.legend(loc="lower right")
        axes.set_title("Share of rows with at most this error")
        plain(axes)

    return drawn(draw)


def error_charts(errors: Sequence[ErrorTrack], unit: str) -> list[tuple[str, str]]:
    """The name of a trajectory and its errors over time, of those whose RMSE changed most."""
    chosen = sorted(errors, key=lambda e: -abs(_rms(e.after) - _rms(e.before)))[:SHOWN]
    pooled = np.concatenate([np.concatenate([e.before, e.after]) for e in chosen])
    top = 1.05 * float(np.nanquantile(pooled, 0.998)) or 1.0
    return [(track.name, _over_time(track, unit, top)) for track in chosen]


def _over_time(track: ErrorTrack, unit: str, top: float) -> str:
    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        at, old, new = broken_at_gaps(*_smooth(track))
        axes.plot(at, old, color=BEFORE, linewidth=0.9, label="before")
        axes.plot(at, new, color=BLUE, linewidth=1.2, label="after")
        axes.set_title(literal(_short(track.name)))
        axes.set(ylim=(0, top), xlabel="time (s)", ylabel=f"error ({unit})")
        axes.margins(x=0.01)
        axes.legend(loc="lower right", bbox_to_anchor=(1.01, 1.0), ncols=2)
        plain(axes)

    return drawn(draw, WIDTH, 2.1)


def _expected(innovations: Innovations) -> str:
    return "χ²" if innovations.student_t_dof is None else "Student's t"


def _smooth(track: ErrorTrack) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times and errors, of long trajectories the root mean square of every so many rows, at most `POINTS` of them."""
    rows = -(-len(track.times) // POINTS)
    starts = np.arange(0, len(track.times), rows)
    count = np.add.reduceat(np.ones(len(track.times)), starts)

    def root(values: np.ndarray) -> np.ndarray:
        found: np.ndarray = np.sqrt(np.add.reduceat(values**2, starts) / count)
        return found

    return np.add.reduceat(track.times, starts) / count, root(track.before), root(track.after)


def _rms(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")


def _short(name: str) -> str:
    return name if len(name) <= 34 else name[:16] + "…" + name[-17:]

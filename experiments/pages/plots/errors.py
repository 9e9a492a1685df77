"""Plots of errors against truth: over time, their distribution, over many runs, and before and after tuning."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from trackwright.experiments.pages.plots.style import (
    BEFORE,
    BLUE,
    GREY,
    SKY,
    VERMILION,
    WIDTH,
    broken_at_gaps,
    figure_file,
    legend_above,
    literal,
    plain,
    svg_address,
)
from trackwright.experiments.pages.reports.tuning_data import ErrorTrack
from trackwright.experiments.text.wording import length_unit
from trackwright.trackers.core.data.metrics import percentiles

MARKED = (50.0, 90.0, 95.0)
"""Percentiles marked on the distribution of errors."""

POINTS = 250
SHOWN = 6
"""The most trajectories whose errors are drawn over time."""


def error_over_time(
    path: Path | str,
    times: np.ndarray,
    errors: np.ndarray,
    sigmas: np.ndarray,
    bounds: np.ndarray | None = None,
    names: Sequence[str] = ("x", "y", "z"),
    angles: bool = False,
    title: str = "Error over time",
    xlabel: str = "time (s)",
) -> Path:
    """Writes the error of each axis with the reported ± 3 σ; returns the path.

    `times` (n,) s; `errors`, `sigmas` (n, d) m, or rad with `angles`; NaN where missing. `bounds` (n, d): the
    posterior Cramér–Rao bound as a standard deviation. Errors of a single row don't set the scale.
    """
    columns = [k for k in range(errors.shape[1]) if np.isfinite(errors[:, k]).any()]
    unit, scale = _unit(errors, angles)
    halves = {k: scale * _half_height(errors[:, k], sigmas[:, k]) for k in columns}
    with figure_file(path, 8.0, 1.0 + 1.7 * max(len(columns), 1), title) as figure:
        panels = figure.subplots(max(len(columns), 1), 1, sharex=True, squeeze=False)[:, 0]
        for k, axes in zip(columns, panels, strict=False):
            limits = [] if bounds is None else [bounds[:, k]]
            at, error, sigma, *limits = broken_at_gaps(times, errors[:, k], sigmas[:, k], *limits)
            axes.fill_between(
                at, -3 * scale * sigma, 3 * scale * sigma, color=SKY, alpha=0.35, lw=0, label="reported ± 3 σ"
            )
            axes.plot(at, scale * error, color=BLUE, linewidth=0.9, label="error")
            for limit in limits:
                line = {"color": VERMILION, "linewidth": 1.1, "linestyle": (0, (5, 2))}
                axes.plot(at, 3 * scale * limit, label="± 3 × Cramér–Rao bound of this model", **line)
                axes.plot(at, -3 * scale * limit, **line)
            # An axis along which the tracker holds the position fixed is not magnified to its rounding.
            band = scale * _usual_band(sigmas[:, k])
            half = max(halves[k], min(band, max(halves.values())), 0.05 * max(halves.values()))
            axes.set(ylim=(-half, half), ylabel=f"error in {names[k]} ({unit})")
            axes.margins(x=0.01)
            _note_outside(axes, int((np.abs(scale * error) > half).sum()))
        panels[-1].set_xlabel(xlabel)
        if columns:
            legend_above(panels[0])
            if bounds is not None and _mostly_above(bounds[:, columns], sigmas[:, columns]):
                note = "The bound is linearised about the truth, σ about the estimates: σ below the bound is too small."
                figure.text(0.99, 0.0, note, ha="right", va="bottom", fontsize=7, color=GREY)
    return Path(path)


def error_cdf(path: Path | str, errors: np.ndarray, title: str = "Distribution of errors") -> Path:
    """Writes the distribution function of the errors, horizontal and 3-D; returns the path.

    `errors`: (n, 2) or (n, 3) m; rows without a height count in the horizontal curve only.
    """
    flat = errors[np.isfinite(errors[:, :2]).all(axis=1), :2]
    curves = [("horizontal", flat, BLUE)] if len(flat) else []
    if errors.shape[1] == 3 and np.isfinite(errors).all(axis=1).any():
        curves.append(("3-D", errors[np.isfinite(errors).all(axis=1)], VERMILION))
    furthest = max(percentiles(values, (99.5,))[0] for _, values, _ in curves) if len(flat) else 0.0
    furthest = furthest or 1.0
    unit, scale = length_unit(furthest / 2)
    with figure_file(path, 6.4, 4.4, title) as figure:
        axes = figure.add_subplot(xlabel=f"error ({unit})", ylabel="estimates with at most this error (%)")
        for percent in MARKED:
            axes.axhline(percent, color=GREY, linewidth=0.7, linestyle=":")
        for name, values, colour in curves:
            at = percentiles(values, MARKED)
            words = ", ".join(f"p{p:.0f} {scale * v:.3g}" for p, v in zip(MARKED, at, strict=True))
            shares = np.linspace(0, 100, min(len(values), 2000))
            axes.plot(
                scale * np.array(percentiles(values, tuple(shares))),
                shares,
                color=colour,
                label=f"{name}: {words} {unit}",
            )
            axes.plot(scale * np.array(at), MARKED, "o", color=colour, markersize=4.5, markeredgecolor="white")
        axes.set(xlim=(0, scale * furthest * 1.05), ylim=(0, 101), yticks=(0, 25, 50, 75, 90, 95, 100))
        if curves:
            axes.legend(loc="lower right")
        axes.set_title(f"{len(flat)} estimates", color=GREY, fontsize=8)
    return Path(path)


def rmse_over_time(
    path: Path | str,
    times: np.ndarray,
    rmse: np.ndarray,
    sigmas: np.ndarray,
    bounds: np.ndarray | None,
    runs: int,
    title: str = "Root mean square error over time",
    xlabel: str = "time (s)",
) -> Path:
    """Writes the RMSE of each axis over `runs` runs with the reported σ and the Cramér–Rao bound; returns the path.

    `times` (t,) s; `rmse`, `sigmas`, `bounds` (t, d) m; an axis without values is left out.
    """
    columns = [k for k in range(rmse.shape[1]) if np.isfinite(rmse[:, k]).any()]
    unit, scale = length_unit(float(np.nanmedian(rmse[:, columns])))
    with figure_file(path, 8.0, 1.0 + 1.7 * len(columns), f"{title} ({runs} runs)") as figure:
        panels = figure.subplots(len(columns), 1, sharex=True, squeeze=False)[:, 0]
        for k, axes in zip(columns, panels, strict=True):
            axes.plot(times, scale * rmse[:, k], color=BLUE, linewidth=1.0, label="RMSE")
            axes.plot(times, scale * sigmas[:, k], color=SKY, linewidth=1.4, label="reported σ")
            if bounds is not None:
                line = {"color": VERMILION, "linewidth": 1.1, "linestyle": (0, (5, 2))}
                axes.plot(times, scale * bounds[:, k], label="Cramér–Rao bound of this model", **line)
            top = float(np.nanquantile(scale * rmse[:, k], 0.98))
            axes.set(ylim=(0, 1.6 * top), ylabel=f"{'xyz'[k]} ({unit})")
            axes.margins(x=0.01)
        panels[-1].set_xlabel(xlabel)
        legend_above(panels[0])
    return Path(path)


def rmse_chart(errors: Sequence[ErrorTrack], unit: str) -> str:
    """RMSE of every trajectory before and after, the largest on top."""
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
        worse = [(r[1], k) for k, r in enumerate(kept) if r[1] > r[0]]
        if worse:
            axes.plot(*np.array(worse).T, "o", color=VERMILION, markersize=6, label="after, larger")
        axes.set_yticks(places, [literal(_short(r[2])) for r in kept])
        axes.set(xlabel=f"RMSE ({unit})", ylim=(-0.6, len(kept) - 0.4))
        axes.set_xlim(0, 1.06 * max(max(r[:2]) for r in kept))
        axes.legend(loc="lower left", bbox_to_anchor=(-0.01, 1.0), ncols=3)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        plain(axes, "x")

    return svg_address(draw, WIDTH, max(2.0, 1.0 + 0.24 * len(kept)))


def distribution_chart(errors: Sequence[ErrorTrack], unit: str) -> str:
    """Distribution functions of the errors of all rows, before and after."""

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
        axes.set_title("Distribution of errors of all rows")
        plain(axes)

    return svg_address(draw)


def error_charts(errors: Sequence[ErrorTrack], unit: str) -> list[tuple[str, str]]:
    """Names and plots of the errors over time, for the trajectories whose RMSE changed most."""
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
        axes.set(ylim=(0, top), xlabel="time since the start (s)", ylabel=f"error ({unit})")
        axes.margins(x=0.01)
        axes.legend(loc="lower right", bbox_to_anchor=(1.01, 1.0), ncols=2)
        plain(axes)

    return svg_address(draw, WIDTH, 2.1)


def _unit(errors: np.ndarray, angles: bool) -> tuple[str, float]:
    if angles:
        return "°", 180 / np.pi
    known = np.abs(errors[np.isfinite(errors)])
    return length_unit(float(np.quantile(known, 0.95)) if len(known) else 1.0)


def _mostly_above(bounds: np.ndarray, sigmas: np.ndarray) -> bool:
    """Whether most of the bounds exceed the reported standard deviations."""
    known = np.isfinite(bounds) & np.isfinite(sigmas)
    return bool(known.any() and np.mean(bounds[known] > sigmas[known]) > 0.5)


def _half_height(error: np.ndarray, sigma: np.ndarray) -> float:
    """Half the height of a panel: every error that lasts two rows, and the usual 3 σ band up to four times as much."""
    size = np.abs(error[np.isfinite(error)])
    most = float(np.max(np.minimum(size[1:], size[:-1]), initial=0.0)) if len(size) > 1 else float(size[0])
    return 1.15 * max(most, min(_usual_band(sigma), 4 * most)) or 1e-9


def _usual_band(sigma: np.ndarray) -> float:
    """3 σ as in most rows."""
    known = sigma[np.isfinite(sigma)]
    return 3 * float(np.quantile(known, 0.9)) if len(known) else 0.0


def _note_outside(axes: Axes, outside: int) -> None:
    if outside:
        text = f"{outside} outside the axes"
        axes.text(0.995, 0.03, text, transform=axes.transAxes, ha="right", va="bottom", fontsize=7, color=GREY)


def _smooth(track: ErrorTrack) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times and errors; of long trajectories the root mean squares of at most `POINTS` blocks of rows."""
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

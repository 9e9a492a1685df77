"""Drawings of the way to the optimum: the objective and the numbers from every start, and the landscape round it."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from experiments.figure_style import BLUE, ORANGE, VERMILION, literal
from experiments.tuning_report.drawings import INK, NARROW, WIDTH, drawn, plain
from experiments.tuning_report.evidence import Descent, Landscape, TunedNumber, TuningEvidence

PALE = "#c3ccd6"


def objective_chart(evidence: TuningEvidence) -> str:
    """The objective at every step of every start."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        _lines(axes, evidence.descents, lambda d: d.objective)
        shown = np.concatenate([d.objective for d in evidence.descents])
        shown = shown[np.isfinite(shown)]
        best = float(shown.min())
        # A start that is far off must not flatten all the rest.
        top = min(float(shown.max()), best + 6 * float(np.quantile(shown, 0.75) - best) or np.inf)
        margin = 0.06 * (top - best) or 0.1 * abs(best) or 1.0
        axes.set(xlabel="step", ylim=(best - margin, top + margin))
        axes.set_title(literal(evidence.objective_about))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.annotate(
            f"{best:.4g}", (1, best), xycoords=("axes fraction", "data"), xytext=(0, 5), textcoords="offset points",
            ha="right", color=BLUE, fontsize=9, fontweight="bold",
        )  # fmt: skip
        if len(evidence.descents) > 1:
            axes.legend(*(x[::-1] for x in axes.get_legend_handles_labels()), loc="upper right")
        plain(axes)

    return drawn(draw)


def number_chart(evidence: TuningEvidence, k: int) -> str:
    """The tuned number `k` at every step of every start, on a logarithmic axis where it is positive."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        _lines(axes, evidence.descents, lambda d: d.numbers[:, k])
        axes.set_title(_named(evidence.numbers[k]))
        _scaled(axes, np.concatenate([d.numbers[:, k] for d in evidence.descents]), "y")
        axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
        axes.set_xlabel("step")
        plain(axes)

    return drawn(draw, NARROW, 0.62 * NARROW)


def landscape_chart(evidence: TuningEvidence, landscape: Landscape) -> str:
    """The objective over one number as a curve, or over two as contours, with the ways of all starts drawn in."""
    known = [evidence.numbers[k] for k in landscape.axes]

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        if len(known) == 1:
            _curve(axes, evidence, landscape)
        else:
            _contours(axes, evidence, landscape)
            _scaled(axes, landscape.grids[1], "y", tight=True)
            axes.set_ylabel(_named(known[1]))
        _scaled(axes, landscape.grids[0], "x", tight=True)
        axes.set_xlabel(_named(known[0]))

    return drawn(draw, WIDTH, 3.6)


def _curve(axes: Axes, evidence: TuningEvidence, landscape: Landscape) -> None:
    (grid,), (k,) = landscape.grids, landscape.axes
    axes.plot(grid, landscape.values, color=PALE, linewidth=2.5, label="objective")
    for number, descent in reversed(list(enumerate(evidence.descents))):
        axes.plot(
            descent.numbers[:, k], descent.objective, ".-", markersize=4, color=BLUE if number == 0 else ORANGE,
            linewidth=0.9, label="steps of the best start" if number == 0 else None,
        )  # fmt: skip
    low, high = float(np.nanmin(landscape.values)), float(np.nanmax(landscape.values))
    axes.set_ylim(low - 0.06 * (high - low), high + 0.02 * (high - low))
    axes.plot([evidence.numbers[k].after], [low], "o", color=VERMILION, markersize=7, markeredgecolor="white")
    axes.legend(loc="upper right")
    axes.set_title(literal(evidence.objective_about))
    plain(axes)


def _contours(axes: Axes, evidence: TuningEvidence, landscape: Landscape) -> None:
    a, b = landscape.axes
    values, low = landscape.values, float(np.nanmin(landscape.values))
    above = np.maximum(values - low, 0.0)
    known = above[np.isfinite(above) & (above > 0)]
    # Contours at equal steps of the square root: evenly spaced rings of a quadratic bowl.
    rings = low + np.linspace(0, np.sqrt(np.quantile(known, 0.97)), 12) ** 2 if len(known) else np.array([low, low + 1])
    axes.contourf(
        landscape.grids[0], landscape.grids[1], values.T, levels=rings, cmap="Blues_r", extend="max", alpha=0.75
    )
    axes.contour(landscape.grids[0], landscape.grids[1], values.T, levels=rings, colors="white", linewidths=0.6)
    for number, descent in reversed(list(enumerate(evidence.descents))):
        colour = VERMILION if number == 0 else INK
        axes.plot(
            descent.numbers[:, a], descent.numbers[:, b], ".-", color=colour, markersize=4.5 if number == 0 else 2.5,
            linewidth=1.2 if number == 0 else 0.6, alpha=1.0 if number == 0 else 0.5,
            label={0: "best start", 1: "other starts"}.get(number),
        )  # fmt: skip
    best = evidence.numbers[a].after, evidence.numbers[b].after
    axes.plot(*best, "o", color=VERMILION, markersize=8, markeredgecolor="white", markeredgewidth=1.3)
    axes.grid(visible=False)
    handles = (x[::-1] for x in axes.get_legend_handles_labels())
    axes.legend(*handles, loc="lower left", bbox_to_anchor=(-0.01, 1.0), ncols=3)


def _lines(axes: Axes, descents: tuple[Descent, ...], take) -> None:  # type: ignore[no-untyped-def]
    for number, descent in reversed(list(enumerate(descents))):
        label = {0: "best start", 1: "other starts"}.get(number)
        axes.plot(
            take(descent), color=BLUE if number == 0 else PALE, linewidth=1.8 if number == 0 else 1.1, label=label
        )


def _named(known: TunedNumber) -> str:
    return literal(known.name + (f" ({known.unit})" if known.unit != "1" else ""))


def _scaled(axes: Axes, values: np.ndarray, which: str, tight: bool = False) -> None:
    """A logarithmic axis with plain numbers where all values are positive and far apart, else a linear one."""
    values = values[np.isfinite(values)]
    low, high = float(values.min()), float(values.max())
    set_limits = axes.set_xlim if which == "x" else axes.set_ylim
    axis = axes.xaxis if which == "x" else axes.yaxis
    if low > 0 and high > 1.5 * low:
        (axes.set_xscale if which == "x" else axes.set_yscale)("log")
        ratio = high / low
        axis.set_major_locator(FixedLocator(_round_numbers(low, high)))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        factor = 1.0 if tight else ratio**0.06
        set_limits(low / factor, high * factor)
        return
    axis.set_major_locator(MaxNLocator(5))
    margin = 0.0 if tight else 0.08 * (high - low) or 0.1 * abs(high) or 1.0
    set_limits(low - margin, high + margin)


def _round_numbers(low: float, high: float) -> list[float]:
    """A few round numbers from `low` to `high`, evenly spread on a logarithmic axis."""
    decades = range(int(np.floor(np.log10(low))) - 1, int(np.ceil(np.log10(high))) + 2)
    for digits in ((1,), (1, 3), (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 6, 8)):
        found = [d * 10.0**k for k in decades for d in digits if low <= d * 10.0**k <= high]
        if len(found) >= 3:
            return found
    return found or [low, high]

"""Drawings of the way to the optimum: the objective and the numbers from every start, and the landscape round it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from experiments.plots.drawings import NARROW, WIDTH, drawn, plain
from experiments.plots.style import BLUE, literal
from experiments.plots.surface import contours, curve, named, scale_axis
from experiments.reports.advice import number
from experiments.reports.tuning_data import Descent, TuningEvidence
from tuning.surface import Surface

PALE = "#c3ccd6"


def objective_chart(evidence: TuningEvidence) -> str:
    """The objective at every step of every start."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        _lines(axes, evidence.descents, lambda d: d.objective)
        shown = np.concatenate([d.objective for d in evidence.descents])
        shown = shown[np.isfinite(shown)]
        best, longest = float(shown.min()), max(len(d.objective) for d in evidence.descents)
        # Another start that is far off must not flatten all the rest.
        usual = best + 6 * float(np.quantile(shown, 0.75) - best) or np.inf
        top = max(float(np.nanmax(evidence.descents[0].objective)), min(float(shown.max()), usual))
        margin = 0.06 * (top - best) or 0.1 * abs(best) or 1.0
        axes.set(xlabel="step", ylim=(best - margin, top + margin))
        axes.set_title(literal(evidence.objective_about))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        step, value = _taken(evidence)
        axes.plot([step], [value], "o", color=BLUE, markersize=6, markeredgecolor="white", zorder=3)
        axes.annotate(
            number(value), (step, value), xytext=(0, 7), textcoords="offset points",
            ha="right" if step > 0.5 * longest else "left", color=BLUE, fontsize=9, fontweight="bold",
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
        axes.set_title(named(evidence.numbers[k].name, evidence.numbers[k].unit))
        scale_axis(axes, np.concatenate([d.numbers[:, k] for d in evidence.descents]), "y")
        axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
        axes.set_xlabel("step")
        plain(axes)

    return drawn(draw, NARROW, 0.62 * NARROW)


def landscape_chart(evidence: TuningEvidence, landscape: Surface) -> str:
    """The objective over one number as a curve, or over two as contours, with the ways of all starts drawn in."""
    known = [evidence.numbers[k] for k in landscape.axes]
    best = [n.after for n in known]

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        if len(known) == 1:
            curve(axes, landscape.grids[0], landscape.values, None, (best[0], float(np.nanmin(landscape.values))))
            axes.set_title(literal(evidence.objective_about))
            plain(axes)
        else:
            paths = [d.numbers[:, list(landscape.axes)] for d in evidence.descents]
            contours(axes, landscape.grids, landscape.values, paths, (best[0], best[1]))
            scale_axis(axes, landscape.grids[1], "y", tight=True)
            axes.set_ylabel(named(known[1].name, known[1].unit))
        scale_axis(axes, landscape.grids[0], "x", tight=True)
        axes.set_xlabel(named(known[0].name, known[0].unit))

    return drawn(draw, WIDTH, 3.6)


def _taken(evidence: TuningEvidence) -> tuple[int, float]:
    """The step of the best start whose numbers are nearest to those taken, and the objective there."""
    descent = evidence.descents[0]
    after = np.array([n.after for n in evidence.numbers])
    size = np.maximum(np.abs(after), np.finfo(float).tiny)
    step = int(np.argmin((np.abs(descent.numbers - after) / size).max(axis=1)))
    return step, float(descent.objective[step])


def _lines(axes: Axes, descents: tuple[Descent, ...], take: Callable[[Descent], np.ndarray]) -> None:
    for k, descent in reversed(list(enumerate(descents))):
        label = {0: "best start", 1: "other starts"}.get(k)
        axes.plot(take(descent), color=BLUE if k == 0 else PALE, linewidth=1.8 if k == 0 else 1.1, label=label)

"""Figure 10 of paper A: each of the three stations lost for the whole run.

Nothing was fitted to the figure, whose curves are lost; stations and noise are those of Table 1 and Figure 8. Positions
and numbers of the paper's stations are not printed. Ours are numbered so that station 1 matters most; the study tests
whether any station does.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from experiments.lab.papers.will_2020._work_stand import cascade, direct, recorded
from experiments.lab.papers.will_2020.fit_figure_8 import radius
from experiments.monte_carlo import (
    FITTED,
    PREDICTED,
    Conclusion,
    ExpectedResult,
    Results,
    Study,
    TrackedRuns,
    World,
    inherited,
)
from experiments.pages.plots.style import BLACK, LINES, plain, write_svg
from experiments.text.wording import listed

NONE = "all stations"
LOST = {k: f"station {k} lost" for k in (1, 2, 3)}
SETTLED = 20
"""Points of the helix after which the fusion has settled, a tenth of them."""


def _square(tracked: TrackedRuns, rows: slice) -> np.ndarray:
    """3-D RMSE (n,), m, of some rows."""
    return np.asarray(np.sqrt(np.nanmean((tracked.error[:, rows] ** 2).sum(axis=-1), axis=1)))


def beginning(tracked: TrackedRuns) -> np.ndarray:
    """3-D RMSE (n,), m, of the first points."""
    return _square(tracked, slice(0, SETTLED))


def rest(tracked: TrackedRuns) -> np.ndarray:
    """3-D RMSE (n,), m, of the later points."""
    return _square(tracked, slice(SETTLED, None))


def height(tracked: TrackedRuns) -> np.ndarray:
    """RMSE (n,), m, of the height."""
    return np.asarray(np.sqrt(np.nanmean(tracked.error[..., 2] ** 2, axis=1)))


def expected(results: Results) -> list[ExpectedResult | Conclusion]:
    """The paper's conclusions from the figure."""
    cm = {w: results.value("rmse_3d_m", w, "cascade").times(100) for w in results.study.worlds}
    early = {w: 100 * results.value("beginning_m", w, "cascade").value for w in results.study.worlds}
    late = {w: 100 * results.value("rest_m", w, "cascade").value for w in results.study.worlds}
    heights = {w: 100 * results.value("height_m", w, "cascade").value for w in results.study.worlds}
    told = listed(cm, "{:.2f} cm")
    pairs = ", ".join(f"{w} {early[w]:.1f} and {late[w]:.1f} cm" for w in early)
    failed = max(results.value("failed", w, "cascade").value for w in LOST.values())
    others = max(cm[LOST[k]].high for k in (2, 3))
    return [
        Conclusion(
            "with a station lost the position is known still, with reduced accuracy",
            failed == 0 and min(cm[w].low for w in LOST.values()) > cm[NONE].high,
            told,
            inherited(FITTED, PREDICTED),
        ),
        Conclusion(
            "the failure of station 1 has the biggest impact",
            cm[LOST[1]].low > others,
            f"{told}; which of the stations is called 1 is ours to say, that one matters most is not",
            FITTED,
        ),
        Conclusion(
            "errors are larger while the fusion settles",
            np.mean([early[w] for w in LOST.values()]) > np.mean([late[w] for w in LOST.values()]),
            f"first {SETTLED} points against the rest: {pairs}",
            PREDICTED,
        ),
        Conclusion(
            "station 1 matters most mainly because of outliers at the beginning",
            late[LOST[1]] < max(late[LOST[k]] for k in (2, 3)),
            f"without the first {SETTLED} points it still does: here geometry is why, the other two see height worst; "
            f"error of the height: {listed(heights, '{:.1f} cm')}",
            PREDICTED,
        ),
    ]


def draw(results: Results, folder: Path) -> list[str]:
    """Cumulative distribution of the errors, for every lost station."""

    def shares(figure: Figure) -> None:
        axes = figure.subplots()
        for world, colour in zip((NONE, *LOST.values()), (BLACK, *LINES), strict=False):
            edges, share = results.cdf(world, "cascade", "3d_m")
            axes.plot(100 * edges, share, color=colour, label=world)
        axes.set(xlim=(0, 15), ylim=(0, 1), xlabel="error in space, cm", ylabel="share of estimates")
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        axes.set_title("Cascade")
        axes.legend(loc="lower right")
        plain(axes, "both")

    return [write_svg(folder, "figure_10.svg", shares)]


STUDY = Study(
    name="figure-10",
    about="How much worse are positions with one of three stations lost for the whole run?",
    worlds={NONE: World(recorded, {"radius": radius()})}
    | {name: World(recorded, {"radius": radius(), "lost": k}) for k, name in LOST.items()},
    trackers={"cascade": cascade(), "direct": direct()},
    measures={"beginning_m": beginning, "rest_m": rest, "height_m": height},
    metrics=("rmse_3d_m", "median_3d_m", "p95_3d_m", "beginning_m", "rest_m", "height_m", "diverged"),
    expected=expected,
    draw=draw,
)

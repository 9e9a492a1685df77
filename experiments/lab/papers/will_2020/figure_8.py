"""Figure 8 of paper A: positions on the helix by three stations, and the accuracy lost by the paper's cascade.

Fitted (`fit_figure_8`): the stations' distance from the centre line, to the printed 3.18 cm; array and noise are those
of Table 1. Predicted: the error at the default distance of 0.4 m. The curve of Figure 8 is lost, so that the
distribution is not compared. Not in the paper: one filter from phases to position, and a world with plane waves, in
which (9) is exact.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from experiments.lab.papers.will_2020._work_stand import cascade, direct, recorded
from experiments.lab.papers.will_2020.fit_figure_8 import PRINTED_CM, radius
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
from experiments.monte_carlo.chunk import tracked_runs
from experiments.pages.plots.style import BLACK, BLUE, GREY, VERMILION, plain, write_svg
from experiments.text.wording import fixed_interval

STAND, APART, PLANE = "stand", "stations 0.4 m off the middle", "stand, plane waves"
COLOURS = {"cascade": BLUE, "direct": VERMILION}


def offset(tracked: TrackedRuns) -> np.ndarray:
    """Length (n,), m, of each run's mean error vector: the part that averaging does not remove."""
    return np.asarray(np.linalg.norm(np.nanmean(tracked.estimates - tracked.truth, axis=1), axis=-1))


def expected(results: Results) -> list[ExpectedResult | Conclusion]:
    """The 3-D error, its prediction, and the accuracy lost by the cascade and by assuming plane waves."""
    cm = {
        (w, t): results.value("rmse_3d_m", w, t).times(100)
        for w in results.study.worlds
        for t in results.study.trackers
    }
    note = "a prediction of the array of Table 1 and stations where simulations have them; the paper's places are lost"
    made: list[ExpectedResult | Conclusion] = [
        ExpectedResult("section 4.2, RMSE in space", PRINTED_CM, cm[STAND, "cascade"], "cm", FITTED),
        ExpectedResult(
            f"section 4.2, RMSE in space, {APART}", PRINTED_CM, cm[APART, "cascade"], "cm", PREDICTED, None, note
        ),
    ]
    gain = results.ratio("rmse_3d_m", STAND, "direct", "cascade")
    made.append(
        Conclusion(
            "one filter straight from phases is more accurate than the paper's cascade",
            gain.high < 1,
            f"{cm[STAND, 'direct'].value:.2f} against {cm[STAND, 'cascade'].value:.2f} cm, "
            f"{fixed_interval(gain, '.2f')} times",
            inherited(FITTED, PREDICTED),
        )
    )
    lost = cm[STAND, "cascade"].value - cm[PLANE, "cascade"].value
    offsets = [100 * results.value("offset_m", w, "cascade").value for w in (STAND, PLANE)]
    made.append(
        Conclusion(
            "taking waves as plane, as (9) does, costs the cascade less than a tenth of its error here",
            0 < lost < 0.1 * cm[STAND, "cascade"].value,
            f"{cm[STAND, 'cascade'].value:.2f} cm in spherical waves, {cm[PLANE, 'cascade'].value:.2f} cm in plane "
            f"ones; mean error of a run {offsets[0]:.2f} and {offsets[1]:.2f} cm",
            inherited(FITTED, PREDICTED),
        )
    )
    believed = {t: results.value("nees_3d_mean", STAND, t).value for t in results.study.trackers}
    made.append(
        Conclusion(
            "the cascade is overconfident, more than the direct filter",
            believed["cascade"] > max(3.0, believed["direct"]),
            f"normalised squared error {believed['cascade']:.1f} against {believed['direct']:.1f}, 3 expected",
            PREDICTED,
        )
    )
    return made


def draw(results: Results, folder: Path) -> list[str]:
    """The first trajectory in space, and the cumulative distribution of the errors."""
    runs = tracked_runs(results.study, STAND, np.arange(results.study.chunk))

    def path(figure: Figure) -> None:
        axes = figure.add_subplot(projection="3d")
        truth, found = runs["cascade"].truth[0], runs["cascade"].estimates[0]
        axes.plot(*truth.T, color=GREY, linewidth=1.0, label="ideal")
        axes.plot(*found.T, color=BLUE, linewidth=1.0, label="cascade")
        axes.set(xlabel="x, m", ylabel="y, m", zlabel="z, m")
        axes.set_box_aspect((1, 1, 0.5), zoom=0.85)
        axes.legend(loc="upper left", ncols=2)

    def shares(figure: Figure) -> None:
        axes = figure.subplots()
        for tracker in results.study.trackers:
            for world, style in ((STAND, "-"), (PLANE, ":")):
                edges, share = results.cdf(world, tracker, "3d_m")
                name = tracker if world == STAND else f"{tracker}, plane waves"
                axes.plot(100 * edges, share, style, color=COLOURS[tracker], label=name)
        axes.axvline(PRINTED_CM, color=BLACK, linewidth=0.8, linestyle="--", label="RMSE of the paper")
        axes.set(xlim=(0, 10), ylim=(0, 1), xlabel="error in space, cm", ylabel="share of estimates")
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        axes.legend(loc="lower right")
        plain(axes, "both")

    return [write_svg(folder, "figure_8_path.svg", path, 4.2, 3.4), write_svg(folder, "figure_8_cdf.svg", shares)]


STUDY = Study(
    name="figure-8",
    about="How far off are positions by three stations, by the paper's cascade and straight from phases?",
    worlds={
        STAND: World(recorded, {"radius": radius()}),
        APART: World(recorded),
        PLANE: World(recorded, {"radius": radius(), "wave": "plane"}),
    },
    trackers={"cascade": cascade(), "direct": direct()},
    measures={"offset_m": offset},
    metrics=("rmse_3d_m", "median_3d_m", "p95_3d_m", "bound_3d_m", "nees_3d_mean", "diverged"),
    expected=expected,
    draw=draw,
)

"""Right place? A hand tool on nine points of work, 5 mm to 500 mm apart: which one do the systems A and C name?

One tool carries the beacon of Will et al. 2020 and the tag and IMU of Kwon et al. 2021 over a bench in a room with four
anchors. It rests a second on one point after another; all trackers see the same rounds. At every row at rest the most
probable point is named, and released where its probability is 95 % and the estimate lies within half the spacing.

Nothing is fitted. The world's numbers are chosen so that the errors are of the printed size: phases with 0.25 rad of
noise give the cascade about the 3.18 cm of paper A, anchors' biases of 5 cm give the 56 mm deviations of a still tag in
table 2 of paper C. The trackers are told the noise of this world, so that their covariances have a chance to be right.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from experiments.monte_carlo.declaration import Study, TrackerConfig, World
from experiments.monte_carlo.expectations import Conclusion, ExpectedResult, Value
from experiments.monte_carlo.results import Results, resampled
from experiments.plots.style import BLUE, GREY, ORANGE, VERMILION, plain, write_svg
from experiments.questions._bench import BIAS, MEASURES, SIGMA_P, SIGMA_R, bench

SPACINGS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
OF_RANGES = {
    "sensors.ranges.sigma_r": SIGMA_R,
    "sensors.ranges.positive_skew": 1.0,
    "sensors.ranges.dof": 30.0,
    "start.sigma_bias": BIAS,
}
CONFIGS = {
    "direct": TrackerConfig("direct", {"sensors.*.sigma_p": SIGMA_P, "motion.sigma_a": 0.3}, free_height=True),
    "cascade": TrackerConfig(
        "cascade",
        {"beams.*.sensors.*.sigma_p": SIGMA_P, "fusion.sensors.bearings.reported_std_scale": 2.0},
        free_height=True,
    ),
    "uwb": TrackerConfig("uwb", OF_RANGES | {"sensors.ranges.bias": [0.0] * 8, "motion.sigma_bias": BIAS}),
    "uwb-imu": TrackerConfig("uwb-imu", OF_RANGES | {"sensors.ranges.bias": [0.0] * 4}, free_height=True),
}
OF_A, OF_C = ("direct", "cascade"), ("uwb", "uwb-imu")


def expected(results: Results) -> list[ExpectedResult | Conclusion]:
    """The two spacings that the papers name, and whether a claimed 95 % is 95 %."""
    at = {t: [_at(results, "named_right", t, s) for s in SPACINGS] for t in CONFIGS}
    near, far = SPACINGS.index(0.005), SPACINGS.index(0.2)
    lines = {t: _at(results, "released_right", t, 0.005) for t in OF_A}
    found: list[ExpectedResult | Conclusion] = [
        Conclusion(
            "holes 5 mm apart need a gantry: A names a wrong one most of the time",
            all(at[t][near].high < 0.5 for t in OF_A) and all(v.high < 0.05 for v in lines.values()),
            "; ".join(f"{t}: right one named {_percent(at[t][near])}, released {_percent(lines[t])}" for t in OF_A),
        ),
        Conclusion(
            "points 200 mm apart can be told apart with C",
            all(at[t][far].low > 0.9 for t in OF_C),
            "; ".join(
                f"{t}: right one named {_percent(at[t][far])}, wrong one released "
                f"{_percent(_at(results, 'released_wrong', t, 0.2))}"
                for t in OF_C
            ),
        ),
    ]
    every = {t: [_false_share(results, t, s) for s in SPACINGS] for t in CONFIGS}
    false = {t: max(values, key=lambda v: np.nan_to_num(v.value, nan=-1.0)) for t, values in every.items()}
    found.append(
        Conclusion(
            "of the releases at 95 % no more than 5 % are at a wrong point, as far as the runs can tell",
            all(v.low <= 0.05 for v in false.values()),
            "at the spacing where most are: " + ", ".join(f"{t} {_percent(v)}" for t, v in false.items()),
        )
    )
    size = {t: _at(results, "rmse_m", t, 0.05 if t in OF_A else 0.2).value for t in CONFIGS}
    enough = {t: _spacing_for(0.95, [v.value for v in at[t]]) / size[t] for t in CONFIGS}
    found.append(
        Conclusion(
            "95 % of the namings are right from a spacing of two to four times the horizontal RMSE on",
            all(2.0 < ratio < 4.0 for ratio in enough.values()),
            ", ".join(f"{t} {ratio:.1f} times {1000 * size[t]:.0f} mm" for t, ratio in enough.items())
            + f"; so 5 mm take an RMSE of {5 / max(enough.values()):.1f} mm",
        )
    )
    return found


def draw(results: Results, folder: Path) -> list[str]:
    """Named and released shares against spacing, a panel a tracker."""
    lines = {
        "named right": ("named_right", GREY, "--"),
        "released right": ("released_right", BLUE, "-"),
        "released wrong": ("released_wrong", VERMILION, "-"),
        "missed": ("missed", ORANGE, ":"),
    }

    def panels(figure: Figure) -> None:
        axes = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
        for ax, tracker in zip(axes, CONFIGS, strict=True):
            for label, (measure, colour, style) in lines.items():
                values = np.array([_at(results, measure, tracker, s) for s in SPACINGS])
                ax.plot(SPACINGS, values[:, 0], style, color=colour, label=label)
                ax.fill_between(SPACINGS, values[:, 1], values[:, 2], color=colour, alpha=0.15, linewidth=0)
            ax.set(xscale="log", xlim=(0.004, 0.7), ylim=(-0.02, 1.02))
            ax.set_xticks((0.005, 0.02, 0.1, 0.5), ["5 mm", "2 cm", "10 cm", "50 cm"])
            ax.yaxis.set_major_formatter(PercentFormatter(1.0))
            ax.set_title(f"{tracker} ({'A' if tracker in OF_A else 'C'})")
            plain(ax)
        figure.supxlabel("spacing of the points of work", fontsize=9)
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=4)

    return [write_svg(folder, "right-place.svg", panels, 7.0, 4.6)]


def _at(results: Results, measure: str, tracker: str, spacing: float) -> Value:
    return results.value(measure, "bench", tracker, **{"world.spacing": spacing})


def _false_share(results: Results, tracker: str, spacing: float) -> Value:
    """Of the releases the share at a wrong point; trajectories resampled together. 0 to 1 where there is none."""
    right, wrong = (
        results.numbers(f"released_{x}", "bench", tracker, **{"world.spacing": spacing}) for x in ("right", "wrong")
    )
    if not np.any(right + wrong):
        return Value(np.nan, 0.0, 1.0)
    weights = resampled(results.study.seed, len(right))
    with np.errstate(invalid="ignore"):
        shares = (weights @ wrong) / (weights @ (right + wrong))
    low, high = np.nanpercentile(shares, [2.5, 97.5])
    return Value(float(wrong.sum() / (right + wrong).sum()), float(low), float(high))


def _spacing_for(share: float, named: list[float]) -> float:
    """The spacing, m, from which on so many namings are right, between the grid's on a logarithmic scale."""
    return float(np.exp(np.interp(share, np.maximum.accumulate(named), np.log(SPACINGS))))


def _percent(value: Value) -> str:
    return f"{100 * value.value:.1f} % [{100 * value.low:.1f}, {100 * value.high:.1f}]"


STUDY = Study(
    name="worksteps",
    about="Right place? How often a hand tool's point of work is named and released, against the points' spacing",
    worlds={"bench": World(bench)},
    trackers=CONFIGS,
    runs=40,
    grid={"world.spacing": SPACINGS},
    measures=MEASURES,
    metrics=(*MEASURES, "rmse_m", "nees_mean"),
    expected=expected,
    draw=draw,
)

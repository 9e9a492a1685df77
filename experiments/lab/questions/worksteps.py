"""Right place? A hand tool on nine fastening points 5 mm to 500 mm apart: which one do the systems A and C name?

One tool carries the beacon of Will et al. 2020 (A) and the tag and IMU of Kwon et al. 2021 (C) over a bench in a room
with four anchors. It rests one second at each point in turn; all trackers see the same rounds. In every row at rest the
most probable point is named, and the tool is unlocked there if its probability is at least 95 % and the estimate lies
within half the spacing.

The world is chosen for errors of the printed size, from which the two distances follow that the papers name: phase
noise of 0.25 rad gives the cascade about the 3.18 cm of A, anchor biases of 5 cm give the 56 mm deviations of a still
tag in Table 2 of C. The trackers' tunables agree with the noise of this world, so that their covariances can be right.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import polars as pl
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from scipy.stats import norm

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.declared import CONSTANT, CONSTANT_INERTIAL, plot
from trackwright.experiments.monte_carlo.results import resampled
from trackwright.experiments.pages.charts.style import BLUE, GREY, ORANGE, VERMILION, plain
from trackwright.sim.corruptions import white_noise
from trackwright.sim.imu import simulate_uwb_imu
from trackwright.sim.paths import point_to_point
from trackwright.sim.ranging import CHAMBER, antenna_biases, chamber, round_robin
from trackwright.sim.stations import simulate_phases, work_station
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.worksteps.decisions import NO_POINT, Decisions, FasteningPoints, decide, nearest_point

SIGMA_P, SIGMA_R, BIAS = 0.25, 0.03, 0.05
SECONDS, WARM_UP_S, REST_M = 10.0, 2.0, 1e-3
"""Length of a round and its unscored start, s; largest distance from a point, m, at which the tip rests on it."""

MIDDLE = np.array([0.0, 0.0, 0.15])
"""Centre of the points in the frame of the work stand, whose origin is 1.05 m above the floor of the room."""

ROOM = CHAMBER - [2.5, 2.5, 1.05]


def points_of(spacing: float) -> np.ndarray:
    """Nine fastening points (9, 3), m, on a horizontal square grid."""
    steps = (np.arange(3) - 1) * spacing
    x, y = np.meshgrid(steps, steps, indexing="ij")
    return MIDDLE + np.stack([x.ravel(), y.ravel(), np.zeros(9)], axis=1)


def bench(ids: np.ndarray, seed: int, spacing: float) -> RecordingFolder:
    """Rounds of the tool with phases, ranges and IMU; the table `points` holds the fastening points."""
    points = points_of(spacing)
    path = partial(point_to_point, points=points)
    phases = simulate_phases(work_station(), path, ids, seed, sigma_p=SIGMA_P, rate_hz=10.0, n_points=int(10 * SECONDS))
    errors = {"biases": antenna_biases(BIAS), "white": white_noise(SIGMA_R), "turn": round_robin()}
    ranges = simulate_uwb_imu(
        chamber(ROOM), path, ids, seed, rate_hz=40.0, n_points=int(40 * SECONDS), corruptions=errors
    )
    stations, inertial = phases.folder("bench"), ranges.folder("bench")
    named = pl.DataFrame({"name": [str(k) for k in range(9)]} | dict(zip(("x_m", "y_m", "z_m"), points.T, strict=True)))
    tables = {**inertial.tables, "phases": stations.tables["phases"], "points": named}
    return replace(inertial, rig=replace(inertial.rig, stations=stations.rig.stations), tables=tables)


def decisions_of(tracked: mc.TrackedRuns) -> tuple[Decisions, np.ndarray]:
    """The decisions of all rows of concatenated trajectories, and the point at which the tool rests (n, T)."""
    table = tracked.folder.tables["points"]
    points = FasteningPoints(tuple(table["name"]), table.select("x_m", "y_m").to_numpy())
    rows = tracked.known & (tracked.times >= WARM_UP_S)
    at = nearest_point(np.where(rows[..., None], tracked.truth, np.nan)[..., :2].reshape(-1, 2), points, REST_M)
    means, spread = tracked.estimates[..., :2].reshape(-1, 2), tracked.covariance[..., :2, :2].reshape(-1, 2, 2)
    return decide(means, spread, points, points.tolerance(), 0.0), at.reshape(tracked.known.shape)


def _fraction(hit: Callable[[Decisions, np.ndarray], np.ndarray]) -> Callable[[mc.TrackedRuns], np.ndarray]:
    """The mean of `hit` over the rows at rest of each trajectory, NaN without such rows."""

    def measure(tracked: mc.TrackedRuns) -> np.ndarray:
        decisions, at = decisions_of(tracked)
        rest = at != NO_POINT
        hits = np.where(rest, hit(decisions, at.ravel()).reshape(at.shape), 0.0).sum(axis=1)
        return np.where(rest.any(axis=1), hits / np.maximum(rest.sum(axis=1), 1), np.nan)

    return measure


MEASURES = {
    "named_right": _fraction(lambda d, at: d.point == at),
    "claimed": _fraction(lambda d, at: np.nan_to_num(d.probability)),
    "released_right": _fraction(lambda d, at: d.unlocked & (d.point == at)),
    "released_wrong": _fraction(lambda d, at: d.unlocked & (d.point != at)),
    "missed": _fraction(lambda d, at: ~d.unlocked),
}

SPACINGS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
OF_RANGES = {
    "sensors.ranges.sigma_r": SIGMA_R,
    "sensors.ranges.positive_skew": 1.0,
    "sensors.ranges.dof": 30.0,
    "start.sigma_bias": BIAS,
}
OF_UWB = CONSTANT | {
    "sensors.ranges.bias": [0.0] * 8,
    "motion.sigma_bias": BIAS,
    "motion.sigma_a": 0.3,
    "motion.memory": 5.0,
}
CONFIGS = {
    "direct": mc.TrackerConfig("direct", {"sensors.*.sigma_p": SIGMA_P, "motion.sigma_a": 0.3}, free_height=True),
    "cascade": mc.TrackerConfig(
        "cascade",
        {"beams.*.sensors.*.sigma_p": SIGMA_P, "fusion.sensors.bearings.reported_std_scale": 2.0},
        free_height=True,
    ),
    "uwb": mc.TrackerConfig("uwb", OF_RANGES | OF_UWB),
    "uwb-imu": mc.TrackerConfig(
        "uwb-imu", OF_RANGES | CONSTANT_INERTIAL | {"sensors.ranges.bias": [0.0] * 4}, free_height=True
    ),
}
NORMAL_SPACING = float(np.sqrt(2.0) * norm.ppf(1.0 - 0.75 * (1.0 - np.sqrt(0.95))))
"""Spacing over horizontal RMSE at which the nearest of the nine points is right in 95 %, for normal errors.

With the probability q of an error beyond half the spacing, one way along one axis, it is right in (1 − 4q/3)².
"""

OF_A, OF_C = ("direct", "cascade"), ("uwb", "uwb-imu")


def expected(results: mc.Results) -> Iterator[mc.Claim]:
    """The two spacings that the papers mention, and the calibration at 95 %."""
    at = {t: [_at(results, "named_right", t, s) for s in SPACINGS] for t in CONFIGS}
    near, far = SPACINGS.index(0.005), SPACINGS.index(0.2)
    unlocked = {t: _at(results, "released_right", t, 0.005) for t in OF_A}
    wrong = {t: _at(results, "released_wrong", t, 0.2) for t in OF_C}
    yield mc.Conclusion(
        "holes 5 mm apart need a gantry: A names a wrong one most of the time",
        all(at[t][near].high < 0.5 for t in OF_A) and all(v.high < 0.05 for v in unlocked.values()),
        "; ".join(f"{t}: right one named {_percent(at[t][near])}, unlocked {_percent(unlocked[t])}" for t in OF_A),
        mc.DERIVED,
    )
    yield mc.Conclusion(
        "C distinguishes points 200 mm apart",
        all(at[t][far].low > 0.9 for t in OF_C),
        "; ".join(
            f"{t}: right one named {_percent(at[t][far])}, wrong one unlocked {_percent(wrong[t])}" for t in OF_C
        ),
        mc.DERIVED,
    )
    fractions = {t: [_false_fraction(results, t, s) for s in SPACINGS] for t in CONFIGS}
    false = {t: max(values, key=lambda v: np.nan_to_num(v.value, nan=-1.0)) for t, values in fractions.items()}
    yield mc.Conclusion(
        "at most 5 % of the unlock decisions at 95 % are at a wrong point, within the intervals",
        all(v.low <= 0.05 for v in false.values()),
        "at the spacing with most of them: " + ", ".join(f"{t} {_percent(v)}" for t, v in false.items()),
        mc.PREDICTED,
    )
    size = {t: _at(results, "rmse_m", t, 0.05 if t in OF_A else 0.2).value for t in CONFIGS}
    # The spacing from which on 95 % of the named points are right, interpolated logarithmically.
    named = {t: np.maximum.accumulate([v.value for v in at[t]]) for t in CONFIGS}
    enough = {t: np.exp(np.interp(0.95, named[t], np.log(SPACINGS))) / size[t] for t in CONFIGS}
    yield mc.Conclusion(
        "the named point is right in 95 % of the rows from a spacing of two to four times the horizontal RMSE on",
        all(2.0 < ratio < 4.0 for ratio in enough.values()),
        ", ".join(f"{t} {ratio:.1f} times {1000 * size[t]:.0f} mm" for t, ratio in enough.items())
        + f"; normal errors give {NORMAL_SPACING:.1f} times; a spacing of 5 mm requires an RMSE of "
        f"{5 / max(enough.values()):.1f} mm",
        mc.DERIVED,
    )


def fractions(results: mc.Results, figure: Figure) -> None:
    """Fractions named and unlocked against spacing, one panel per tracker."""
    lines = {
        "named right": ("named_right", GREY, "--"),
        "unlocked right": ("released_right", BLUE, "-"),
        "unlocked wrong": ("released_wrong", VERMILION, "-"),
        "missed": ("missed", ORANGE, ":"),
    }
    panels = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
    for axes, tracker in zip(panels, CONFIGS, strict=True):
        for label, (measure, colour, style) in lines.items():
            values = np.array([_at(results, measure, tracker, s) for s in SPACINGS])
            axes.plot(SPACINGS, values[:, 0], style, color=colour, label=label)
            axes.fill_between(SPACINGS, values[:, 1], values[:, 2], color=colour, alpha=0.15, linewidth=0)
        axes.set(xscale="log", xlim=(0.004, 0.7), ylim=(-0.02, 1.02))
        axes.set_xticks((0.005, 0.02, 0.1, 0.5), ["5 mm", "2 cm", "10 cm", "50 cm"])
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        axes.set_title(f"{tracker} ({'A' if tracker in OF_A else 'C'})")
        plain(axes)
    figure.supxlabel("spacing of the fastening points", fontsize=9)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", ncols=4)


def _at(results: mc.Results, measure: str, tracker: str, spacing: float) -> mc.Value:
    return results.value(measure, "bench", tracker, **{"world.spacing": spacing})


def _false_fraction(results: mc.Results, tracker: str, spacing: float) -> mc.Value:
    """The fraction of unlock decisions at a wrong point, with trajectories resampled; interval 0 to 1 without any."""
    right, wrong = (
        results.numbers(f"released_{x}", "bench", tracker, **{"world.spacing": spacing}) for x in ("right", "wrong")
    )
    if not np.any(right + wrong):
        return mc.Value(np.nan, 0.0, 1.0)
    weights = resampled(results.study.seed, len(right))
    with np.errstate(invalid="ignore"):
        shares = (weights @ wrong) / (weights @ (right + wrong))
    low, high = np.nanpercentile(shares, [2.5, 97.5])
    return mc.Value(float(wrong.sum() / (right + wrong).sum()), float(low), float(high))


def _percent(value: mc.Value) -> str:
    return f"{100 * value.value:.1f} % [{100 * value.low:.1f}, {100 * value.high:.1f}]"


STUDY = mc.Study(
    name="worksteps",
    about="Right place? How often is a hand tool unlocked at the right fastening point, by the points' spacing?",
    worlds={"bench": mc.World(bench)},
    trackers=CONFIGS,
    runs=40,
    grid={"world.spacing": SPACINGS},
    measures=MEASURES,
    metrics=(*MEASURES, "rmse_m", "nees_mean"),
    expected=expected,
    draw=plot("right-place.svg", fractions, 7.0, 4.6),
)

"""Rests where segments meet, with and without a segment in the state: the first future work of chapter 4.

The thesis expects that its filter "tends to overshoot such rest periods", and that one with the segment in its state
"could recognize the transition at a junction". Both motions run by particles and on a grid, each with its own best
dynamic noise: situation 2, with rests of 5 s at four joins, and situation 1, without rests, which shows the cost.
"""

from collections.abc import Iterator

import numpy as np

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.fitting import fitted
from trackwright.experiments.lab.papers.line_thesis import _assembly_line as line
from trackwright.experiments.lab.papers.line_thesis._assembly_line import SIGMA, least
from trackwright.experiments.text.expectations import fixed_interval
from trackwright.trackers.core.model.polyline import Polyline

SWEPT = (0.02, 0.04, 0.08, 0.16, 0.3)
RESTS, TRAVELS = "rests at joins", "no rests"
PAIRS = {"particles": "particles, segment", "grid": "grid, segment"}
"""Without and with the segment in the state."""


def arclengths(tracked: mc.TrackedRuns) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Arclengths (n, T), m, of estimates and truth, and mask (n, T) of rests at a join."""
    assert tracked.folder.rig.path_knots is not None
    path = Polyline(tracked.folder.rig.path_knots)
    estimated, true = (path.nearest(np.nan_to_num(x[..., :2]))[0] for x in (tracked.estimates, tracked.truth))
    still = np.diff(true, axis=1, append=np.nan) == 0
    # The bends of the path; the truth's arclength at them is exact up to rounding.
    at_join = np.abs(true[..., None] - np.asarray(path.starts)[1:]).min(axis=-1) < 1e-6
    return estimated, true, still & at_join & tracked.known


def rest_error(tracked: mc.TrackedRuns) -> np.ndarray:
    """Mean distance from the truth (n,), m, during rests at joins; NaN without rests."""
    return _mean_of(line.distances(tracked), arclengths(tracked)[2])


def overshoot(tracked: mc.TrackedRuns) -> np.ndarray:
    """Mean signed distance (n,), m, of the estimate past the join during rests."""
    estimated, true, rests = arclengths(tracked)
    return _mean_of(estimated - true, rests)


def _mean_of(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    count = rows.sum(axis=1)
    return np.where(count > 0, np.where(rows, values, 0.0).sum(axis=1) / np.maximum(count, 1), np.nan)


def expected(results: mc.Results) -> Iterator[mc.Claim]:
    """Overshoot of the plain motion, and improvement by the segment."""
    for without, known in PAIRS.items():
        past, past_known = (100 * _numbers(results, "overshoot_m", RESTS, t).mean() for t in (without, known))
        at_rest = 100 * _numbers(results, "rest_error_m", RESTS, without).mean()
        rest = _gain(results, "rest_error_m", RESTS, without)
        whole = _gain(results, "error_m", RESTS, without)
        travel = _gain(results, "error_m", TRAVELS, without)
        says = f"{without}: without the segment rests are overshot, with it less"
        how = f"while the tag rests the estimate is {past:+.1f} cm past the join, with it {past_known:+.1f} cm"
        yield mc.Conclusion(says, bool(past > 0 and abs(past_known) < past), how, mc.PREDICTED)
        says = f"{without}: the segment in the state makes rests more accurate"
        how = f"{at_rest:.1f} cm, with the segment {_text(rest)}; over whole recordings {_text(whole)}"
        yield mc.Conclusion(says, rest.high < 0, how, mc.PREDICTED)
        says = f"{without}: where no rests come, expecting them does no harm"
        yield mc.Conclusion(says, travel.low <= 0, f"{_text(travel)} over whole recordings", mc.PREDICTED)


def _numbers(results: mc.Results, measure: str, world: str, tracker: str) -> np.ndarray:
    """The measure per trajectory, at the tracker's best dynamic noise over both worlds."""
    return results.numbers(measure, world, tracker, **{SIGMA: least(results, tracker)})


def _gain(results: mc.Results, measure: str, world: str, without: str) -> mc.Value:
    """What the segment adds, cm, paired."""
    gap = 100 * (_numbers(results, measure, world, PAIRS[without]) - _numbers(results, measure, world, without))
    drawn = gap[np.random.default_rng(results.study.seed).integers(len(gap), size=(1000, len(gap)))].mean(axis=1)
    return line.with_middle_95(gap.mean(), drawn)


def _text(cm: mc.Value) -> str:
    return fixed_interval(cm, "+.1f", " cm")


_LINES = line.worlds(fitted("papers/line_thesis/table_3_1"), ("situation 2, set 2", "situation 1, set 2"))
STUDY = mc.Study(
    name="rests-at-joins",
    about="Does a segment in the state keep the filter from overshooting rests where segments meet?",
    worlds={
        name: mc.World(world.make, {**world.numbers, "fitted_truth": False})
        for name, world in zip((RESTS, TRAVELS), _LINES.values(), strict=True)
    },
    trackers={
        "particles": line.STOPPING,
        "particles, segment": line.SEGMENT,
        "grid": line.GRID,
        "grid, segment": line.GRID_SEGMENT,
    },
    runs=30,
    grid={SIGMA: SWEPT},
    measures={"error_m": line.error, "rest_error_m": rest_error, "overshoot_m": overshoot},
    metrics=("mean_m", "rmse_m", "nees_mean"),
    expected=expected,
)

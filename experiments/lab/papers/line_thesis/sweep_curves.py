"""The thesis's sweep: the error of both filters against their dynamic noise, 0 to 100 cm, over the three situations.

The noise is in m/s per √s (at 5 Hz 1 m/s per √s is 45 cm/s per step). Zero noise would be another model, a constant
speed; the sweep begins at a small value instead.
"""

from collections.abc import Iterator

import numpy as np

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.fitting import fitted
from trackwright.experiments.lab.papers.line_thesis import _assembly_line as line

SWEPT = (0.01, 0.03, 0.06, 0.09, 0.13, 0.18, 0.25, 0.35, 0.6, 1.0)
WORLDS = ("situation 1, set 2", "situation 2, set 2", "situation 3, set 2")
BOTH = ("Kalman", "particle")
NEAR = 1.05  # ratio to the least error up to which the curve counts as flat


def expected(results: mc.Results) -> Iterator[mc.Claim]:
    """Positions of the minima, and the cost of a wrong noise."""
    best = {tracker: line.least(results, tracker) for tracker in results.study.trackers}
    cm = {tracker: 100 * _curve(results, tracker)[:, 0] for tracker in results.study.trackers}
    minima = ", ".join(f"{t} {cm[t].min():.1f} cm at {best[t]:.2f} m/s per √s" for t in best)
    says = "both filters have a least error inside the range"
    yield mc.Conclusion(says, all(SWEPT[0] < x < SWEPT[-1] for x in best.values()), minima, mc.PREDICTED)
    says = "the particle filter is better than the Kalman filter at the best noise of each"
    yield mc.Conclusion(says, cm["particle"].min() < cm["Kalman"].min(), minima, mc.DERIVED)
    says = "too little noise costs more than too much"
    how = ", ".join(f"{t} {cm[t][0]:.0f} cm at {SWEPT[0]}, {cm[t][-1]:.0f} cm at {SWEPT[-1]}" for t in BOTH)
    yield mc.Conclusion(says, all(cm[t][0] > cm[t][-1] for t in BOTH), how, mc.PREDICTED)
    # Between the values swept the curve is linear in the logarithm: a value just outside would cost a whole step.
    fine = np.geomspace(SWEPT[0], SWEPT[-1], 1000)
    widths = {t: fine[np.interp(np.log(fine), np.log(SWEPT), cm[t]) <= NEAR * cm[t].min()] for t in BOTH}
    says = "both minima are flat: over a factor of two in noise either filter loses less than 5 %"
    how = ", ".join(f"{t} within 5 % of its least from {w.min():.2f} to {w.max():.2f}" for t, w in widths.items())
    yield mc.Conclusion(says, all(w.max() >= 2 * w.min() for w in widths.values()), how, mc.PREDICTED)
    gain = cm["particle"].min() - cm["particle, path ends"].min()
    how = f"{gain:.1f} cm less at the best noise; the path was left open for Table 3.1 after this was seen"
    yield mc.Conclusion("knowing where the path ends helps the particles", gain > 0, how, mc.DERIVED)


def _curve(results: mc.Results, tracker: str) -> np.ndarray:
    """Average error and its interval (values, 3), m."""
    pairs = [(world, tracker) for world in results.study.worlds]
    return np.array([results.average("error_m", pairs, **{line.SIGMA: x}) for x in SWEPT])


STUDY = mc.Study(
    name="sweep-curves",
    about="How do the errors of both filters depend on their dynamic noise?",
    worlds=line.worlds(fitted("papers/line_thesis/table_3_1"), WORLDS),
    trackers={"particle": line.PARTICLE, "Kalman": line.KALMAN, "particle, path ends": line.STOPPING},
    runs=30,
    grid={line.SIGMA: SWEPT},
    measures={"error_m": line.error},
    metrics=("mean_m", "rmse_m", "p95_m"),
    expected=expected,
)

"""Figure 8 of paper A: positions on the helix by three stations, and the accuracy lost by the paper's cascade.

Fitted to the printed 3.18 cm: the stations' distance from the centre line, which determines the accuracy of the height.
Not in the paper: one filter from phases to position, and a world with plane waves, in which (9) is exact.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.declared import Printed
from trackwright.experiments.lab.papers.fitting import Fit, Fitted
from trackwright.experiments.lab.papers.will_2020._work_stand import CASCADE, DIRECT, RADIUS, recorded
from trackwright.experiments.text.expectations import fixed_interval

STAND, APART, PLANE = "stand", "stations 0.4 m off the middle", "stand, plane waves"
UNKNOWN = "a prediction of the array of Table 1 and stations where simulations have them; the paper's places are lost"
_of = partial(Printed, number=3.18, metric="rmse_3d_m", unit="cm", tracker="cascade")
PRINTED = (
    _of("section 4.2, RMSE in space", origin=mc.FITTED, worlds=(STAND,)),
    _of(f"section 4.2, RMSE in space, {APART}", origin=mc.PREDICTED, note=UNKNOWN, worlds=(APART,)),
)


def offset(tracked: mc.TrackedRuns) -> np.ndarray:
    """Length (n,), m, of each run's mean error vector: the part that averaging does not remove."""
    return np.asarray(np.linalg.norm(np.nanmean(tracked.estimates - tracked.truth, axis=1), axis=-1))


def expected(results: mc.Results) -> Iterator[mc.Claim]:
    """The 3-D error, its prediction, and the accuracy lost by the cascade and by assuming plane waves."""
    yield PRINTED[0].beside(results)
    # Fitted at one place of the stations, so that no tolerance is set for the other.
    yield replace(PRINTED[1].beside(results), within=None)
    direct_cm, spherical, plane = (
        results.value("rmse_3d_m", world, tracker).times(100).value
        for world, tracker in ((STAND, "direct"), (STAND, "cascade"), (PLANE, "cascade"))
    )
    gain = results.ratio("rmse_3d_m", STAND, "direct", "cascade")
    says = "one filter straight from phases is more accurate than the paper's cascade"
    how = f"{direct_cm:.2f} against {spherical:.2f} cm, {fixed_interval(gain, '.2f')} times"
    yield mc.Conclusion(says, gain.high < 1, how, mc.DERIVED)
    offsets = [100 * results.value("offset_m", w, "cascade").value for w in (STAND, PLANE)]
    says = "taking waves as plane, as (9) does, costs the cascade less than a tenth of its error here"
    how = f"{spherical:.2f} cm in spherical waves, {plane:.2f} cm in plane ones; mean error of a run "
    how += f"{offsets[0]:.2f} and {offsets[1]:.2f} cm"
    yield mc.Conclusion(says, 0 < spherical - plane < 0.1 * spherical, how, mc.DERIVED)
    believed = {t: results.value("nees_3d_mean", STAND, t).value for t in results.study.trackers}
    says = "the cascade is overconfident, more than the direct filter"
    how = f"normalised squared error {believed['cascade']:.1f} against {believed['direct']:.1f}, 3 expected"
    yield mc.Conclusion(says, believed["cascade"] > max(3.0, believed["direct"]), how, mc.PREDICTED)


STUDY = mc.Study(
    name="figure-8",
    about="How far off are positions by three stations, by the paper's cascade and straight from phases?",
    worlds={
        STAND: mc.World(recorded, {"radius": RADIUS}),
        APART: mc.World(recorded),
        PLANE: mc.World(recorded, {"radius": RADIUS, "wave": "plane"}),
    },
    trackers={"cascade": CASCADE, "direct": DIRECT},
    runs=200,
    measures={"offset_m": offset},
    metrics=("rmse_3d_m", "median_3d_m", "p95_3d_m", "bound_3d_m", "nees_3d_mean", "diverged"),
    expected=expected,
)
SEARCH = Fit(
    STUDY,
    {"radius": Fitted(0.29, "m", "section 4.2, 3.18 cm")},
    [PRINTED[:1]],
    "none: one number against one printed figure",
    runs=64,
    seed=1,
)


def fit() -> tuple[str, dict[str, Fitted]]:
    """The radius, and the error that it gives."""
    left, numbers = SEARCH()
    # As it is written: to four digits.
    error = PRINTED[0].number * SEARCH.ratios({"radius": float(f"{numbers['radius'].value:.4g}")})[0]
    return left, numbers | {"error": Fitted(error, "cm", f"what the radius gives, {SEARCH.runs} trajectories")}

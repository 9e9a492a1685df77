"""Figures 6 and 7 of paper A: azimuth and elevation over the helix, by the EKF and by the delay-and-sum beamformer.

The EKF's errors were fitted (Table 1), so that its advantage rests on fitted numbers in part. The curves are lost. A
second world has outliers of chosen number and size, which are not printed.
"""

from collections.abc import Callable, Iterator

import numpy as np

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.declared import Printed
from trackwright.experiments.lab.papers.will_2020._work_stand import ALL, BEAM, PRINTED_DEG, RADIUS, recorded
from trackwright.experiments.text.expectations import fixed_interval

AXES = ("azimuth", "elevation")
HELIX, OUTLYING = "helix", "helix with outlying phases"
OUTLIERS, SIZE = 0.02, 1.5
"""Fraction of outlying phases and the standard deviation of their additional error, rad; both chosen."""

OUTLIER = np.deg2rad(5.0)


def outliers(tracked: mc.TrackedRuns) -> np.ndarray:
    """Fraction (n,) of directions with an error above 5° in either angle."""
    return np.asarray((np.abs(tracked.error).max(axis=-1) > OUTLIER).mean(axis=(1, 2)))


def _rms(angle: int) -> Callable[[mc.TrackedRuns], np.ndarray]:
    """Root mean square error (n,), rad, of azimuth or elevation, by trajectory."""
    return lambda tracked: np.sqrt(np.nanmean(tracked.error[..., angle] ** 2, axis=(1, 2)))


def expected(results: mc.Results) -> Iterator[mc.Claim]:
    """The errors printed with Figure 7, and the EKF's advantage."""
    for axis, number in zip(AXES, PRINTED_DEG[ALL], strict=True):
        name, metric, note = f"Figure 7, EKF, {axis}", f"rmse_{axis}_rad", "printed in Table 1, too"
        printed = Printed(name, number, metric, mc.DERIVED, note, unit="deg", worlds=(HELIX,), tracker="EKF")
        yield printed.beside(results)
    for world in results.study.worlds:
        for axis in AXES:
            mine, its = (results.value(f"rmse_{axis}_rad", world, t).times(180 / np.pi) for t in ("EKF", "DAS"))
            ratio = results.ratio(f"rmse_{axis}_rad", world, "DAS", "EKF")
            each = results.numbers(f"{axis}_rad", world, "EKF") < results.numbers(f"{axis}_rad", world, "DAS")
            yield mc.Conclusion(
                f"{world}: the EKF's {axis} is better than the beamformer's",
                ratio.low > 1 and bool(each.mean() > 0.95),
                f"{mine.value:.2f} against {its.value:.2f} deg, {fixed_interval(ratio, '.2f')} times; "
                f"better on {100 * each.mean():.0f} % of the trajectories",
                mc.DERIVED if world == HELIX else mc.PREDICTED,
            )
    shares = {t: results.value("wild", OUTLYING, t).times(100) for t in ("EKF", "DAS")}
    says = "outliers are smoothed out by the EKF"
    how = f"off by more than 5 deg: {shares['EKF'].value:.2f} % of its directions, of the beamformer's "
    how += f"{shares['DAS'].value:.2f} %"
    yield mc.Conclusion(says, shares["EKF"].high < 0.2 * shares["DAS"].low, how, mc.PREDICTED)


STUDY = mc.Study(
    name="figures-6-7",
    about="How well do a Kalman filter and a delay-and-sum beamformer follow a beacon on a helix?",
    worlds={
        HELIX: mc.World(recorded, {"radius": RADIUS}),
        OUTLYING: mc.World(recorded, {"radius": RADIUS, "outlying": OUTLIERS, "size": SIZE}),
    },
    trackers={"EKF": BEAM, "DAS": mc.TrackerConfig("das")},
    runs=100,
    measures={"wild": outliers, "azimuth_rad": _rms(0), "elevation_rad": _rms(1)},
    metrics=("rmse_azimuth_rad", "rmse_elevation_rad", "median_direction_rad", "p95_direction_rad", "wild"),
    expected=expected,
)

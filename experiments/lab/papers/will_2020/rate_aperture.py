"""Measurement rate x aperture x track loss: the trade-off that paper A's conclusion names.

A larger aperture is more accurate, but its ambiguous directions are closer: at a low rate a beacon can move from one to
the next between two rows. Waves are plane, so that only rate and aperture matter. A direction is astray if its error
exceeds half the distance to the next ambiguous one, the wavelength over twice the array's largest extent.
"""

from collections.abc import Iterator
from itertools import product

import numpy as np

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.will_2020._work_stand import ALL, BEAM, RADIUS, recorded

RATES, APERTURES = (2.5, 5.0, 10.0, 20.0), (0.5, 1.0, 2.0, 4.0)
THREE = "2-3-6"
HELD = 2.0
"""Percentage of directions that may be astray in a track that counts as held."""


def astray(tracked: mc.TrackedRuns) -> np.ndarray:
    """Fraction (n,) of directions on a wrong lobe."""
    station = next(iter(tracked.folder.rig.stations.values()))
    assert station.antennas is not None
    assert station.wavelength is not None
    limit = station.wavelength / (2 * np.ptp(station.antennas, axis=0).max())
    error = np.abs(tracked.estimates - tracked.truth).max(axis=-1)
    return np.asarray(np.where(tracked.known, error > limit, np.nan).mean(axis=(1, 2)))


def expected(results: mc.Results) -> Iterator[mc.Claim]:
    """The paper's conclusions on the trade-off."""
    fast, slow, large = RATES[-1], RATES[0], APERTURES[-1]
    usual = [180 / np.pi * _number(results, "median_direction_rad", ALL, fast, a) for a in APERTURES]
    lost = {p: 100 * _number(results, "astray", *p) for p in product((ALL, THREE), RATES, APERTURES)}
    sure = {w: [max([a for a in APERTURES if lost[w, r, a] < HELD], default=0.0) for r in RATES] for w in (ALL, THREE)}
    largest = {
        w: ", ".join(f"{a:g} x at {r:g} Hz" for a, r in zip(apertures, RATES, strict=True))
        for w, apertures in sure.items()
    }
    says = "a larger aperture is more accurate while the track holds"
    how = f"median at {fast:g} Hz, all antennas: " + ", ".join(
        f"{a:g} x {m:.2f} deg" for a, m in zip(APERTURES, usual, strict=True)
    )
    yield mc.Conclusion(says, usual == sorted(usual, reverse=True), how, mc.PREDICTED)
    holds = all(lost[w, slow, large] > 5 + lost[w, fast, large] for w in (ALL, THREE))
    how = f"antennas {THREE}, {large:g} times the aperture, astray: " + ", ".join(
        f"{lost[THREE, r, large]:.1f} % at {r:g} Hz" for r in RATES
    )
    yield mc.Conclusion("a larger aperture needs a higher rate to keep track", holds, how, mc.PREDICTED)
    says = "the largest aperture that keeps its track is the larger, the higher the rate"
    holds = all(apertures == sorted(apertures) and apertures[0] < apertures[-1] for apertures in sure.values())
    how = f"less than {HELD:g} % astray: " + "; ".join(f"{w} {told}" for w, told in largest.items())
    yield mc.Conclusion(says, holds, how, mc.PREDICTED)
    holds = all(lost[THREE, r, a] >= lost[ALL, r, a] for r in RATES for a in APERTURES)
    how = f"at {slow:g} Hz and {large:g} times the aperture {lost[THREE, slow, large]:.1f} against "
    how += f"{lost[ALL, slow, large]:.1f} % astray"
    yield mc.Conclusion("three antennas lose the track sooner than eight", holds, how, mc.PREDICTED)


def _number(results: mc.Results, metric: str, world: str, rate: float, aperture: float) -> float:
    return results.value(metric, world, "EKF", **{"world.rate_hz": rate, "world.aperture": aperture}).value


STUDY = mc.Study(
    name="rate-aperture",
    about="How large may an array be at which measurement rate before a moving beacon's track is lost?",
    worlds={name: mc.World(recorded, {"radius": RADIUS, "wave": "plane", "antennas": name}) for name in (ALL, THREE)},
    trackers={"EKF": BEAM},
    runs=40,
    grid={"world.rate_hz": RATES, "world.aperture": APERTURES},
    measures={"astray": astray},
    metrics=("rmse_direction_rad", "median_direction_rad", "astray", "diverged"),
    expected=expected,
)

"""Shared by the studies of the work stand: the paper's stand with the fitted array, its helix, trackers and failures.

Three antennas have several directions of equal power within ±30°; the paper's tracks must have started on all eight.
Antennas are therefore masked from the second row on.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.declared import built
from trackwright.experiments.lab.papers.fitting import fitted
from trackwright.experiments.lab.papers.will_2020.fit_array_layout import TABLE_1_DEG
from trackwright.sim.corruptions import Corruption, lose_station, outliers
from trackwright.sim.keys import Keys
from trackwright.sim.stations import PhaseDraw, work_station
from trackwright.trackers.aoa.beam import beam_tracker
from trackwright.trackers.aoa.rows import PHASES
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.folder import RecordingFolder

NUMBERS = fitted("papers/will_2020/table_1")
RADIUS = fitted("papers/will_2020/figure_8")["radius"]
"""The fitted distance of the stations from the centre line, m."""

ALL = "full array"
SETS = ("3-7-8", "2-7-8", "1-2-5", "2-3-6", ALL)
"""Antennas in use, counted from 1, in the order of Table 1."""

PRINTED_DEG = {
    name: TABLE_1_DEG[tuple(range(1, 9)) if name == ALL else tuple(int(k) for k in name.split("-"))] for name in SETS
}
"""Table 1: antenna set -> root mean square error of azimuth and elevation, degrees."""

POINTS, RATE_HZ = 200, 10.0
"""Rows and rate of the helix; only σa ΔT² enters the filter, so that the rate is chosen and σa follows."""

HELIX = "helix"


def antennas_of(numbers: Mapping[str, float]) -> np.ndarray:
    """The array (8, 2), m, from parameters such as `NUMBERS`."""
    return np.array([[numbers[f"{axis}_{k}"] for axis in "xy"] for k in range(1, 9)]) / 1000


def in_use(name: str) -> np.ndarray:
    """Mask (8,) of the antennas of a set of `SETS`."""
    return np.ones(8, bool) if name == ALL else np.isin(np.arange(1, 9), [int(k) for k in name.split("-")])


def covered(name: str) -> Corruption:
    """Masks the antennas outside the set, at all stations, from the second row on."""

    def corrupt(keys: Keys, times: np.ndarray, values: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        after = np.arange(len(times)) > 0
        return values, seen & (in_use(name) | ~after[:, None, None])

    return corrupt


def stand(numbers: Mapping[str, float], radius: float = 0.4, aperture: float = 1.0) -> Rig:
    """The work stand with the fitted array scaled by `aperture`, stations `radius` m off the middle line.

    Station positions and numbers are not printed. Here station 1 is the one whose loss leaves the two stations with the
    most similar geometry.
    """
    rig = work_station(aperture * antennas_of(numbers), radius)
    first, second, third = rig.stations.values()
    return replace(rig, stations={"1": second, "2": first, "3": third})


def recorded(
    ids: np.ndarray,
    seed: int,
    antennas: str = ALL,
    lost: int = 0,
    wave: Literal["spherical", "plane"] = "spherical",
    radius: float = 0.4,
    aperture: float = 1.0,
    rate_hz: float = RATE_HZ,
    outlying: float = 0.0,
    size: float = 0.0,
) -> RecordingFolder:
    """Phases of beacons on the helix, one trajectory per id, 20 s at any rate.

    `antennas`: a set of `SETS`. `lost`: number of a lost station, 0 for none. `outlying`: fraction of outliers, with an
    additional error of standard deviation `size`, rad.
    """
    corruptions: dict[str, Corruption] = {"covered": covered(antennas)} if antennas != ALL else {}
    if lost:
        corruptions["lost station"] = lose_station(lost - 1)
    if outlying:
        corruptions["outliers"] = outliers(outlying, size)
    rig, points = stand(NUMBERS, radius, aperture), round(POINTS * rate_hz / RATE_HZ)
    draw = PhaseDraw(rig, HELIX, corruptions, rate_hz, points, NUMBERS["sigma_p"], wave)
    return draw.drawn(ids, seed).folder("work stand")


BEAM = mc.TrackerConfig("beam", {"motion.sigma_a": NUMBERS["sigma_a"], "sensors.*.sigma_p": NUMBERS["sigma_p"]})
PRINTED_BEAM = built(
    "beam",
    "the beam tracker with each of the 28 differences wrapped, (8)-(17)",
    lambda t, planar: beam_tracker(t.folder.rig.stations[t.station], PHASES, paper_form=True),
    BEAM.tunables,
)
CASCADE = mc.TrackerConfig("cascade", {f"beams.*.{name}": level for name, level in BEAM.tunables.items()})
"""The paper's cascade, with default levels in its fusion."""

DIRECT = mc.TrackerConfig("direct", {"sensors.*.sigma_p": NUMBERS["sigma_p"]})
"""The filter from phases to position."""

"""Shared by the studies of the work stand: the paper's stand with the fitted array, its helix, trackers and failures.

Three antennas have several directions of equal power within ±30°; the paper's tracks must have started on all eight.
Antennas are therefore masked from the second row on.

The library's default array (trackers/aoa/phases.py) is `fitted_layout`: eight antennas whose Cramér–Rao bounds have the
ratios of Table 1's errors. Gauss-Newton iterations over seeded starts find some hundred exact layouts; of these, scaled
to fill the box, the one with the lowest side lobes is chosen, so that a beamformer rarely starts a track on a wrong
lobe. The printed errors are a filter's, not bounds: this is a fit, not a reconstruction of the array.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.declared import built
from trackwright.experiments.lab.papers.fitting import fitted
from trackwright.sim.corruptions import Corruption, lose_station, outliers
from trackwright.sim.keys import Keys
from trackwright.sim.stations import PhaseDraw, work_station
from trackwright.trackers.aoa.beam import beam_tracker
from trackwright.trackers.aoa.phases import DEFAULT_WAVELENGTH, boresight_bounds
from trackwright.trackers.aoa.rows import PHASES
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.folder import RecordingFolder

NUMBERS = fitted("papers/will_2020/table_1")
RADIUS = fitted("papers/will_2020/figure_8")["radius"]
"""The fitted distance of the stations from the centre line, m."""

ALL = "full array"
PRINTED_DEG = {
    "3-7-8": (2.194, 10.731),
    "2-7-8": (1.051, 4.764),
    "1-2-5": (13.227, 1.964),
    "2-3-6": (0.668, 0.974),
    ALL: (0.583, 0.893),
}
"""Table 1: antennas in use, counted from 1 -> root mean square error of azimuth and elevation, degrees."""

SETS = tuple(PRINTED_DEG)

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

DIRECT = mc.TrackerConfig("direct", {"sensors.*.sigma_p": NUMBERS["sigma_p"]})  # the filter from phases to position

HALF_BOX = np.array([0.04, 0.02])
SMALLEST_SPACING = DEFAULT_WAVELENGTH / 2
STARTS, ITERATIONS, LONGEST_STEP = 2000, 40, 0.005


def log_ratios(layouts: np.ndarray) -> np.ndarray:
    """Log of bound over printed error (..., 10), less its mean; zero if a layout (..., 8, 2) has the ratios."""
    sets = [boresight_bounds(layouts[..., in_use(name), :]) for name in SETS]
    logs = np.log(np.concatenate(sets, axis=-1)) - np.log(np.concatenate(list(PRINTED_DEG.values())))
    return logs - logs.mean(axis=-1, keepdims=True)


def exact_layouts(seed: int = 0) -> np.ndarray:
    """Layouts (k, 8, 2), m, with exactly the ratios of Table 1, filling the box, antennas half a wavelength apart."""
    layouts = np.random.default_rng(seed).uniform(-1, 1, (STARTS, 8, 2)) * HALF_BOX
    for _ in range(ITERATIONS):
        residual, jacobian = log_ratios(layouts), _jacobian(layouts)
        # The residuals sum to zero; the added constant restores full rank and changes no step.
        square = jacobian @ jacobian.swapaxes(-1, -2) + np.ones((10, 10)) * 1e4
        step = -(jacobian.swapaxes(-1, -2) @ np.linalg.solve(square, residual[..., None]))[..., 0]
        step *= np.minimum(1, LONGEST_STEP / np.abs(step).max(axis=-1, keepdims=True).clip(1e-30))
        layouts = layouts + step.reshape(layouts.shape)
    layouts = layouts[np.abs(log_ratios(layouts)).max(axis=-1) < 1e-9]
    layouts -= (layouts.max(axis=1, keepdims=True) + layouts.min(axis=1, keepdims=True)) / 2
    layouts *= (HALF_BOX / np.abs(layouts).max(axis=1)).min(axis=1)[:, None, None]
    spacing = np.linalg.norm(layouts[:, :, None] - layouts[:, None], axis=-1) + np.eye(8)
    return layouts[spacing.min(axis=(1, 2)) >= SMALLEST_SPACING]


def side_lobe(layout: np.ndarray) -> float:
    """The array factor's largest value (the beam's own is 1) outside the main beam, between any +-30 degrees."""
    du, dv = np.meshgrid(np.linspace(0, 1, 41), np.linspace(-1, 1, 81), indexing="ij")
    phases = 2 * np.pi / DEFAULT_WAVELENGTH * (du[..., None] * layout[:, 0] + dv[..., None] * layout[:, 1])
    factor = np.abs(np.exp(1j * phases).mean(axis=-1))
    beam = (du / 0.25) ** 2 + (dv / 0.4) ** 2 < 1
    return float(factor[~beam].max())


def fitted_layout() -> np.ndarray:
    """The layout (8, 2), m, with the lowest side lobes, rounded to 0.01 mm."""
    return np.round(min(exact_layouts(), key=side_lobe), 5)


def _jacobian(layouts: np.ndarray) -> np.ndarray:
    """Derivative (k, 10, 16) of `log_ratios` by complex steps: exact to rounding."""
    columns = []
    for i in range(16):
        moved = layouts.astype(complex)
        moved[:, i // 2, i % 2] += 1e-30j
        columns.append(log_ratios(moved).imag / 1e-30)
    return np.stack(columns, axis=-1)

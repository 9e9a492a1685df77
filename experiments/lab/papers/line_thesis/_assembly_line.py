"""Shared by the studies of the assembly line: the nine recordings of Table 3.1 as worlds, and the thesis's filters.

A world is a recording: its situation, the white noise that gives its measurement error, and the parameters common to
all nine. The truth is fitted to the recording's own fixes by least squares, as in section 2.6; errors correlated along
the path enter both, and are therefore underestimated.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

import experiments.monte_carlo as mc
from experiments.lab.papers.trackers import RAW as FIXES_ALONE
from sim.corruptions import gauss_markov, white_noise
from sim.line import simulate_line
from trackers.baselines.fixes import fix_tracker
from trackers.baselines.rows import TRACKERS as BASELINES
from trackers.core.polyline import Polyline
from trackers.core.tracker import AbstractTracker
from trackers.line.fixes import FIXES, FloorFixes
from trackers.line.motion import LineMotion
from trackers.line.rows import TRACKERS, path_of
from trackers.line.tracker import line_grid_tracker, line_tracker
from trackers.line.truth import knot_times
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracker_spec import TrackerSpec

SITUATIONS = {"situation 1": "constant", "situation 2": "halts", "situation 3": "speeds"}

PRINTED = {
    "situation 1, set 1": (31.1, 24.4, 16.3),
    "situation 1, set 2": (31.2, 25.8, 16.9),
    "situation 1, set 3": (52.8, 31.7, 16.1),
    "situation 2, set 1": (30.3, 25.2, 15.8),
    "situation 2, set 2": (33.5, 24.3, 14.9),
    "situation 2, set 3": (29.4, 24.5, 13.7),
    "situation 3, set 1": (38.7, 31.2, 20.2),
    "situation 3, set 2": (44.8, 31.1, 19.6),
    "situation 3, set 3": (60.8, 33.7, 24.8),
}
"""Table 3.1, cm: measurement, Kalman filter and particle filter of each recording."""

AVERAGES = (39.2, 27.9, 17.6)
RECORDINGS, COLUMNS = tuple(PRINTED), ("raw", "Kalman", "particle")

MEASUREMENT_NOISE = 0.392
"""Average error of all measurements, m; the measurement noise of the thesis's filters (chapter 3)."""

BEYOND = 10.0
"""Extension of the last segment, m; the last case of (2.5) has no upper end."""

SIGMA = "motion.sigma_a"
SWEPT = (0.06, 0.09, 0.13, 0.18, 0.25, 0.35)
"""m/s per √s; at 5 Hz 3 to 16 cm/s per step, inside the thesis's range of 0 to 100 cm."""


def recording(ids: np.ndarray, seed: int, number: int, **numbers: Any) -> RecordingFolder:
    """Draws of recording `number` of Table 3.1, one per id, with the truth fitted to its fixes by least squares.

    `numbers`: `situation`, `speed` m/s, `rate_hz`; `white`, `slow`: standard deviations, m, of independent errors and
    of errors with time constant `tau`, s; `fitted_truth`: False keeps the simulated truth.
    """
    return _recording(tuple(np.asarray(ids).tolist()), seed, number, **numbers)


@lru_cache(maxsize=8)
def _recording(
    ids: tuple[int, ...],
    seed: int,
    number: int,
    situation: str,
    white: float,
    slow: float,
    tau: float,
    speed: float,
    rate_hz: float,
    fitted_truth: bool = True,
) -> RecordingFolder:
    """Cached: a sweep uses the same recordings at every value, and the least squares are slow."""
    errors = {"white": white_noise(white), "slow": gauss_markov(slow, tau)}
    # Nine recordings are nine draws, each with its own seed.
    world = simulate_line(situation, ids, 10 * seed + number, speed=speed, rate_hz=rate_hz, errors=errors)
    if fitted_truth:
        places = [knot_times(world.knots, world.times, fixes).positions(world.times) for fixes in world.fixes]
        world = dataclasses.replace(world, positions=np.stack(places))
    return world.folder(f"recording-{number}-{seed}")


def worlds(numbers: Mapping[str, float], names: Sequence[str] = RECORDINGS) -> dict[str, mc.World]:
    """The recordings as worlds, from parameters such as `fitted("papers/line_thesis/table_3_1")`."""
    made = {}
    for name in names:
        own = {"number": RECORDINGS.index(name) + 1, "situation": SITUATIONS[name.partition(",")[0]]}
        common = {key: numbers[key] for key in ("slow", "tau", "speed", "rate_hz")}
        made[name] = mc.World(recording, {**own, "white": numbers[noise_of(name)], **common})
    return made


def noise_of(name: str) -> str:
    """The parameter of a recording's white noise: `white_1_3` for situation 1, set 3."""
    return "white_" + "_".join(word for word in name.replace(",", "").split() if word.isdigit())


def open_ended(knots: Any) -> Polyline:
    """The path of (2.5), whose last segment is extended, so that particles may pass the end."""
    knots = np.asarray(knots, float)
    along = (knots[-1] - knots[-2]) / np.linalg.norm(knots[-1] - knots[-2])
    return Polyline(np.vstack([knots[:-1], knots[-1] + BEYOND * along]))


def _thesis_filter(
    spec: TrackerSpec, about: str, build: Callable[[RecordingFolder, bool], AbstractTracker]
) -> mc.TrackerConfig:
    """A tracker of the catalogue as the thesis has it, built from the folder and whether the height is known."""
    made = dataclasses.replace(spec, about=about, build=lambda trajectory, planar: build(trajectory.folder, planar))
    return mc.TrackerConfig(made)


def measured_fixes() -> dict[str, FloorFixes]:
    """The sensor of all filters on the path."""
    return {FIXES: FloorFixes(MEASUREMENT_NOISE)}


def _open_particles(folder: RecordingFolder, planar: bool) -> AbstractTracker:
    path_of(folder)
    return line_tracker(LineMotion(open_ended(folder.rig.path_knots), 0.1), measured_fixes())


def _kalman(folder: RecordingFolder, planar: bool) -> AbstractTracker:
    return fix_tracker(sigma_a=0.1, sigma_horizontal=MEASUREMENT_NOISE, dof=None, planar=planar)


RAW = mc.TrackerConfig(dataclasses.replace(FIXES_ALONE, about="the measurements themselves"))
KALMAN = _thesis_filter(BASELINES["fix-kf"], "the thesis's Kalman filter, (1.3)-(1.21)", _kalman)
PARTICLE = _thesis_filter(TRACKERS["line-pf"], "the thesis's particle filter, (2.1)-(2.5)", _open_particles)
STOPPING = _thesis_filter(
    TRACKERS["line-pf"],
    "the same on a path that ends at its last knot",
    lambda folder, planar: line_tracker(LineMotion(path_of(folder), 0.1), measured_fixes()),
)
GRID = _thesis_filter(
    TRACKERS["line-grid"],
    "grid, no segment",
    lambda folder, planar: line_grid_tracker(LineMotion(path_of(folder), 0.1), measured_fixes()),
)


def distances(tracked: mc.TrackedRuns) -> np.ndarray:
    """Horizontal errors (n, T), m; NaN for rows that are not scored."""
    return np.hypot(tracked.error[..., 0], tracked.error[..., 1])


def error(tracked: mc.TrackedRuns) -> np.ndarray:
    """Mean distance from the truth (n,), m: (2.8) by its text."""
    return np.asarray(np.nanmean(distances(tracked), axis=1))


def root_mean_square(tracked: mc.TrackedRuns) -> np.ndarray:
    """Root mean square distance from the truth (n,), m: (2.8) by its name."""
    return np.asarray(np.sqrt(np.nanmean(distances(tracked) ** 2, axis=1)))


def least(results: mc.Results, tracker: str, measure: str = "error_m") -> float:
    """The dynamic noise with the least average error over all worlds."""
    swept = results.study.grid[SIGMA]
    pairs = [(world, tracker) for world in results.study.worlds]
    return float(swept[int(np.argmin([results.average(measure, pairs, **{SIGMA: s}).value for s in swept]))])


def with_noise(config: mc.TrackerConfig, sigma: float) -> mc.TrackerConfig:
    """The tracker with dynamic noise `sigma`."""
    return dataclasses.replace(config, tunables={SIGMA: sigma})


def with_middle_95(value: float, drawn: np.ndarray) -> mc.Value:
    """A value with the middle 95 % of its resamplings as its interval."""
    low, high = np.quantile(drawn, [0.025, 0.975])
    return mc.Value(float(value), float(low), float(high))

"""Shared by the studies of the assembly line: the nine recordings of Table 3.1 as worlds, and the thesis's filters.

The truth is fitted to the recording's own fixes, as in section 2.6; errors correlated along the path enter both, and
are therefore underestimated.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.declared import built
from trackwright.sim.corruptions import gauss_markov, white_noise
from trackwright.sim.line import LineDraw
from trackwright.trackers.baselines.fixes import fix_tracker
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.core.run.track_loss import TrackLossPolicy
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.line.motion import LineMotion
from trackwright.trackers.line.rows import path_of
from trackwright.trackers.line.tracker import FloorFixes, line_tracker
from trackwright.trackers.line.truth import knot_times
from trackwright.trackers.parts.fixes import FIXES
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracks import Trajectory

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

BEYOND = 10.0  # extension of the last segment, m; the last case of (2.5) has no upper end

SIGMA = "motion.sigma_a"
SWEPT = (0.06, 0.09, 0.13, 0.18, 0.25, 0.35)
"""m/s per √s; at 5 Hz 3 to 16 cm/s per step, inside the thesis's range of 0 to 100 cm."""


def recording(ids: np.ndarray, seed: int, number: int, **numbers: Any) -> RecordingFolder:
    """Draws of recording `number` of Table 3.1, one per id, with the truth fitted to its fixes by least squares.

    `numbers`: `situation`, `speed` m/s, `rate_hz`; `white`, `slow`: standard deviations, m, of independent errors and
    of errors with time constant `tau`, s.
    """
    return _recording(tuple(np.asarray(ids).tolist()), seed, number, **numbers)


@lru_cache(maxsize=8)
def _recording(ids: tuple[int, ...], seed: int, number: int, **of: Any) -> RecordingFolder:
    """Cached: a sweep uses the same recordings at every value, and the least squares are slow."""
    errors = {"white": white_noise(of["white"]), "slow": gauss_markov(of["slow"], of["tau"])}
    # Nine recordings are nine draws, each with its own seed.
    seed_of = 10 * seed + number
    draw = LineDraw(of["situation"], errors, speed=of["speed"], rate_hz=of["rate_hz"])
    world = draw.drawn(ids, seed_of)
    places = [knot_times(np.array(draw.knots), world.times, fixes).positions(world.times) for fixes in world.fixes]
    folder = dataclasses.replace(world, given={**world.arrays, "positions": np.stack(places)}).folder(
        f"recording-{number}-{seed}"
    )
    # Tables without their draw, of which a study would draw anew the truth that is replaced here.
    return dataclasses.replace(folder, tables=dict(folder.tables))


def worlds(numbers: Mapping[str, float], names: Sequence[str] = RECORDINGS) -> dict[str, mc.World]:
    """The recordings as worlds, from parameters such as `fitted("papers/line_thesis/table_3_1")`."""
    made = {}
    for name in names:
        specific = {"number": RECORDINGS.index(name) + 1, "situation": SITUATIONS[name.partition(",")[0]]}
        common = {key: numbers[key] for key in ("slow", "tau", "speed", "rate_hz")}
        made[name] = mc.World(recording, {**specific, "white": numbers[noise_of(name)], **common})
    return made


def noise_of(name: str) -> str:
    """The parameter of a recording's white noise: `white_1_3` for situation 1, set 3."""
    return "white_" + "_".join(word for word in name.replace(",", "").split() if word.isdigit())


def open_ended(knots: Any) -> Polyline:
    """The path of (2.5), whose last segment is extended, so that particles may pass the end."""
    knots = np.asarray(knots, float)
    along = (knots[-1] - knots[-2]) / np.linalg.norm(knots[-1] - knots[-2])
    return Polyline(np.vstack([knots[:-1], knots[-1] + BEYOND * along]))


def _on_path(about: str, path: Callable[[RecordingFolder], Polyline]) -> mc.TrackerConfig:
    """A tracker as in the thesis: with normal errors, and without a start where readings agree on another place."""

    def build(trajectory: Trajectory, planar: bool) -> AbstractTracker:
        tracker = line_tracker(LineMotion(path(trajectory.folder), 0.1), {FIXES: FloorFixes(MEASUREMENT_NOISE, None)})
        return dataclasses.replace(tracker, track_loss=TrackLossPolicy(nis_limit=30.0, max_gap=np.inf))

    return built("line-pf", about, build)


def _kalman(trajectory: Trajectory, planar: bool) -> AbstractTracker:
    return fix_tracker(sigma_a=0.1, sigma_horizontal=MEASUREMENT_NOISE, dof=None, planar=planar)


KALMAN = built("fix-kf", "the thesis's Kalman filter, (1.3)-(1.21)", _kalman)
PARTICLE = _on_path("the thesis's particle filter, (2.1)-(2.5)", lambda folder: open_ended(folder.rig.path_knots))
STOPPING = _on_path("the same on a path that ends at its last knot", path_of)


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


def with_middle_95(value: float, drawn: np.ndarray) -> mc.Value:
    """A value with the middle 95 % of its resamplings as its interval."""
    low, high = np.quantile(drawn, [0.025, 0.975])
    return mc.Value(float(value), float(low), float(high))

"""Whether a map over the floor of what a calibration leaves of bearings is kept: `trackers/aoa/bearing_map.py`.

A visit is a run of rows of a station and a tag within half a metre; the mean error of its rows is one sample of the
place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.stats import norm

from trackwright.trackers.aoa.bearing_map import predicted
from trackwright.trackers.recordings.calibration import StationCalibration
from trackwright.tuning.calibration_pairs import Pairs

VISIT_M = 0.5  # from the first row of a visit, within which further rows are of the same one
DIGITS, MOST = 4, 500  # decimals of places and errors; the most visits of a station, of which more are thinned evenly


def confirmed_map(
    pairs: Mapping[str, Pairs],
    stations: Mapping[str, StationCalibration],
    without: Sequence[Mapping[str, StationCalibration]],
) -> dict[str, np.ndarray]:
    """The visits (V, 4) of all recordings about their calibration, by station; none where those left out refute them.

    The rule: the visits of each recording, about a calibration on the others (`without`, by number), are together more
    probable by the map of the others' visits than by a normal density of no mean and, for each angle of a station, the
    others' root mean square.
    """
    gain = 0.0
    for number, others in enumerate(without):
        for name in others.keys() & pairs.keys():
            visits, recording = visits_of(pairs[name], others[name])
            known, left_out = _thinned(visits[recording != number]), visits[recording == number]
            if len(known) and len(left_out):
                means, sigmas = np.split(predicted(known, left_out[:, :2]), 2, axis=1)
                spread = np.sqrt((known[:, 2:] ** 2).mean(axis=0)) + 10.0**-DIGITS
                errors = left_out[:, 2:]
                gain += (norm.logpdf(errors, means, sigmas) - norm.logpdf(errors, 0.0, spread)).sum()
    if gain <= 0.0:
        return {}
    whole = {name: _thinned(visits_of(pairs[name], station)[0]) for name, station in stations.items()}
    return {name: visits for name, visits in whole.items() if len(visits)}


def _thinned(visits: np.ndarray) -> np.ndarray:
    return visits[np.unique(np.linspace(0, len(visits) - 1, min(MOST, len(visits))).astype(int))]


def visits_of(pairs: Pairs, station: StationCalibration) -> tuple[np.ndarray, np.ndarray]:
    """Visits (V, 4) to places, m, with mean errors about a calibration, rad, and the numbers (V,) of their recordings.

    Rows that lack an angle are left out.
    """
    tags = np.unique(pairs.tag, return_inverse=True)[1].ravel()
    order = np.lexsort((pairs.time, tags, pairs.recording))
    order = order[np.isfinite(pairs.measured[order]).all(axis=1)]
    columns = np.concatenate([pairs.positions[:, :2], pairs.measured - station.measured(pairs.true)], axis=1)[order]
    sources = list(zip(pairs.recording[order].tolist(), tags[order].tolist(), strict=True))
    places, begins = columns[:, :2].tolist(), list[int]()
    for k, source in enumerate(sources):
        first = begins[-1] if begins else k
        if not begins or source != sources[first] or math.dist(places[k], places[first]) > VISIT_M:
            begins.append(k)
    if not begins:
        return columns, pairs.recording[order]
    counts = np.diff(begins, append=len(columns))
    means = np.add.reduceat(columns, begins) / counts[:, None]
    return np.round(means, DIGITS), pairs.recording[order][begins]

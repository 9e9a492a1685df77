"""Whether a map over the floor of what a calibration leaves of bearings is kept: `trackers/recordings/bearing_map.py`.

A visit is a run of rows of a station and a tag within half a metre; the mean error of its rows is one sample of the
place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import norm

from trackwright.trackers.recordings.bearing_map import BearingMap, predicted
from trackwright.trackers.recordings.calibration import Calibration, StationCalibration
from trackwright.tuning.calibration_pairs import Pairs

VISIT_M = 0.5
"""Distance, m, from the first row of a visit within which further rows are of the same one."""

DIGITS, MOST = 4, 500
"""Decimals of places and errors; the most visits of a station, of which more are thinned evenly."""


class Runs(NamedTuple):
    """The rows of a station in the order of its visits, those that lack an angle left out.

    `begins` (V,): the first row of each visit. `recording` (V,): the number of its recording.
    """

    rows: Pairs
    begins: np.ndarray
    recording: np.ndarray

    def visits(self, calibration: StationCalibration) -> np.ndarray:
        """Places, m, and mean errors about a calibration, rad, of the visits (V, 4)."""
        errors = self.rows.measured - calibration.measured(self.rows.true)
        columns = np.concatenate([self.rows.positions[:, :2], errors], axis=1)
        counts = np.diff(self.begins, append=len(errors))
        return np.round(np.add.reduceat(columns, self.begins) / counts[:, None], DIGITS)


def confirmed_map(
    pairs: Mapping[str, Pairs], calibration: Calibration, without: Sequence[Mapping[str, StationCalibration]]
) -> BearingMap | None:
    """The map of the errors of all recordings about their calibration; None where those left out do not confirm it.

    The rule: the visits of each recording, about a calibration on the others (`without`, by number), are together more
    probable by the map of the others' visits than by a normal density of no mean and, for each angle of a station, the
    others' root mean square.
    """
    runs = {name: runs_of(pairs[name]) for name in calibration.stations}
    runs = {name: of_station for name, of_station in runs.items() if len(of_station.begins)}
    gains = [np.zeros(0)]
    for number, stations in enumerate(without):
        for name in stations.keys() & runs.keys():
            visits, left_out = runs[name].visits(stations[name]), runs[name].recording == number
            if left_out.any() and not left_out.all():
                gains.append(_gain(thinned(visits[~left_out]), visits[left_out]))
    of_visits = np.concatenate(gains)
    if of_visits.sum() <= 0.0:
        return None
    whole = {name: thinned(of_station.visits(calibration.stations[name])) for name, of_station in runs.items()}
    return BearingMap(float(of_visits.mean()), whole)


def _gain(others: np.ndarray, left_out: np.ndarray) -> np.ndarray:
    """By how much each visit left out is more probable with the map of the others', nats."""
    errors, (means, sigmas) = left_out[:, 2:], predicted(others, left_out[:, :2])
    spread = np.sqrt((others[:, 2:] ** 2).mean(axis=0)) + 10.0**-DIGITS
    gains: np.ndarray = (norm.logpdf(errors, means, sigmas) - norm.logpdf(errors, 0.0, spread)).sum(axis=1)
    return gains


def thinned(visits: np.ndarray) -> np.ndarray:
    """At most `MOST` of them."""
    return visits[np.unique(np.linspace(0, len(visits) - 1, MOST).astype(int))]


def runs_of(pairs: Pairs) -> Runs:
    """The rows of a station by recording, tag and time, and where its visits begin."""
    seen = np.isfinite(pairs.measured).all(axis=1)
    tags = np.unique(pairs.tag, return_inverse=True)[1].ravel()
    order = np.lexsort((pairs.time, tags, pairs.recording))
    order = order[seen[order]]
    rows = Pairs(*(column[order] for column in pairs))
    fresh = (np.diff(np.stack([rows.recording, tags[order]])) != 0).any(axis=0)
    places = rows.positions[:, :2].tolist()
    begins = [0] if places else []
    for k, other in enumerate(fresh.tolist(), 1):
        if other or math.dist(places[k], places[begins[-1]]) > VISIT_M:
            begins.append(k)
    at = np.array(begins, int)
    return Runs(rows, at, rows.recording[at])

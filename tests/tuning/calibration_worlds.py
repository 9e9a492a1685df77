"""Recordings of walks in a room with known systematic errors, and errors that last: for tests of calibrations."""

import numpy as np
import polars as pl

from trackwright.trackers.core.model.rig import Rig, Station
from trackwright.trackers.recordings.calibration import (
    ANGLE_PRIOR,
    RANGE_PRIOR,
    AnchorCalibration,
    Calibration,
    StationCalibration,
)
from trackwright.trackers.recordings.folder import RecordingFolder

ROOM = np.array([9.0, 6.0])
HEIGHT = 1.2
LENGTH, TIME = 0.28, 7.5  # way, m, and time, s, over which the lasting error decays

_TURN = np.sqrt(0.5)
STATIONS = {
    "north": Station(np.array([4.5, 6.0, 2.3]), np.array([_TURN, _TURN, 0.0, 0.0])),
    "south": Station(np.array([4.5, 0.0, 2.3]), np.array([0.0, 0.0, _TURN, _TURN])),
    "west": Station(np.array([0.0, 3.0, 2.3]), np.array([0.5, 0.5, 0.5, 0.5])),
}
ANCHORS = {
    "A": np.array([0.0, 0.0, 2.5]),
    "B": np.array([9.0, 0.0, 0.5]),
    "C": np.array([9.0, 6.0, 2.5]),
    "D": np.array([0.0, 6.0, 0.5]),
}
RIG = Rig("room", anchors=ANCHORS, stations=STATIONS)
WIDE = np.array([[-np.pi, np.pi], [-np.pi / 2, np.pi / 2]])


def drawn(rng):
    """A calibration with terms drawn from the prior, those with which an angle does not increase excluded."""
    zeros = np.zeros((2, 4, 4))
    stations = {}
    for name in STATIONS:
        terms = ANGLE_PRIOR[0] + ANGLE_PRIOR[1] * rng.normal(size=(2, 4))
        # In this room angles are within 1.4 and 1.1 rad.
        while (
            terms[:, 1] + 3 * np.minimum(terms[:, 2], 0) * [1.9, 1.2] - np.abs(terms[:, 3]) * [1.1, 1.4] < 0.25
        ).any():
            terms = ANGLE_PRIOR[0] + ANGLE_PRIOR[1] * rng.normal(size=(2, 4))
        stations[name] = StationCalibration(terms, zeros, WIDE)
    anchors = {
        name: AnchorCalibration(RANGE_PRIOR[1] * rng.normal(size=2), np.zeros((2, 2)), np.array([0.0, 20.0]))
        for name in ANCHORS
    }
    return Calibration(stations, anchors)


def walk(rng, seconds, speed=0.8, every=0.2):
    """Times (T,), s, and positions (T, 3), m, of a walk between random points, with a stop of 0 to 4 s at each."""
    times, places = [0.0], [rng.uniform(0.8, ROOM - 0.8)]
    while times[-1] < seconds:
        target = rng.uniform(0.8, ROOM - 0.8)
        times += [times[-1] + np.linalg.norm(target - places[-1]) / speed]
        times += [times[-1] + rng.uniform(0.0, 4.0)]
        places += [target, target]
    at = np.arange(0.0, seconds, every)
    flat = np.stack([np.interp(at, times, [p[k] for p in places]) for k in range(2)], axis=1)
    return at, np.concatenate([flat, np.full((len(at), 1), HEIGHT)], axis=1)


def lasting(rng, times, positions, sigma):
    """A Gauss–Markov error (T,) of standard deviation `sigma`, which decays over `LENGTH` and `TIME`."""
    way = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    kept = np.exp(-(way / LENGTH + np.diff(times) / TIME))
    error = [rng.normal()]
    for k, fresh in zip(kept, rng.normal(size=len(kept)), strict=True):
        error.append(k * error[-1] + np.sqrt(1 - k * k) * fresh)
    return sigma * np.array(error)


def of_place(seed, positions, sigma):
    """A smooth random function (T,) of the place, of standard deviation `sigma`, which varies over `LENGTH`."""
    rng = np.random.default_rng(seed)
    waves, phases = rng.normal(size=(2, 100)) / LENGTH, rng.uniform(0.0, 2 * np.pi, 100)
    return sigma * np.sqrt(2.0 / 100) * np.cos(positions[:, :2] @ waves + phases).sum(axis=1)


def truth_of(times, positions):
    """The table of true positions (T, 3), m."""
    return pl.DataFrame({"t_s": times, "tag": "1"} | dict(zip(("x_m", "y_m", "z_m"), positions.T, strict=True)))


def ranged(name, times, positions, errors):
    """A recording of ranges with these errors (T,), m, made for each anchor in turn by `errors()`."""
    rows = [
        pl.DataFrame(
            {"t_s": times, "tag": "1", "anchor": a, "range_m": np.linalg.norm(positions - p, axis=1) + errors()}
        )
        for a, p in ANCHORS.items()
    ]
    tables = {"ranges": pl.concat(rows).sort("t_s"), "truth": truth_of(times, positions)}
    return RecordingFolder(name, None, RIG, tables)


def recording(rng, name, calibration, seconds=60.0, outliers=0.0, field=None):
    """A walk with bearings, whose errors last, and ranges, some of them `outliers` m too long.

    `field`: a seed, where errors are functions of the place instead, the same for all walks.
    """
    times, positions = walk(rng, seconds)

    def errors_of(source, sigma):
        return lasting(rng, times, positions, sigma) if field is None else of_place([field, source], positions, sigma)

    bearings, ranges = [], []
    for number, (station, own) in enumerate(STATIONS.items()):
        angles = calibration.stations[station].measured(own.angles(positions))
        errors = [errors_of(2 * number + k, sigma) for k, sigma in enumerate((0.07, 0.2))]
        angles = angles + np.stack(errors, axis=1) + 0.1 * rng.standard_t(4.0, size=angles.shape)
        columns = {"azimuth_rad": angles[:, 0], "elevation_rad": angles[:, 1]}
        bearings.append(pl.DataFrame({"t_s": times, "tag": "1", "station": station, **columns}))
    for number, (anchor, place) in enumerate(ANCHORS.items()):
        bias, slope = calibration.anchors[anchor].coefficients
        distances = np.linalg.norm(positions - place, axis=1)
        errors = errors_of(10 + number, 0.1) + 0.03 * rng.normal(size=len(times))
        errors += outliers * (rng.random(len(times)) < 0.1)
        measured = distances * (1 + slope) + bias + errors
        ranges.append(pl.DataFrame({"t_s": times, "tag": "1", "anchor": anchor, "range_m": measured}))
    tables = {"bearings": pl.concat(bearings).sort("t_s"), "ranges": pl.concat(ranges).sort("t_s")}
    tables["truth"] = truth_of(times, positions)
    return RecordingFolder(name, None, RIG, tables)


def world(seed, recordings=3, by_place=False, **options):
    """The calibration of a world, and its recordings; `by_place`: errors are functions of the place."""
    rng = np.random.default_rng(seed)
    calibration = drawn(rng)
    options |= {"field": seed} if by_place else {}
    return calibration, [recording(rng, f"walk {k + 1}", calibration, **options) for k in range(recordings)]


def standardised(found, known):
    """The errors of all terms of stations (n, 2, 4) and of anchors (n, 2) in their standard deviations."""
    angles = [
        (one.coefficients - known.stations[name].coefficients) / np.sqrt(np.diagonal(one.covariances, axis1=1, axis2=2))
        for name, one in found.stations.items()
    ]
    ranges = [
        (one.coefficients - known.anchors[name].coefficients) / np.sqrt(np.diag(one.covariance))
        for name, one in found.anchors.items()
    ]
    return np.array(angles), np.array(ranges)

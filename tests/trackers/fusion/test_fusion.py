"""Several kinds of readings in one state: likelihood against dense conditioning, rows, starts, the choice by tables."""

from dataclasses import replace

import jax
import numpy as np
import polars as pl
import pytest

from tests.known_start import NEVER_LOST
from tests.oracles import joint_conditioning, van_loan
from trackwright.sim.stations import facing
from trackwright.trackers.aoa.fusion import BEARINGS, bearing_inputs, bearing_tracker
from trackwright.trackers.baselines.fixes import fix_tracker
from trackwright.trackers.catalogue import build, fitting
from trackwright.trackers.core.data.recording import Readings, Recording
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Rig, Station, Tag
from trackwright.trackers.fusion.rows import fused_trajectories
from trackwright.trackers.fusion.tracker import fused_tracker
from trackwright.trackers.parts.fixes import FIXES
from trackwright.trackers.parts.ranges import RANGES
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.uwb_imu.fusion import TDOA, difference_tracker, range_tracker

pytestmark = pytest.mark.slow

FAR, NORMAL = 1e7, 1e6
"""A distance, m, at which readings are linear, and degrees of freedom at which Student's t is normal."""


def test_likelihood_and_moments_are_those_of_dense_conditioning():
    """All four kinds at once, anchors and the station so far that readings are linear: everything is jointly normal.

    Two kinds come from clocks of their own.
    """
    rng, rows, sigma_a, sigma_shared = np.random.default_rng(1), 12, 0.6, 0.2
    levels = {RANGES: (0.3, 7.0), TDOA: (0.2, 5.0), BEARINGS: (0.25 / FAR, 3.0)}
    tracker = fused_tracker(
        {
            RANGES: range_tracker(
                2, False, sigma_a, sigma_a, 5.0, 0.1, 1.0, NORMAL, 0.0, *levels[RANGES], 1e9, sigma_shared
            ),
            TDOA: difference_tracker(2, 1, False, sigma_d=0.15, dof=NORMAL, **_drift(levels[TDOA])),
            BEARINGS: bearing_tracker(
                1,
                sigma_azimuth=0.2 / FAR,
                sigma_elevation=0.3 / FAR,
                dof=NORMAL,
                **{**_drift(levels[BEARINGS]), "sigma_bias": [levels[BEARINGS][0]] * 2},
            ),
            FIXES: fix_tracker(sigma_horizontal=0.4, sigma_vertical=0.5, dof=NORMAL),
        }
    )
    tracker = tracker.with_values({f"sensors.{TDOA}.late": 0.3, f"sensors.{BEARINGS}.late": -0.2})
    towards = rng.normal(size=(4, 3))
    towards /= np.linalg.norm(towards, axis=1)[:, None]
    ranged, paired, number = towards[:2], towards[2:], rng.integers(0, 2, rows)
    station = Station(np.array([0.0, -FAR, 0.0]), facing(np.array([0.0, -FAR, 0.0]), np.zeros(3), (0.0, 0.0, 1.0)))
    times, angles = np.cumsum(rng.uniform(0.1, 0.5, rows)), station.world_from_array()[:, :2].T / FAR
    # The state: position, velocity, biases of bearings, ranges and differences, and the bias of the tag.
    range_rows = np.zeros((2, 13))
    range_rows[:, :3], range_rows[:, 8:10], range_rows[:, 12] = ranged, np.eye(2), 1.0
    difference, bearings, fixes = np.zeros((1, 13)), np.eye(2, 13, 6), np.eye(3, 13)
    difference[0, :3], difference[0, 10:12], bearings[:, :3] = paired[0] - paired[1], [1.0, -1.0], angles
    H = np.concatenate([range_rows, difference, bearings, fixes])
    H[:, 3:6] = -np.array([0.0, 0.0, 0.3, -0.2, -0.2, 0.0, 0.0, 0.0])[:, None] * H[:, :3]
    R = np.diag([0.1, 0.1, 0.15, 0.2 / FAR, 0.3 / FAR, 0.4, 0.4, 0.5]) ** 2
    values = 3.0 * np.sqrt(np.diag(R)) * rng.normal(size=(rows, 8))
    seen = rng.random((rows, 8)) > 0.4
    seen[:, :2] &= number[:, None] == np.arange(2)
    heard = np.take_along_axis(seen, number[:, None], axis=1)
    measured = FAR + np.take_along_axis(values, number[:, None], axis=1)
    inputs = {
        "anchors": -FAR * ranged[number],
        "anchor": number[:, None].astype(float),
        "pairs": np.tile(-FAR * paired.ravel(), (rows, 1)),
        "pair": np.tile([0.0, 1.0], (rows, 1)),
        "origin": np.tile(bearing_inputs(station)[:3], (rows, 1)),
        "axes": np.tile(bearing_inputs(station)[3:], (rows, 1)),
        "station": np.zeros(rows),
        "nearby": np.tile([0.0, 0.0, 0.0, 1.0], (rows, 1)),
        "height": np.zeros(rows),
    }
    readings = {
        RANGES: Readings(measured, heard, np.zeros((rows, 1))),
        TDOA: Readings(values[:, 2:3], seen[:, 2:3], np.zeros((rows, 1))),
        BEARINGS: Readings(values[:, 3:5], seen[:, 3:5], np.zeros((rows, 3))),
        FIXES: Readings(values[:, 5:], seen[:, 5:], np.zeros((rows, 3))),
    }
    estimates = replace(tracker, track_loss=NEVER_LOST).run(Recording(times, readings, inputs))
    std = np.repeat([levels[kind][0] for kind in (BEARINGS, RANGES, TDOA)], 2)
    constant = np.repeat([levels[kind][1] for kind in (BEARINGS, RANGES, TDOA)], 2)
    A, noise = np.zeros((13, 13)), np.zeros(13)
    A[:3, 3:6], A[3:6, 3:6], A[6:12, 6:12] = np.eye(3), -np.eye(3) / 5.0, -np.diag(1.0 / constant)
    noise[3:6], noise[6:12] = sigma_a**2, 2.0 * std**2 / constant
    links = [van_loan(A, np.diag(noise), dt) for dt in np.diff(times)]
    prior = np.diag(np.array([1.5] * 3 + [1.0] * 3 + [*std, sigma_shared]) ** 2)
    means, covs, density = joint_conditioning(links, H, R, values[1:], seen[1:], np.zeros(13), prior)
    mean = np.stack([np.asarray(x) for x in jax.tree_util.tree_leaves(estimates.mean)], axis=-1)
    # Angles in units of metres at their distance.
    unit = np.where(np.isin(np.arange(13), [6, 7]), FAR, 1.0)
    np.testing.assert_allclose(mean[1:] * unit, means * unit, rtol=1e-3, atol=1e-4)
    units = np.outer(unit, unit)
    np.testing.assert_allclose(estimates.covariance[1:] * units, covs * units, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(estimates.log_likelihood[1:], density, rtol=1e-4, atol=1e-3)


def _drift(levels):
    return {"sigma_bias": levels[0], "time_constant": levels[1], "length": 1e9}


TIMES = np.arange(0.0, 20.0, 0.1)
PATH = np.column_stack([3 + 2 * np.cos(TIMES / 3), 4 + 2 * np.sin(TIMES / 4), np.full(len(TIMES), 1.1)])
PLACES = {"A": np.array([0.0, 0.0, 2.5]), "B": np.array([6.0, 0.0, 2.2])}
CENTRE = np.array([3.0, 4.0, 2.0])
STATIONS = {name: Station(place, facing(place, CENTRE, (0, 0, 1.0))) for name, place in PLACES.items()}


def _folder(ranges, azimuths, elevation=False, height=1.1, later=0.0):
    """A tag on an ellipse: its ranges to some anchors, and azimuths of some stations that begin `later`, with truth."""
    rng, rows = np.random.default_rng(3), {RANGES: [], BEARINGS: []}
    for t, place in zip(TIMES, PATH, strict=True):
        head = {"t_s": t, "tag": "T"}
        for name in ranges:
            distance = np.linalg.norm(place - PLACES[name]) + rng.normal(0.0, 0.05)
            rows[RANGES].append(head | {"anchor": name, "range_m": distance})
        for name in azimuths:
            azimuth, up = STATIONS[name].angles(place) + rng.normal(0.0, 0.03, 2)
            angles = {"azimuth_rad": azimuth, "elevation_rad": up if elevation else None}
            rows[BEARINGS].append(head | {"t_s": t + later, "station": name} | angles)
    tables = {name: pl.DataFrame(table, infer_schema_length=None) for name, table in rows.items() if table}
    tables["truth"] = pl.DataFrame({"t_s": TIMES, "tag": "T", **dict(zip(("x_m", "y_m", "z_m"), PATH.T, strict=True))})
    return RecordingFolder("room", None, Rig("room", PLACES, STATIONS, {"T": Tag(height=height)}), tables)


@pytest.mark.parametrize(
    ("elevation", "height"), [(False, 1.1), (True, None)], ids=["azimuth at a known height", "both angles in space"]
)
def test_one_anchor_that_reports_distance_and_angle_is_enough(elevation, height):
    folder = _folder("A", "A", elevation, height)
    assert fitting(folder) == "fusion"
    known = build("fusion", folder).run(folder).to_polars().filter(pl.col("x_m").is_not_null())
    assert known["t_s"][0] <= 0.2
    errors = known.select("x_m", "y_m").to_numpy() - PATH[-len(known) :, :2]
    # Azimuths of stations that are not calibrated count little: 0.22 rad at 5 m.
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 0.6


def test_two_places_that_the_readings_do_not_tell_apart_are_no_start():
    """Two circles meet twice; the first azimuth, two seconds later, decides."""
    (trajectory,) = fused_trajectories(_folder("AB", "A", later=2.0), False)
    rows = trajectory.recording
    nearby, ranged = rows.inputs["nearby"], rows.readings[RANGES].seen[:, 0]
    assert nearby[rows.times < 2.0, 3].sum() == 0
    begin = np.flatnonzero(nearby[:, 3])[0]
    assert rows.times[begin] < 2.3
    assert np.linalg.norm(nearby[begin, :2] - PATH[20, :2]) < 1.0
    assert ranged.sum() == 2 * len(TIMES)


def test_readings_of_one_time_share_rows_and_others_have_their_own():
    shared, apart = (fused_trajectories(_folder("AB", "AB", later=later), False)[0].recording for later in (0.0, 0.05))
    assert len(shared) == 2 * len(TIMES)
    assert all(readings.seen[:, 0].all() for readings in shared.readings.values())
    assert len(apart) == 4 * len(TIMES)
    assert (apart.readings[RANGES].seen[:, 0] != apart.readings[BEARINGS].seen[:, 0]).all()
    # A row without a bearing has the station of the bearing before, whose derivatives are finite.
    assert np.linalg.norm(apart.inputs["axes"], axis=1).min() > 0.0


def test_fixes_that_may_come_from_the_ranges_are_fused_on_request_alone():
    folder = _folder("AB", "")
    fixes = pl.DataFrame({"t_s": TIMES, "tag": "T", **dict(zip(("x_m", "y_m", "z_m"), PATH.T, strict=True))})
    both = replace(folder, tables={**folder.tables, FIXES: fixes})
    assert fitting(both) == "fix-kf"
    assert len(build("fusion", both).run(both).to_polars()) == len(TIMES)
    # An unknown latency has no effect there, so that it cannot be set.
    assert "sensors.fixes.latency" in build("fusion", both).tunables
    assert "sensors.fixes.latency_std" not in build("fusion", both).tunables
    words = "two of the tables ranges, tdoa, bearings, fixes, found the table ranges alone"
    with pytest.raises(UnusableInput, match=words):
        build("fusion", folder)

"""The beam tracker in a flat array's plane: all headings, without a jump at half a turn."""

import numpy as np
import polars as pl

from trackwright.trackers.aoa.beam import in_plane_beam_tracker
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.model.rig import Rig, Station, Tag
from trackwright.trackers.recordings.folder import RecordingFolder

ROWS, SIGMA_P, RATE = 150, 0.2, 0.5
RING = np.stack([np.cos(np.arange(8) * np.pi / 4), np.sin(np.arange(8) * np.pi / 4)], axis=1)
STATION = Station(np.zeros(3), np.array([1.0, 0, 0, 0]), 0.05 * RING, 0.125)
TIMES = np.arange(ROWS) * 0.1


def _headings(trajectory):
    """Twice round in one sense or the other: every heading, ± π included."""
    return 0.7 * trajectory + (-1) ** trajectory * RATE * TIMES


def _recording(trajectory):
    rng = np.random.default_rng(trajectory)
    u = np.stack([np.cos(_headings(trajectory)), np.sin(_headings(trajectory))])
    phases = (2 * np.pi / STATION.wavelength * STATION.antennas @ u).T + rng.uniform(-np.pi, np.pi, (ROWS, 1))
    phases += SIGMA_P * rng.normal(size=phases.shape)
    return Recording(TIMES, {"a": Readings(np.angle(np.exp(1j * phases)), rng.random(phases.shape) < 0.9)})


def test_a_circling_beacon_is_tracked_through_every_heading_without_track_loss():
    estimates = in_plane_beam_tracker(STATION, "a", sigma_a=0.3, sigma_p=SIGMA_P).run(
        stack([_recording(k) for k in range(4)])
    )
    for trajectory in range(4):
        one = estimates[trajectory]
        error = np.angle(np.exp(1j * (one.mean.heading.angle - _headings(trajectory))))[20:]
        assert np.all(one.status == Status.OK)
        # A row's own error is 0.2/(2π 0.05/0.125 · √4) = 2.3°; the filter averages a few rows.
        assert np.rad2deg(np.sqrt(np.mean(error**2))) < 2.3
        assert np.abs(one.mean.rate[20:] - (-1) ** trajectory * RATE).max() < 0.4
        nees = (error / one.sigmas["heading.0"][20:]) ** 2
        assert 0.4 < nees.mean() < 2.5


def test_tags_at_the_height_of_an_upright_array_alone_are_tracked_in_its_plane():
    heights = {"level": 0.0, "above": 1.0, "unknown": None}
    rows = pl.DataFrame({"t_s": [0.0, 0.1] * 3, "tag": np.repeat([*heights], 2), "station": "a"})
    phases = rows.with_columns(pl.lit(0.1 * k).alias(f"phase_{k + 1}_rad") for k in range(8))
    for quaternion, in_plane in (([1.0, 0, 0, 0], {"level"}), ([np.sqrt(0.5), np.sqrt(0.5), 0, 0], set())):
        station = Station(np.zeros(3), np.array(quaternion), STATION.antennas, STATION.wavelength)
        rig = Rig("x", stations={"a": station}, tags={tag: Tag(height) for tag, height in heights.items()})
        batches = spec_of("beam").batches([RecordingFolder("x", None, rig, {"phases": phases})], "beam", False)
        assert {t.tag for b in batches for t in b.trajectories} == heights.keys()
        assert {t.tag for b in batches if b.planar for t in b.trajectories} == in_plane

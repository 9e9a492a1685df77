"""From folders to trajectories: rows, masks and truth of each, and their segments."""

import numpy as np
import polars as pl
import pytest

from tests.faulty import write_good
from trackwright.trackers.aoa.fusion import BEARINGS
from trackwright.trackers.aoa.rows import PHASES, beam_trajectories, bearing_trajectories
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording
from trackwright.trackers.recordings.tracks import segments


@pytest.fixture
def good(tmp_path):
    write_good(tmp_path / "good")
    return read_recording(tmp_path / "good")


def _with(folder, **tables):
    return RecordingFolder(folder.name, folder.path, folder.rig, folder.tables | tables)


def test_each_bearing_is_a_row_with_the_position_of_its_station(good):
    first, second = bearing_trajectories(good, free_height=False)
    assert (first.tag, second.tag, first.station) == ("T1", "T2", "")
    assert len(first.recording) == 100
    table = good.tables["bearings"].filter(tag="T1")
    readings = first.recording.readings[BEARINGS]
    np.testing.assert_array_equal(readings.values, table.select("azimuth_rad", "elevation_rad").to_numpy())
    assert readings.seen.all()
    np.testing.assert_array_equal(readings.reported, np.zeros((100, 3)))
    places = [good.rig.stations[name].position for name in table["station"]]
    np.testing.assert_array_equal(first.recording.inputs["origin"], places)
    np.testing.assert_array_equal(first.recording.inputs["height"], 1.0)
    place, known = first.recording.truth["position"]
    assert known.all()
    np.testing.assert_allclose(place[::2, 0], good.tables["truth"].filter(tag="T1")["x_m"])


def test_a_missing_angle_is_masked_and_reported_standard_deviations_become_variances(good):
    table = good.tables["bearings"].with_columns(
        azimuth_rad=pl.when(pl.col("t_s") == 1.0).then(None).otherwise("azimuth_rad"),
        azimuth_std_rad=pl.lit(0.1),
        elevation_std_rad=pl.when(pl.col("t_s") == 2.0).then(None).otherwise(0.2),
    )
    trajectory = bearing_trajectories(_with(good, bearings=table), free_height=False)[0]
    readings, times = trajectory.recording.readings[BEARINGS], trajectory.recording.times
    np.testing.assert_array_equal(readings.seen[:, 0], times != 1.0)
    assert readings.seen[:, 1].all()
    np.testing.assert_allclose(readings.reported[times == 0.5], [[0.1**2, 0.0, 0.2**2]] * 2)
    np.testing.assert_allclose(readings.reported[times == 2.0], [[0.1**2, 0.0, 0.0]] * 2)


def test_beams_are_a_trajectory_for_each_tag_and_station_with_true_directions(good):
    trajectories = list(beam_trajectories(good, False))
    assert {(trajectory.tag, trajectory.station) for trajectory in trajectories} == {
        (t, s) for t in ("T1", "T2") for s in ("S1", "S2")
    }
    trajectory = trajectories[0]
    assert trajectory.recording.readings[PHASES].values.shape == (50, 4)
    angles, known = trajectory.recording.truth["direction"]
    place = good.tables["truth"].filter(tag=trajectory.tag).select("x_m", "y_m", "z_m").to_numpy()
    assert known.all()
    np.testing.assert_allclose(angles, good.rig.stations[trajectory.station].angles(place))


def test_segments_hold_all_rows_in_order_and_about_the_requested_number_each(good):
    trajectory = bearing_trajectories(good, False)[0]
    for rows, count in ((100, 1), (30, 3), (14, 7)):
        parts = segments(trajectory, rows)
        lengths = [len(part.recording) for part in parts]
        assert (len(parts), max(lengths) - min(lengths) <= 1) == (count, True)
        joined = np.concatenate([part.recording.times for part in parts])
        np.testing.assert_array_equal(joined, trajectory.recording.times)

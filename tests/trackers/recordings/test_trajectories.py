"""From folders to trajectories: rows, masks and truth of each, and their segments."""

import numpy as np
import pytest

from tests.faulty import write_good
from trackwright.trackers.aoa.rows import PHASES, beam_trajectories, bearing_trajectories
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording
from trackwright.trackers.recordings.tracks import segments


@pytest.fixture
def good(tmp_path):
    write_good(tmp_path / "good")
    return read_recording(tmp_path / "good")


def _with(folder, **tables):
    return RecordingFolder(folder.name, folder.path, folder.rig, folder.tables | tables)


def test_beams_are_a_trajectory_for_each_tag_and_station_with_true_directions(good):
    trajectories = list(beam_trajectories(good, False))
    assert {(one.tag, one.station) for one in trajectories} == {(t, s) for t in ("T1", "T2") for s in ("S1", "S2")}
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

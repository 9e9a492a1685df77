"""The recordings that come with the project."""

import pytest

import trackwright as tw
from trackwright.trackers.recordings.checks.all_checks import quick_check


@pytest.mark.parametrize("name", ["labyrinth", "trolley"])
def test_a_shipped_recording_is_sound_and_names_its_licence(shipped, name):
    assert not [one for one in quick_check(tw.read(shipped / name)) if one.level == "error"]
    rig, notices = (shipped / name / "rig.toml").read_text("utf-8"), (*shipped.glob("LICENSE-*.txt"),)
    assert "licence = " in rig
    assert len(notices) == 2
    assert sum(path.stat().st_size for path in (shipped / name).iterdir()) < 300_000

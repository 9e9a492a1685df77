"""The ten-minute page: its commands run on the bags that it describes, and its fit makes the covariances hold."""

from __future__ import annotations

import pytest

from tests.in_process import trackwright
from trackwright.experiments.lab.validation import bag_tour
from trackwright.trackers.recordings.folder import read_recording


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A folder with the bags and the files of the page; it is the current one."""
    pytest.importorskip("rosbags", reason="rosbags is not installed; the extra ros has it")
    monkeypatch.setattr(bag_tour, "OUT", tmp_path / "tour")
    assert bag_tour.bag_tour(bags_only=True) == 0
    monkeypatch.chdir(tmp_path / "tour")
    return tmp_path / "tour"


def test_the_bags_of_the_page_are_imported_and_checked_as_it_says(files):
    commands = bag_tour.commands_of(bag_tour.PAGE.read_text(encoding="utf-8"))
    said = [trackwright(*words[1:]) for words in commands if words[1] in ("import", "check")]
    assert [done.code for done in said] == [0, 0, 0]
    assert "errors: 0" in said[-1].out
    recording = read_recording(files / "hall-1")
    assert recording.tables["truth"]["t_s"][0] == 0.0
    assert recording.tables["ranges"]["range_m"].is_between(0.1, 12).all()


@pytest.mark.slow
def test_every_command_of_the_page_runs_and_the_covariances_hold_after_the_fit(files):
    outputs = {}
    for words in bag_tour.commands_of(bag_tour.PAGE.read_text(encoding="utf-8")):
        done = trackwright(*words[1:])
        assert done.code == 0, (words, done.err)
        outputs[" ".join(words[1:3])] = done.out
    assert "Reported covariances hold" in outputs["tune hall-1"]

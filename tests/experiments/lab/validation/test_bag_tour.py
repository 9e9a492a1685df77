"""Pages that begin with bags: their commands run on the bags that they describe, with the results that they name."""

from __future__ import annotations

import numpy as np
import pytest

from tests.in_process import trackwright
from trackwright.experiments.lab.validation import bag_tour
from trackwright.experiments.lab.validation.surveys import simulated_site
from trackwright.trackers.recordings.folder import read_recording


@pytest.fixture
def toured(tmp_path, monkeypatch):
    """Writes the bags and the files of a page to a folder, which becomes the current one."""
    pytest.importorskip("rosbags", reason="rosbags is not installed; the extra ros has it")
    monkeypatch.setattr(bag_tour, "OUT", tmp_path / "tour")

    def written(tour):
        assert tour(bags_only=True) == 0
        monkeypatch.chdir(tmp_path / "tour")
        return tmp_path / "tour"

    return written


@pytest.fixture
def files(toured):
    return toured(bag_tour.bag_tour)


def test_the_bags_of_the_page_are_imported_and_checked_as_it_says(files):
    commands = bag_tour.commands_of(bag_tour.PAGE.read_text(encoding="utf-8"))
    said = [trackwright(*words[1:]) for words in commands if words[1] in ("import", "check")]
    assert [done.code for done in said] == [0, 0, 0]
    assert "errors: 0" in said[-1].out
    recording = read_recording(files / "hall-1")
    assert recording.tables["truth"]["t_s"][0] == 0.0
    assert recording.tables["ranges"]["range_m"].is_between(0.1, 12).all()


def _run(page):
    """What the commands of a page print, by their first words."""
    outputs = {}
    for words in bag_tour.commands_of(page.read_text(encoding="utf-8")):
        done = trackwright(*words[1:])
        assert done.code == 0, (words, done.err)
        outputs[" ".join(words[1:3])] = done.out
    return outputs


@pytest.mark.slow
def test_every_command_of_the_page_runs_and_the_covariances_hold_after_the_fit(files):
    outputs = _run(bag_tour.PAGE)
    assert "Reported covariances hold" in outputs["tune hall-1"]


@pytest.mark.slow
def test_bags_without_positions_of_anchors_become_a_rig_with_which_a_drive_is_tracked(toured):
    there = toured(bag_tour.survey_tour)
    outputs = _run(bag_tour.SURVEY_PAGE)
    assert "next: trackwright survey low" in outputs["import low.mcap"]
    assert "errors: 0" in outputs["check work"]
    assert "the innovations are as the tracker's model expects" in outputs["track work"]
    anchors = simulated_site(bag_tour.SITE, tuple(bag_tour.DRIVEN.values()), 0.0, bag_tour.SECONDS)[1]
    found = np.stack(list(read_recording(there / "work").rig.anchors.values()))
    distances = [np.linalg.norm(x[:, None] - x, axis=-1) for x in (anchors, found)]
    assert np.abs(distances[0] - distances[1]).max() < 0.3

"""Fits on sites with one recording left out each, on simulated vehicles."""

import dataclasses
import json

import pytest

from trackwright.experiments.lab.cases import Output
from trackwright.experiments.lab.validation import tuned_sites
from trackwright.experiments.lab.validation.sites import Site
from trackwright.sim import worlds
from trackwright.trackers.recordings.folder import read_recording, write_recording


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A folder of recordings of one vehicle each."""
    there = tmp_path_factory.mktemp("sites")
    for name, seed in (("hall-1", 1), ("hall-2", 2)):
        folder = worlds.agv(n=1, seed=seed, rows=120).folder()
        rig = dataclasses.replace(folder.rig, name=name)
        write_recording(dataclasses.replace(folder, name=name, rig=rig), there / name)
    return there


@pytest.mark.slow
def test_each_recording_of_a_site_is_judged_with_the_values_of_the_others(root, monkeypatch):
    pair = Site("hall", "fix-kf", "hall-*")
    monkeypatch.setattr(tuned_sites, "SITES", (pair, Site("none", "uwb", "hall-1"), Site("other", "uwb", "x")))
    monkeypatch.setenv("TRACKWRIGHT_RECORDINGS", str(root))
    tuned_sites.tuned_sites(site=("hall", "none"), output=Output(out=root / "sites.json"))
    rows = json.loads((root / "sites.json").read_text("utf-8"))["rows"]
    assert [row["recording"] for row in rows] == ["hall-1", "hall-2", "hall-1, first half", "hall-1, second half"]
    for row in rows[:2]:
        words = [row[side].partition(": ")[0] for side in ("of the others", "on it")]
        assert set(words) <= {"better", "worse", "not told apart"}
        assert row["right"] == ("open" if "not told apart" in words else "yes" if words[0] == words[1] else "no")
    assert all(row["right"].startswith("not fitted: ") for row in rows[2:])


def test_a_recording_is_shortened_from_the_beginning_of_its_truth(root):
    folder = read_recording(root / "hall-1")
    start = folder.tables["truth"]["t_s"][0]
    times = tuned_sites.shortened(folder, 2.0).tables["fixes"]["t_s"]
    assert start <= times.min() <= times.max() <= start + 2.0
    assert tuned_sites.shortened(folder, None) is folder

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
def test_each_recording_of_a_site_is_judged_with_the_values_of_the_others(root, monkeypatch, capsys):
    pair = Site("hall", "fix-kf", "hall-*")
    monkeypatch.setattr(tuned_sites, "SITES", (pair, Site("none", "uwb", "hall-1"), Site("other", "uwb", "x")))
    monkeypatch.setenv("TRACKWRIGHT_RECORDINGS", str(root))
    tuned_sites.tuned_sites(site=("hall", "none"), output=Output(out=root / "sites.json"))
    assert "Hall, each with values fitted to the others, before → after" in capsys.readouterr().out
    hall, none = json.loads((root / "sites.json").read_text("utf-8"))["rows"]
    assert hall["tune"] == "written" or hall["tune"].startswith("refused: hall-")
    assert none["tune"].startswith("not fitted: ")
    result, compared = tuned_sites.judged(pair, [read_recording(root / name) for name in ("hall-1", "hall-2")])
    assert [row[0] for row in compared.rows] == ["hall-1", "hall-2", "mean of 2"]
    assert result.value < result.start_value


def test_a_recording_is_shortened_from_the_beginning_of_its_truth(root):
    folder = read_recording(root / "hall-1")
    start = folder.tables["truth"]["t_s"][0]
    times = tuned_sites.shortened(folder, 2.0).tables["fixes"]["t_s"]
    assert start <= times.min() <= times.max() <= start + 2.0
    assert tuned_sites.shortened(folder, None) is folder

"""`--json`: the result alone on standard output, the same numbers as in the files."""

from __future__ import annotations

import json
import tomllib

import pytest

from tests.in_process import PLAIN, trackwright
from trackwright.sim import worlds
from trackwright.trackers.recordings.folder import write_recording


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A tag among four anchors, 6 s of ranges."""
    path = tmp_path_factory.mktemp("json") / "room"
    write_recording(worlds.ranges(n=1, seed=5, rows=60).folder(), path)
    return path


def _result(*words):
    done = trackwright(*words, "--json")
    assert done.code == 0, done
    return json.loads(done.out), done.err


def test_metrics_of_a_track_are_those_of_its_file(room, tmp_path):
    found, said = _result("track", room, "--tracker", "uwb", *PLAIN, "--out", tmp_path)
    assert found == {"uwb": json.loads((tmp_path / "evaluation.json").read_text("utf-8"))}
    assert "tracks.parquet" in said


def test_metrics_of_several_trackers_are_named_by_them(room, tmp_path):
    found, said = _result("track", room, "--tracker", "uwb,multilateration", *PLAIN, "--out", tmp_path)
    assert list(found) == ["uwb", "multilateration"]
    assert found["uwb"] != found["multilateration"]
    assert "Differences from uwb" in said


def test_the_result_of_a_fit_and_of_a_sweep(room, tmp_path):
    words = (room, "--tracker", "uwb", "--tune", "motion.sigma_a", "--steps", 1, "--starts", 1, *PLAIN)
    found, _ = _result("tune", *words, "--out", tmp_path / "fit")
    written = tomllib.loads((tmp_path / "fit" / "tuned.toml").read_text("utf-8"))
    assert found["tunables"].keys() == written["tunables"].keys() == {"motion.sigma_a"}
    assert found["tunables"]["motion.sigma_a"]["value"] == written["tunables"]["motion.sigma_a"]["value"]
    words = (room, "--tracker", "uwb", "--over", "motion.sigma_a=0.1:1:2", "--repeats", 1)
    found, _ = _result("sweep", *words, "--out", tmp_path / "grid")
    assert found["best"]["motion.sigma_a"] in (0.1, 1.0)


def test_the_list_of_trackers():
    found, _ = _result("trackers")
    assert "uwb" in found


@pytest.mark.parametrize("tracker", ["bearings", "trilateration", "floor-pf"])
def test_tunables_of_trackers_that_need_bearings_heights_or_a_floor(tracker):
    found, _ = _result("trackers", tracker)
    assert found["tracker"] == tracker
    assert found["tunables"] or tracker == "trilateration"

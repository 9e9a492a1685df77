"""`trackwright watch`: verdict, exit code, JSON and figure, and what it refuses."""

import json
import re

import numpy as np
import polars as pl
import pytest

from tests.in_process import assert_refused, assert_refused_last, trackwright
from trackwright.experiments.lab.validation.watch_worlds import Change, changed, normal_operation, world_of
from trackwright.trackers.recordings.folder import write_recording


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder with a baseline, a normal run, one with an anchor moved after 100 s, and one of 20 s."""
    there = tmp_path_factory.mktemp("site")
    world = world_of(2, "ranges, height known")
    folders = [normal_operation(world, name, 300.0, seed) for seed, name in enumerate(("baseline", "normal", "moved"))]
    folders[2] = changed(folders[2], Change("moved", "ranges", ("A2",), np.array([0.7, -0.7, 0.0]), 100.0), 0)
    for folder in (*folders, normal_operation(world, "short", 20.0, 9)):
        write_recording(folder, there / folder.name)
    return there


def test_a_run_in_normal_operation_is_no_change(site):
    said = trackwright("watch", site / "normal", "--baseline", site / "baseline")
    assert said.code == 0, said.err
    assert said.out.startswith("no change\n")
    assert "at most 1 false alarm a day" in " ".join(said.out.split())


def test_a_change_has_exit_code_1_a_verdict_as_json_and_a_figure(site, tmp_path):
    out = tmp_path / "watch.png"
    said = trackwright(
        "watch", site / "normal", site / "moved", "--baseline", site / "baseline", "--out", out, "--json"
    )
    assert said.code == 1, said.err
    assert out.exists()
    found = json.loads(said.out)
    assert found["changed"]
    first = found["causes"][0]
    assert (first["cause"], first["sources"]) == ("moved", ["anchor A2"])
    assert first["size"][0] == pytest.approx(0.7, abs=0.2)
    assert first["onset_s"] - found["runs_begin_s"][1] == pytest.approx(100.0, abs=15.0)
    assert "rig.toml" in first["to_do"]
    refused = trackwright("watch", site / "moved", "--baseline", site / "baseline", "--out", out)
    assert_refused(refused, "exists", "--force")


@pytest.fixture(scope="module")
def evidence(site):
    """The options of `track` with the baseline and the normal run as evidence of protection levels, and both watched."""
    options = []
    for name in ("baseline", "normal"):
        run = trackwright("track", site / name, "--tracker", "uwb", "--out", site / f"of-{name}", "--no-report")
        assert run.code == 0, run.err
        options += ["--protection", site / f"of-{name}"]
    return ["track", site / "moved", "--tracker", "uwb", *options, "--probability", 0.6, "--force"]


def test_a_tracked_run_has_the_verdict_and_infinite_protection_levels_since_the_change(site, evidence, tmp_path):
    watched = ("--watch", site / "baseline", "--watch", site / "normal", "--out", tmp_path / "out")
    said = trackwright(*evidence, *watched, "--json")
    assert said.code == 1, said.err
    first = json.loads(said.out)["watch"]["causes"][0]
    assert (first["cause"], first["sources"]) == ("moved", ["anchor A2"])
    tracks = pl.read_parquet(tmp_path / "out" / "tracks.parquet")
    since = tracks.filter(pl.col("pl_m").is_infinite())["t_s"]
    assert since.min() == pytest.approx(100.0, abs=15.0)
    assert len(since) == len(tracks.filter(pl.col("t_s") >= since.min()))
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert "changed: anchor A2 has moved by" in page
    (change,) = re.findall(r'\{"t":\s*([\d.]+),\s*"track":\s*null,\s*"what":\s*"site changed"', page)
    assert float(change) == pytest.approx(100.0, abs=15.0)
    assert (tmp_path / "out" / "watch.png").exists()
    assert trackwright("evaluate", tmp_path / "out", "--fail-if", "pl_m > 100").code == 1


def test_evidence_that_is_not_watched_is_refused(site, evidence, tmp_path):
    said = trackwright(*evidence, "--watch", site / "baseline", "--out", tmp_path / "out")
    assert_refused_last(said, "--watch: lacks normal, evidence of --protection")


def test_a_tracked_run_in_normal_operation_says_so(site, tmp_path):
    options = ("--tracker", "uwb", "--watch", site / "baseline", "--out", tmp_path / "out", "--no-report")
    said = trackwright("track", site / "normal", *options)
    assert said.code == 0, said.err
    assert "\nno change\n" in said.out


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (("--baseline", "baseline", "--out", "watch.txt"), "expected a file with the ending .png or .pdf"),
        ((), "no --baseline given"),
        (("--baseline", "normal"), "given more than once"),
        (("--baseline", "nowhere"), "nowhere"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(site, monkeypatch, options, word):
    monkeypatch.chdir(site)
    assert_refused(trackwright("watch", "normal", *options), word)


def test_a_baseline_that_is_too_short_says_how_long_is_needed(site):
    said = trackwright("watch", site / "normal", "--baseline", site / "short")
    assert_refused_last(said, "a baseline of 20 s; expected 60 s of normal operation at least, and ten minutes")

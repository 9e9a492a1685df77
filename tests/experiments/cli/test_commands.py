"""The other commands from end to end: simulate, check, trackers, sweep, tune, calibrate, survey, study."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from tests.experiments.cli.small_archive import random_walk
from tests.experiments.monte_carlo.small_study import TOML
from tests.in_process import PLAIN, assert_refused, trackwright
from tests.survey_sites import simulated_site
from tests.tuning.calibration_worlds import RIG, world
from trackwright.experiments.text import terminal
from trackwright.trackers.catalogue import fitting
from trackwright.trackers.core.model.rig import Tag
from trackwright.trackers.recordings.calibration import Calibration, read_calibration, write_calibration
from trackwright.trackers.recordings.folder import read_recording, write_recording
from trackwright.trackers.recordings.rig_file import read_rig

WORLDS = {
    "station": (("--rows", 20), {"phases", "truth"}, "direct"),
    "line": (("--rate-hz", 2), {"fixes", "truth"}, "line-grid"),
    "ranges": (("--rows", 30), {"ranges", "truth"}, "uwb"),
    "tdoa": (("--rows", 30, "--schedule", "turns"), {"tdoa", "truth"}, "tdoa"),
    "fusion": (("--rows", 30, "--stations", 1), {"ranges", "bearings", "truth"}, "fusion"),
    "body": (("--rows", 30, "--tags", 1, "--odometry"), {"ranges", "odometry", "truth"}, "uwb"),
    "tool": (("--rows", 40), {"ranges", "imu", "truth"}, "uwb"),
    # Its fixes have heights, which a tracker on a line would lose.
    "agv": (("--rows", 50, "--latency", 0.3, "--mirror", 0.1, "--wild", 0.01), {"fixes", "truth"}, "fix-kf"),
}


@pytest.mark.parametrize("name", WORLDS)
def test_a_world_is_a_recording_whose_tables_choose_their_tracker_and_a_tag_depends_on_its_number(tmp_path, name):
    extra, tables, tracker = WORLDS[name]
    for n in (1, 2):
        said = trackwright("simulate", name, "--n", n, "--seed", 4, *extra, "--out", tmp_path / f"{n}")
        assert said.code == 0, said
        assert said.out.startswith(f"wrote {tmp_path / f'{n}'}: {n} tag")
    one, two = (read_recording(tmp_path / f"{n}") for n in (1, 2))
    assert set(two.tables) == tables
    assert fitting(two) == tracker
    assert one.tables["truth"].equals(two.tables["truth"].filter(tag="0"))
    manifest = json.loads((tmp_path / "2" / "manifest.json").read_text())
    assert (manifest["seed"], manifest["numbers"]["n"]) == (4, 2)
    assert manifest["command"][:2] == ["trackwright", "simulate"]


def test_a_tracker_is_listed_with_its_numbers_and_leaves_as_c(beginnings, tmp_path):
    said = trackwright("trackers", "uwb", beginnings / "good")
    assert "motion.sigma_a = 0.44 m/s^2/sqrt(Hz) (> 0): " in said.out
    said = trackwright("export", beginnings / "good", "--format", "c", "--tag", "T1", "--out", tmp_path / "tag.c")
    assert said.code == 0, said.err
    assert {"tag.c", "tag.h", "tag.csv"} <= {path.name for path in tmp_path.iterdir()}
    assert "tag_step" in (tmp_path / "tag.h").read_text("utf-8")


SIGMA = "sensors.fixes.sigma_horizontal"


def test_a_sweep_gives_what_track_and_evaluate_give_at_the_same_value(tmp_path):
    walk, sweep = random_walk(tmp_path / "walk", 3, 0.25, rows=80), ("--tracker", "fix-kf", "--out")
    said = trackwright("sweep", walk, "--over", f"{SIGMA}=0.05:1.2:6", *sweep, tmp_path / "once")
    assert said.code == 0, said
    table = pl.read_csv(tmp_path / "once" / "sweep.csv")
    np.testing.assert_allclose(table[SIGMA], np.linspace(0.05, 1.2, 6))
    best = table.row(table["rmse"].arg_min(), named=True)
    assert f"best {SIGMA} = {best[SIGMA]:.6g} m" in said.out
    assert f"rmse = {best['rmse']:.6g} m" in said.out
    assert "6 trajectories filtered" in said.out
    value, rmse = table.row(2)
    assert trackwright("track", walk, "--set", f"{SIGMA}={value!r}", *PLAIN, *sweep, tmp_path / "out").code == 0
    figures = json.loads(trackwright("evaluate", tmp_path / "out", "--json").out)
    # single precision in the filter
    assert figures["overall"]["rmse_m"] == pytest.approx(rmse, rel=1e-4)
    grids = ("--over", "motion.sigma_a=0.01:1:3:log", "--over", f"{SIGMA}=0.1:0.6:4", "--objective", "nll")
    assert trackwright("sweep", walk, *grids, *sweep, tmp_path / "twice").code == 0
    table = pl.read_csv(tmp_path / "twice" / "sweep.csv")
    assert table.select("motion.sigma_a", SIGMA).unique().height == len(table) == 12
    np.testing.assert_allclose(table["motion.sigma_a"].unique().sort(), [0.01, 0.1, 1.0])
    assert (tmp_path / "twice" / "sweep.png").stat().st_size > 1000
    assert set(json.loads((tmp_path / "twice" / "manifest.json").read_text())["best"]) == {"motion.sigma_a", SIGMA}


@pytest.mark.parametrize(("kind", "left"), [("pdf", {"report.html", "rmse_m.pdf"}), ("none", set())])
def test_study_writes_the_figures_and_the_page_that_are_asked_for(tmp_path, kind, left):
    (tmp_path / "small.toml").write_text(TOML.replace("runs = 12", "runs = 4"), "utf-8")
    out = tmp_path / "out"
    done = trackwright("study", tmp_path / "small.toml", "--figures", kind, "--out", out)
    assert done.code == 0, done
    assert {path.name for path in out.iterdir() if path.is_file()} == {
        "study.json", "results.json", "manifest.json", *left
    }  # fmt: skip
    assert all((out / name).read_bytes().startswith((b"%PDF-", b"<!")) for name in left)


@pytest.fixture(scope="module")
def walks(tmp_path_factory):
    """Two walks to calibrate on, and a third; their calibration.toml, and what the command printed."""
    there = tmp_path_factory.mktemp("walks")
    known, folders = world(5, seconds=30.0)
    rig = replace(RIG, tags={"1": Tag(height=1.2)})
    for k, folder in enumerate(folders):
        write_recording(replace(folder, name=f"walk {k}", rig=replace(rig, name=f"walk {k}")), there / f"{k}")
    said = trackwright("calibrate", there / "0", there / "1", "--out", there / "site" / "calibration.toml")
    return there, known, said


@pytest.mark.slow
def test_a_calibration_is_written_with_a_page_and_its_recordings_and_gaps_are_named(walks, tmp_path):
    there, known, said = walks
    path = there / "site" / "calibration.toml"
    assert said.code == 0, said.err
    found = read_calibration(path)
    assert found.recordings == ("walk 0", "walk 1")
    assert (set(found.stations), set(found.anchors)) == (set(known.stations), set(known.anchors))
    page = (there / "site" / "calibration.html").read_text("utf-8")
    assert page.count('"title":"') >= 2 * len(known.stations) + len(known.anchors)
    assert_refused(trackwright("calibrate", there / "0", "--out", path), "exists", "--force replaces it")
    part = write_calibration(Calibration({"north": known.stations["north"]}), tmp_path / "part.toml")
    track = ("--tracker", "bearings", *PLAIN, "--out", tmp_path / "out")
    said = trackwright("track", there / "2", "--calibration", part, *track)
    names = "anchor A, anchor B, anchor C, anchor D, station south and 1 more"
    assert f"notice: {there / '2'}: {names}: not in {part}, or moved since; used uncalibrated" in said.err
    said = trackwright("track", there / "1", "--calibration", path, *track)
    assert f"notice: {there / '1'}: is one of the recordings of {path}; its errors are smaller than others'" in said.err


@pytest.mark.slow
@pytest.mark.parametrize("tracker", ["bearings", "uwb"])
def test_a_calibrated_track_is_nearer_to_the_truth(walks, tmp_path, tracker):
    there, _, _ = walks
    errors = []
    for name, more in (("plain", ()), ("calibrated", ("--calibration", there / "site" / "calibration.toml"))):
        said = trackwright("track", there / "2", "--tracker", tracker, *PLAIN, "--out", tmp_path / name, *more)
        assert said.code == 0, said.err
        assert "uncalibrated" not in said.err
        errors.append(json.loads((tmp_path / name / "evaluation.json").read_text("utf-8"))["overall"]["rmse_m"])
    assert errors[1] < 0.7 * errors[0]


@pytest.mark.slow
def test_walks_without_positions_of_anchors_give_a_rig_and_a_page(tmp_path, monkeypatch):
    folders, anchors, _ = simulated_site(2, (0.5, 1.9), 0.0)
    for folder, name in zip(folders, ("low", "high"), strict=True):
        write_recording(folder, tmp_path / name)
    out = tmp_path / "site" / "rig.toml"
    monkeypatch.setattr(terminal, "FIRST_LINE", 0.1)
    said = trackwright("survey", tmp_path / "low", tmp_path / "high", "--out", out)
    assert said.code == 0, said.err
    assert "survey: fitting positions and paths, " in said.err
    assert not re.search(r"\.\d{5}|-0\.0\b", out.read_text("utf-8"))
    found = read_rig(out)[0].anchors
    assert abs(found["A01"][0] - np.linalg.norm((anchors[1] - anchors[0])[:2])) < 0.2
    assert found["A01"][1] == pytest.approx(0.0, abs=1e-9)
    assert {path.name for path in out.parent.iterdir()} == {"rig.toml", "rig.html"}
    assert "determined" in out.with_suffix(".html").read_text("utf-8")
    assert_refused(trackwright("survey", tmp_path / "low", "--out", out), "exists", "--force")
    assert_refused(trackwright("survey", tmp_path / "low", "--out", tmp_path / "low" / "r.toml"), "recording folder")

"""`trackwright calibrate`, and `--calibration` of the commands that read recordings."""

import json
import tomllib
from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from tests.in_process import PLAIN, assert_refused, trackwright
from tests.tuning.calibration_worlds import LENGTH, RIG, TIME, differences, world
from trackwright.experiments.cli.tuning_job import cross_calibrated
from trackwright.experiments.pages.reports.calibration import report_on
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.recordings.bearing_map import BearingMap
from trackwright.trackers.recordings.calibration import Calibration, read_calibration, write_calibration
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording, write_recording
from trackwright.trackers.recordings.input_file import identity
from trackwright.tuning.calibrating import calibrate


@pytest.fixture(scope="module")
def walks(tmp_path_factory):
    """Two walks to calibrate on, and a third; their calibration.toml, and what the command printed."""
    there = tmp_path_factory.mktemp("walks")
    known, folders = world(5, seconds=30.0)
    rig = replace(RIG, tags={"1": Tag(height=1.2)})
    for number, folder in enumerate(folders):
        write_recording(
            replace(folder, name=f"walk {number}", rig=replace(rig, name=f"walk {number}")), there / f"{number}"
        )
    said = trackwright("calibrate", there / "0", there / "1", "--out", there / "site" / "calibration.toml")
    return there, known, said


def test_the_file_the_page_and_the_figures_are_written(walks):
    there, known, said = walks
    assert said.code == 0, said.err
    found = read_calibration(there / "site" / "calibration.toml")
    assert found.recordings == ("walk 0", "walk 1")
    assert set(found.stations) == set(known.stations)
    assert set(found.anchors) == set(known.anchors)
    names = {path.name for path in (there / "site").iterdir()}
    kinds = [f"calibration-{kind}.png" for kind in ("stations", "stations-floor", "anchors", "anchors-floor")]
    assert names == {"calibration.toml", "calibration.html", *kinds}
    again = trackwright("calibrate", there / "0", "--out", there / "site" / "calibration.toml")
    assert_refused(again, "calibration.toml: exists", "--force replaces it")
    assert f"wrote {there / 'site' / 'calibration.toml'}, calibration.html and {', '.join(kinds)}" in said.out


def test_the_table_and_the_page_show_each_term_with_its_standard_error(walks):
    there, _, said = walks
    station = read_calibration(there / "site" / "calibration.toml").stations["north"]
    gain = f"{station.coefficients[0, 1]:.3f} ± {np.sqrt(station.covariances[0, 1, 1]):.3f}".replace(" ", "\xa0")
    page = (there / "site" / "calibration.html").read_text("utf-8")
    assert gain in said.out
    assert gain in page
    # Two angles of three stations, four anchors, and the floors of both, all in the style of the other pages.
    assert page.count('<img src="data:image/svg+xml;base64,') == 12
    assert '<img src="data:image/png' not in page
    # A walk of 30 s determines no cubic term of elevations, which span half a radian.
    assert "<li>station north, elevation: " in page
    assert f"trackwright track RECORDING --calibration {there / 'site' / 'calibration.toml'}" in page.replace(
        "</span> <span>", " "
    )


@pytest.mark.slow
def test_the_page_says_that_its_figures_are_of_the_first_of_many_anchors(tmp_path):
    rng = np.random.default_rng(2)
    times = 0.2 * np.arange(150)
    place = np.stack([5 + 4 * np.cos(0.3 * times), 4 + 3 * np.sin(0.21 * times), np.ones(150)], axis=1)
    anchors = {f"A{k:02d}": np.array([rng.uniform(0, 10), rng.uniform(0, 8), 2.5]) for k in range(14)}
    at = {"t_s": times, "tag": ["1"] * 150}
    ranges = [
        pl.DataFrame(
            at | {"anchor": [name] * 150, "range_m": np.linalg.norm(place - spot, axis=1) + rng.normal(0, 0.05, 150)}
        )
        for name, spot in anchors.items()
    ]
    truth = pl.DataFrame(at | {f"{a}_m": place[:, k] for k, a in enumerate("xyz")})
    tables = {"ranges": pl.concat(ranges).sort("t_s", maintain_order=True), "truth": truth}
    write_recording(RecordingFolder("hall", None, Rig("hall", anchors=anchors), tables), tmp_path / "hall")
    assert trackwright("calibrate", tmp_path / "hall", "--out", tmp_path / "calibration.toml").code == 0
    text = (tmp_path / "calibration.html").read_text("utf-8")
    assert "Of the first 12 stations and anchors." in text
    # Nothing is left out of one recording, and all terms are determined.
    assert "Left out" not in text
    assert "<th>left out" not in text


def test_an_anchor_whose_errors_have_a_step_is_marked_and_the_note_explains_only_what_occurs():
    _, folders = world(7, 2, seconds=120.0)
    step = pl.when((pl.col("anchor") == "A") & (pl.col("range_m") > 5)).then(0.8).otherwise(0.0)
    folders = [
        replace(folder, tables={"truth": folder.tables["truth"], "ranges": folder.tables["ranges"].with_columns(
            pl.col("range_m") + step)})
        for folder in folders
    ]  # fmt: skip
    report = report_on(calibrate(folders), folders)
    assert [row[0] for row in report.anchors] == ["A, not linear", "B", "C", "D"]
    assert "Not linear: " in report.note
    assert ("In brackets" in report.note) == bool(report.undetermined)
    assert "Left out: " in report.note
    plain = report._replace(anchors=[["B", "0.1", "0.0", "9", "1 cm", "1 cm", "1 cm"]])
    assert "In brackets" not in plain.note
    assert "Not linear" not in plain.note
    alone = report_on(calibrate(folders[:1]), folders[:1])
    assert "Left out: " not in alone.note
    assert [section.head[-1] for section in alone.sections() if section.rows] == ["calibrated"]


def test_the_report_says_how_large_the_errors_of_readings_are_and_how_long_they_last():
    _, folders = world(5, 4, seconds=120.0)
    report = report_on(calibrate(folders), folders)
    assert "Errors that last: " in report.note
    of_angles = [row[2] for row in report.lasting if row[1] != "range" and row[2] != "–"]
    assert of_angles
    assert all("° [" in cell for cell in of_angles)
    rows = [row for row in report.lasting if row[1] == "range"]
    assert [row[0] for row in rows] == ["A", "B", "C", "D"]
    numbers = np.array([[float(cell.split()[0]) for cell in row[2:]] for row in rows])
    # The errors of ranges that `calibration_worlds` draws: 10 cm that last for 7.5 s and 0.28 m, 3 cm of white
    # noise; beside them those of the terms of the other recordings, which last longer.
    assert np.exp(np.log(numbers).mean(axis=0)) == pytest.approx([10.0, 3.0, TIME, LENGTH], rel=0.1)
    assert report_on(calibrate(folders[:1]), folders[:1]).lasting == []


@pytest.mark.parametrize("table", ["bearings", pytest.param("uwb", marks=pytest.mark.slow)])
def test_a_calibrated_track_is_nearer_to_the_truth(walks, tmp_path, table):
    there, _, _ = walks
    errors = []
    for name, more in (("plain", ()), ("calibrated", ("--calibration", there / "site" / "calibration.toml"))):
        said = trackwright("track", there / "2", "--tracker", table, *PLAIN, "--out", tmp_path / name, *more)
        assert said.code == 0, said.err
        assert "uncalibrated" not in said.err
        assert trackwright("evaluate", tmp_path / name, "--json").code == 0
        errors.append(json.loads((tmp_path / name / "evaluation.json").read_text("utf-8"))["overall"]["rmse_m"])
        config = json.loads((tmp_path / name / "manifest.json").read_text("utf-8"))["config"]
        assert config["calibration"] == (str(more[1]) if more else None)
    assert errors[1] < 0.7 * errors[0]


def test_stations_that_the_calibration_lacks_are_named_in_one_notice(walks, tmp_path):
    there, known, _ = walks
    part = Calibration({"north": known.stations["north"]}, recordings=("walk",))
    path = write_calibration(part, tmp_path / "part.toml")
    said = trackwright("sweep", there / "2", "--tracker", "bearings", "--over", "motion.sigma_a=0.1:0.2:2",
                       "--calibration", path, "--out", tmp_path / "out")  # fmt: skip
    assert said.code == 0, said.err
    (line,) = [line for line in said.err.splitlines() if "uncalibrated" in line]
    names = "anchor A, anchor B, anchor C, anchor D, station south and 1 more"
    assert line == f"notice: {there / '2'}: {names}: not in {path}, or moved since; used uncalibrated"


def test_a_recording_of_the_calibration_is_named_in_a_notice(walks, tmp_path):
    there, _, _ = walks
    path = there / "site" / "calibration.toml"
    said = trackwright("track", there / "1", "--tracker", "bearings", "--calibration", path, *PLAIN, "--out", tmp_path)
    assert f"notice: {there / '1'}: is one of the recordings of {path}; errors of others are larger" in said.err


def test_a_tracker_that_reads_neither_bearings_nor_ranges_is_named_in_a_notice(walks, tmp_path):
    there, _, _ = walks
    folder = world(5, 1, seconds=10.0)[1][0]
    fixes = folder.tables["truth"]
    write_recording(replace(folder, tables={**folder.tables, "fixes": fixes}), tmp_path / "fixes")
    said = trackwright("track", tmp_path / "fixes", "--tracker", "median", "--calibration",
                       there / "site" / "calibration.toml", *PLAIN, "--out", tmp_path / "out")  # fmt: skip
    assert said.code == 0, said.err
    assert "notice: tracker 'median' reads fixes; a calibration changes ranges, tdoa, bearings alone" in said.err


def test_an_output_that_is_no_toml_file_is_refused(walks, tmp_path):
    there, _, _ = walks
    for out in (tmp_path, tmp_path / "calibration", tmp_path / "calibration.html"):
        said = trackwright("calibrate", there / "0", "--out", out)
        assert_refused(said, f"--out {out}: expected a file with the ending .toml")
    assert_refused(trackwright("calibrate", there / "0", "--out", there / "1" / "c.toml"), "is a recording folder")


def test_a_recording_without_truth_is_refused_before_anything_is_written(tmp_path):
    folder = world(5, 1, seconds=10.0)[1][0]
    tables = {name: table for name, table in folder.tables.items() if name != "truth"}
    write_recording(replace(folder, tables=tables), tmp_path / "bare")
    said = trackwright("calibrate", tmp_path / "bare", "--out", tmp_path / "site" / "calibration.toml")
    assert_refused(said, f"{tmp_path / 'bare'}: no truth table; expected truth to calibrate against")
    assert not (tmp_path / "site").exists()


@pytest.mark.parametrize("command", [("track",), ("tune",), ("sweep", "--over", "motion.sigma_a=0.1:0.2:2")])
def test_a_file_that_is_no_calibration_is_refused(walks, tmp_path, command):
    there, _, _ = walks
    (tmp_path / "tuned.toml").write_text("[tunables]\n", "utf-8")
    name, *more = command
    said = trackwright(name, there / "2", *more, "--calibration", tmp_path / "tuned.toml", "--out", tmp_path / "out")
    assert_refused(said, f"{tmp_path / 'tuned.toml'}: no `format`, expected `format = 1`")


FIT = ("--tracker", "uwb", "--tune", "sensors.ranges.sigma_r", "--steps", 1, "--starts", 1)


def test_a_recording_of_the_calibration_is_fitted_with_one_of_others_and_the_file_names_it(walks, tmp_path):
    there, _, _ = walks
    calibration = there / "site" / "calibration.toml"
    words = ("--calibration", calibration, *FIT, *PLAIN)
    both = trackwright("tune", there / "0", there / "1", *words, "--out", tmp_path / "both")
    assert both.code == 0, both.err
    assert f"{there / '0'}: for the fit calibrated on walk 1, instead of by {calibration}" in both.err
    assert f"{there / '1'}: for the fit calibrated on walk 0, instead of by {calibration}" in both.err
    content = tomllib.loads((tmp_path / "both" / "tuned.toml").read_text())
    assert content["calibration"] == identity(calibration)


def test_halves_of_the_only_recording_of_a_calibration_are_calibrated_on_one_another(walks):
    there, _, _ = walks
    calibration = there / "site" / "calibration.toml"
    folders = [read_recording(there / name).calibrated(read_calibration(calibration)) for name in "02"]
    (first, second), (other,) = cross_calibrated(folders, calibration)
    assert (first.name, second.name, other.name) == ("walk 0, first half", "walk 0, second half", "walk 2")
    assert {part.calibration.range_spread for part in (first, second, other)} == {other.calibration.range_spread}
    assert first.calibration.recordings == ("walk 0, second half",)
    assert second.calibration.recordings == ("walk 0, first half",)
    assert sum(half.tables["ranges"].height for half in (first, second)) == folders[0].tables["ranges"].height
    blind = replace(folders[0], tables={k: v for k, v in folders[0].tables.items() if k != "truth"})
    ((same,),) = cross_calibrated([blind], calibration)
    assert same.tables.keys() == blind.tables.keys()


def test_a_noise_file_of_another_calibration_is_noticed(walks, tmp_path):
    there, _, _ = walks
    calibration = there / "site" / "calibration.toml"
    other = tmp_path / "other.toml"
    other.write_text(calibration.read_text("utf-8") + "# another\n", "utf-8")
    noise, own = tmp_path / "tuned.toml", identity(calibration)
    named = f'calibration = {{ name = "calibration.toml", fingerprint = "{own["fingerprint"]}" }}\n'
    noise.write_text(named + '[tunables."sensors.ranges.sigma_r"]\nvalue = 0.1\n', "utf-8")
    text = f"{noise}: fitted to recordings with the calibration calibration.toml ({own['fingerprint']}), and "
    for given, expected in (((), "none is given"), ((other,), f"{other} is another"), ((calibration,), None)):
        on = ("--calibration", *given) if given else ()
        run = ("track", there / "2", "--tracker", "uwb", "--noise", noise, *on, *PLAIN)
        said = trackwright(*run, "--out", tmp_path / "out")
        assert said.code == 0, said.err
        assert (text in said.err) == (expected is not None)
        assert expected is None or text + expected in said.err
    noise.write_text('tracker = "uwb"\n[tunables."sensors.ranges.sigma_r"]\nvalue = 0.1\n', "utf-8")
    for on in ((), ("--calibration", calibration)):
        said = trackwright("track", there / "2", "--noise", noise, *on, *PLAIN, "--out", tmp_path / "out")
        assert (f"{noise}: fitted to recordings without a calibration, and {calibration} is given" in said.err) == bool(
            on
        )


@pytest.mark.slow
def test_range_differences_are_calibrated_tracked_and_fitted_with_the_file(tmp_path):
    rng = np.random.default_rng(8)
    paths = [tmp_path / name for name in ("one", "two", "three")]
    for path in paths:
        write_recording(differences(rng, path.name, np.array([0.1, -0.1, 0.05, -0.05]), 30.0), path)
    file = tmp_path / "site.toml"
    said = trackwright("calibrate", *paths[:2], "--out", file)
    assert said.code == 0, said.err
    known = read_calibration(file).differences
    cell = f"{known.biases[0]:.3f} ± {np.sqrt(known.covariance[0, 0]):.3f}".replace(" ", "\xa0")
    assert cell in said.out
    assert cell in (tmp_path / "site.html").read_text("utf-8")
    assert "4 anchors in range differences" in (tmp_path / "site.html").read_text("utf-8")
    said = trackwright("track", paths[2], "--calibration", file, *PLAIN, "--out", tmp_path / "tracks")
    assert said.code == 0, said.err
    assert "uncalibrated" not in said.err
    parts = cross_calibrated([read_recording(path) for path in paths[:2]], file)
    assert {part.calibration.differences.spread for (part,) in parts} == {known.spread}
    assert parts[0][0].calibration.recordings == ("two",)


def test_a_fit_to_recordings_of_a_map_is_without_one(tmp_path, capsys):
    _, folders = world(3, recordings=3)
    visits = {name: np.array([[1.0, 2.0, 0.1, 0.0], [3.0, 2.0, -0.1, 0.0]]) for name in RIG.stations}
    whole = replace(calibrate(folders), bearing_map=BearingMap(0.2, visits))
    file = write_calibration(whole, tmp_path / "calibration.toml")
    parts = cross_calibrated([*folders, replace(folders[0], name="new").calibrated(whole)], file)
    assert [part.calibration.bearing_map for (part,) in parts] == [None] * 4
    assert "for the fit without its map of bearings, which has seen walk 1" in capsys.readouterr().err
    ((new,),) = cross_calibrated([replace(folders[0], name="new").calibrated(whole)], file)
    assert new.calibration.bearing_map is not None

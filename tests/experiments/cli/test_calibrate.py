"""`trackwright calibrate`, and `--calibration` of the commands that read recordings."""

import json
import tomllib
from dataclasses import replace

import pytest

from tests.in_process import PLAIN, assert_refused, trackwright
from tests.tuning.calibration_worlds import RIG, world
from trackwright.experiments.jobs.fits import cross_fitted
from trackwright.trackers.core.model.rig import Tag
from trackwright.trackers.recordings.calibration import Calibration, read_calibration, write_calibration
from trackwright.trackers.recordings.folder import read_recording, write_recording
from trackwright.trackers.recordings.input_file import identity


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


def test_the_file_and_the_page_are_written(walks):
    there, known, said = walks
    assert said.code == 0, said.err
    found = read_calibration(there / "site" / "calibration.toml")
    assert found.recordings == ("walk 0", "walk 1")
    assert set(found.stations) == set(known.stations)
    assert set(found.anchors) == set(known.anchors)
    assert {path.name for path in (there / "site").iterdir()} == {"calibration.toml", "calibration.html"}
    page = (there / "site" / "calibration.html").read_text("utf-8")
    assert page.count('"title":"') >= 2 * (2 * len(known.stations) + len(known.anchors))
    again = trackwright("calibrate", there / "0", "--out", there / "site" / "calibration.toml")
    assert_refused(again, "calibration.toml: exists", "--force replaces it")
    assert f"wrote {there / 'site' / 'calibration.toml'} and calibration.html" in said.out


@pytest.mark.slow
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
    assert f"notice: {there / '1'}: is one of the recordings of {path}; its errors are smaller than others'" in said.err


FIT = ("--tracker", "uwb", "--tune", "sensors.ranges.sigma_r", "--steps", 1, "--starts", 1)


@pytest.mark.slow
def test_a_recording_of_the_calibration_is_fitted_with_one_of_others_and_the_file_names_it(walks, tmp_path):
    there, _, _ = walks
    calibration = there / "site" / "calibration.toml"
    words = ("--calibration", calibration, *FIT, *PLAIN)
    both = trackwright("tune", there / "0", there / "1", *words, "--out", tmp_path / "both")
    assert both.code == 0, both.err
    assert f"{there / '0'}: for the fit calibrated on walk 1, instead of by the calibration given" in both.err
    assert f"{there / '1'}: for the fit calibrated on walk 0, instead of by the calibration given" in both.err
    content = tomllib.loads((tmp_path / "both" / "tuned.toml").read_text())
    assert content["calibration"] == identity(calibration)


def test_halves_of_the_only_recording_of_a_calibration_are_calibrated_on_one_another(walks):
    there, _, _ = walks
    calibration = there / "site" / "calibration.toml"
    folders = [read_recording(there / name).calibrated(read_calibration(calibration)) for name in "02"]
    ((first, second), (other,)), _ = cross_fitted(folders, read_calibration(calibration))
    assert (first.name, second.name, other.name) == ("walk 0, first half", "walk 0, second half", "walk 2")
    assert {part.calibration.range_spread for part in (first, second, other)} == {other.calibration.range_spread}
    assert first.calibration.recordings == ("walk 0, second half",)
    assert second.calibration.recordings == ("walk 0, first half",)
    assert sum(half.tables["ranges"].height for half in (first, second)) == folders[0].tables["ranges"].height
    blind = replace(folders[0], tables={k: v for k, v in folders[0].tables.items() if k != "truth"})
    ((same,),), _ = cross_fitted([blind], read_calibration(calibration))
    assert same.tables.keys() == blind.tables.keys()


@pytest.mark.slow
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

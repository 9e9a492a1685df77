"""The examples run, each in an empty folder, and find what was simulated; the gallery has their pictures."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from scipy.stats import chi2

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
LARGEST = 60_000  # bytes of a picture of the gallery

mpl.use("Agg")
pytestmark = pytest.mark.slow


@pytest.fixture
def example(tmp_path, monkeypatch):
    """Runs an example with arguments in an empty folder; the names that it leaves, when its picture is there."""

    def run(name, *arguments):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        left = runpy.run_path(str(ROOT / "examples" / f"{name}.py"))
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
        return left

    yield run
    mpl.pyplot.close("all")


def test_the_ellipse_of_a_tracked_recording_is_read_from_its_covariance(example, tmp_path):
    left = example("track_recording")
    assert left["CHI_SQUARE"] == pytest.approx(chi2.ppf(0.95, 2))
    table = left["table"]
    covs = np.zeros((len(table), 2, 2))
    covs[:, 0, 0], covs[:, 1, 1] = (table[f"std_{axis}_m"].to_numpy() ** 2 for axis in "xy")
    covs[:, 0, 1] = covs[:, 1, 0] = table["cov_xy_m2"].to_numpy()
    truth = left["recording"].tables["truth"].select("x_m", "y_m").to_numpy()
    errors = table.select("x_m", "y_m").to_numpy() - truth
    inside = np.einsum("ti,tij,tj->t", errors, np.linalg.inv(covs), errors) <= left["CHI_SQUARE"]
    assert left["metrics"]["coverage_95"] == pytest.approx(inside.mean())
    assert 0.88 < inside.mean() < 0.99
    assert "plotly" in (tmp_path / "track_recording.html").read_text("utf-8").lower()


def test_tuning_by_gradient_finds_the_noise_and_the_covariances_of_another_walk(example):
    left = example("tune_by_gradient")
    assert float(left["result"].values["sensors.ranges.sigma_r"]) == pytest.approx(0.25, rel=0.2)
    shares = {name: left["tw"].evaluate(run, left["other"])["coverage_95"] for name, run in left["runs"].items()}
    assert abs(shares["fitted levels"] - 0.95) < abs(shares["default levels"] - 0.95)


def test_the_study_tells_the_trackers_apart(example):
    left = example("monte_carlo_study", 24)
    assert left["ratio"].low > 1.2
    assert np.all(np.diff(left["middle"]) > 0)


def test_the_survey_holds_the_anchors_in_its_intervals(example):
    survey, anchors = (example("survey_anchors")[name] for name in ("survey", "ANCHORS"))
    missed = np.abs(survey.positions - anchors) > 1.5 * survey.half_widths[:, :3] + 1e-9
    assert not missed.any()
    assert all(survey.verdict(name) == "determined" for name in survey.names)


def test_the_calibration_finds_the_biases_and_helps_on_another_day(example):
    left = example("calibrate_another_day")
    for name, anchor in left["calibration"].anchors.items():
        assert abs(anchor.coefficients[0] - left["BIAS"][name]) < 3 * anchor.covariance[0, 0] ** 0.5
    before, after = (left["tw"].evaluate(run, left["last"])["rmse_m"] for run in left["runs"].values())
    assert after < 0.7 * before


def test_the_fit_of_an_own_tracker_finds_the_noise_of_its_sensors(example):
    left = example("own_sensor_and_tracker")
    values, errors = left["result"].values, left["result"].standard_errors
    for sensor, true in (("barometer", 0.5), ("beacon", 0.05)):
        name = f"sensors.{sensor}.sigma"
        assert abs(values[name] - true) < 3 * errors[name]
    assert left["error"].std() < 0.4 * left["pressure"][:, 0].std()


def test_the_planned_bound_is_that_of_cramer_and_rao_and_the_gradient_lowers_it_as_far_as_the_corners(example):
    left = example("plan_installation")
    anchors, place = left["before"], np.array([7.0, 5.0])
    away = np.append(place, left["HEIGHT"]) - anchors
    units = (away / np.linalg.norm(away, axis=1, keepdims=True))[:, :2]
    expected = left["SIGMA"] * np.sqrt(np.trace(np.linalg.inv(units.T @ units)))
    assert float(left["bound"](anchors, place)) == pytest.approx(expected, rel=1e-4)
    corners = np.array([[0, 0, 2.6], [20, 0, 0.6], [20, 12, 2.6], [0, 12, 0.6]], float)
    assert left["means"]["moved along the walls"] < 1.02 * left["over"](corners, left["places"]).mean()


def test_fastening_points_are_told_apart_from_the_spacing_on_that_the_papers_name(example):
    found = example("worksteps", 8)["found"]
    for tracker in ("direct", "cascade"):
        assert found[tracker, "named right"][0.005].value < 0.5
        assert found[tracker, "unlocked right"][0.005].value < 0.05
    for tracker in ("uwb", "uwb-imu"):
        assert found[tracker, "named right"][0.2].value > 0.85
        assert found[tracker, "unlocked wrong"][0.2].value < 0.05


def test_days_with_more_obstructions_have_larger_errors_and_innovations(example, tmp_path):
    left = example("recordings_to_pandas")
    assert left["summary"]["rmse_m"].corr(left["summary"]["nis_per_dof"], method="spearman") > 0.5
    assert (tmp_path / "days.csv").read_text("utf-8").count("\n") == 13


@pytest.mark.parametrize(
    ("name", "patterns"),
    [
        ("track_recording", ["starloc-2d-s5"]),
        ("calibrate_another_day", ["ble51-walk-u[12]-r1", "ble51-walk-u3-r2"]),
        ("recordings_to_pandas", ["ble51-walk-*"]),
    ],
)
def test_an_example_takes_real_recordings(name, patterns, example, recordings):
    left = example(name, *(path for pattern in patterns for path in sorted(recordings.glob(pattern))))
    assert left["estimates" if "estimates" in left else "runs"]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_its_picture_is_in_the_gallery(path):
    assert 40 <= len(path.read_text("utf-8").splitlines()) <= 120
    gallery = (ROOT / "docs" / "gallery.md").read_text("utf-8")
    assert f"](gallery/{path.stem}.png)" in gallery
    assert f"(../examples/{path.name})" in gallery


def test_the_pictures_of_the_gallery_are_small_and_all_shown():
    pictures = sorted((ROOT / "docs" / "gallery").glob("*.png"))
    shown = re.findall(r"\]\(gallery/([\w-]+\.png)\)", (ROOT / "docs" / "gallery.md").read_text("utf-8"))
    assert sorted(shown) == [path.name for path in pictures]
    assert max(path.stat().st_size for path in pictures) < LARGEST
    assert len(EXAMPLES) == 9

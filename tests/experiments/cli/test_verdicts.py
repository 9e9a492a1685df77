"""`tune` always writes what it found, with a verdict by left-out recordings."""

import math
import tomllib
from types import SimpleNamespace

import pytest

from tests.experiments.cli.small_archive import random_walk
from tests.in_process import assert_refused, trackwright
from trackwright.tuning.tuned_file import read_tuned

pytestmark = pytest.mark.slow
FIT = ("--tracker", "fix-kf", "--tune", "sensors.fixes.sigma_horizontal", "--starts", 1)


@pytest.fixture(scope="module")
def unlike(tmp_path_factory):
    """Three recordings, one with errors of a metre: the others' values are no good for it."""
    folder = tmp_path_factory.mktemp("walks")
    return [random_walk(folder / f"hall-{k}", k, sigma) for k, sigma in enumerate((0.03, 0.03, 1.0))]


@pytest.fixture(scope="module")
def worse(unlike, tmp_path_factory):
    """The folder of a fit to them, and what was said."""
    out = tmp_path_factory.mktemp("worse")
    return out, trackwright("tune", *unlike, *FIT, "--prior", "flat", "--out", out)


def test_values_with_which_a_left_out_recording_gets_worse_are_written_with_that_verdict(worse):
    out, said = worse
    assert said.code == 0, said.err
    written = tomllib.loads((out / "tuned.toml").read_text())
    assert written["tunables"].keys() == {"sensors.fixes.sigma_horizontal"}
    assert written["verdict"] == "worse"
    assert written["judged_by"] == "recordings tuned on, each with values fitted to the others"
    assert list(written["recordings"]) == ["hall-0", "hall-1", "hall-2"]
    hall = written["recordings"]["hall-2"]
    assert hall["log_density"]["after"] < hall["log_density"]["before"] - 1.0
    assert hall["log_density"]["high_95"] < 0
    assert (len(hall["rmse_m"]), len(hall["nees_ratio"])) == (2, 2)
    for where in (said.out, (out / "report.html").read_text("utf-8")):
        assert f"hall-2 got worse, {hall['log_density']['before']:.2f} → " in " ".join(where.split())
        assert "--steps" not in where
    assert read_tuned(out / "tuned.toml").tracker == "fix-kf"


def test_values_that_serve_every_recording_are_called_better(tmp_path):
    alike = [random_walk(tmp_path / f"walk-{k}", k, 0.3) for k in (1, 2, 3)]  # as many as above: the same programs
    said = trackwright("tune", *alike, *FIT, "--figures", "none", "--out", tmp_path / "fit")
    assert said.code == 0, said.err
    written = tomllib.loads((tmp_path / "fit" / "tuned.toml").read_text())
    assert written["verdict"] == "better"
    assert written["log_density"]["low_95"] > 0
    assert "Verdict: better. Mean log density of the true position, recordings tuned on" in said.out


def test_without_truth_nothing_is_judged(tmp_path):
    blind = [random_walk(tmp_path / f"blind-{k}", k, 0.3, truth=False) for k in (1, 2)]
    said = trackwright("tune", *blind, *FIT, "--figures", "none", "--out", tmp_path / "fit")
    assert said.code == 0, said.err
    written = tomllib.loads((tmp_path / "fit" / "tuned.toml").read_text())
    assert written["verdict"] == "not judged"
    assert "log_density" not in written
    assert math.isnan(written["recordings"]["blind-1"]["rmse_m"][0])
    assert "Verdict: not judged. No estimate has both a covariance and a truth." in said.out


def test_a_fit_that_ran_away_with_all_recordings_gives_no_numbers(tmp_path, simulated, monkeypatch):
    monkeypatch.setattr(
        "trackwright.experiments.cli.tuning.fit", lambda *rest, **options: SimpleNamespace(n_excluded=6, value=-34.5)
    )
    options = ("--tracker", "beam", "--objective", "nll", "--starts", 1)
    said = trackwright("tune", simulated, *options, "--out", tmp_path / "out")
    assert_refused(said, "nll -34.5", "no segment has finite gradients", "--bound")
    assert not list((tmp_path / "out").iterdir())

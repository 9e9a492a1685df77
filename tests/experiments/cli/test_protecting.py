"""`trackwright track --protection`: protection levels from other recordings, on the page and in `evaluate`."""

import json

import polars as pl
import pytest

from tests.in_process import assert_refused, trackwright


@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    """Three walks of a site, of which the first two are tracked."""
    there = tmp_path_factory.mktemp("site")
    for name in "012":
        made = trackwright("simulate", "ranges", "--n", 1, "--rows", 300, "--seed", name, "--out", there / name)
        assert made.code == 0, made.err
    for name in ("0", "1"):
        run = trackwright("track", there / name, "--tracker", "uwb", "--out", there / f"of-{name}", "--no-figures")
        assert run.code == 0, run.err
    return there


def _track(there, *options):
    return trackwright("track", there / "2", "--tracker", "uwb", *options, "--no-report", "-q")


def test_levels_are_a_column_a_metric_a_condition_and_a_figure(tracked, tmp_path):
    evidence = [part for name in ("0", "1") for part in ("--protection", tracked / f"of-{name}")]
    run = _track(tracked, *evidence, "--probability", 0.6, "--out", tmp_path / "out")
    assert run.code == 0, run.err
    assert "times the largest standard deviation, for 60 %; from" in run.out
    levels = pl.read_parquet(tmp_path / "out" / "tracks.parquet")["pl_m"]
    assert levels.is_finite().all()
    assert (tmp_path / "out" / "stanford.png").exists()
    found = json.loads((tmp_path / "out" / "evaluation.json").read_text("utf-8"))["overall"]
    assert found["pl_m"] == pytest.approx(levels.max())
    assert trackwright("evaluate", tmp_path / "out", "--fail-if", f"pl_m > {0.9 * levels.max()}").code == 1
    assert trackwright("evaluate", tmp_path / "out", "--fail-if", f"pl_m > {1.1 * levels.max()}").code == 0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--protection", "of-0"], ["1 recording with truth", "two at least"]),
        (["--protection", "of-0", "--protection", "of-1"], ["99.9 % takes 999 independent blocks", "at most"]),
        (["--protection", "of-0", "--smooth"], ["was tracked with smooth False, this run has True"]),
        (["--protection", "0"], ["tracks.parquet: no such file"]),
        (["--protection", "of-0", "--keep-going"], ["--protection: applies to single recordings, found an archive"]),
    ],
)
def test_evidence_that_does_not_fit_is_refused(tracked, tmp_path, options, words):
    options = [tracked / part if part[0] in "of0" else part for part in options]
    assert_refused(_track(tracked, *options, "--out", tmp_path / "out"), *words)
    assert not (tmp_path / "out").exists()


def test_evidence_that_its_own_calibration_has_seen_is_refused(tracked, tmp_path):
    assert trackwright("calibrate", tracked / "0", "--out", tmp_path / "c.toml").code == 0
    calibrated = ["--calibration", tmp_path / "c.toml"]
    run = trackwright(
        "track", tracked / "0", "--tracker", "uwb", *calibrated, "--out", tmp_path / "of-0", "--no-report"
    )
    assert run.code == 0, run.err
    refused = _track(tracked, *calibrated, "--protection", tmp_path / "of-0", "--out", tmp_path / "out")
    assert_refused(refused, "c.toml was estimated on simulated-ranges-0, which it tracked")

"""Several trackers on the same recordings, recordings of several kinds, and any number of runs in one report."""

from __future__ import annotations

import json

import numpy as np
import polars as pl
import pytest

from tests.faulty import write_good
from tests.in_process import PLAIN, trackwright


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """Two trackers of fixes on one recording, and a third run for a report; the folder and what was printed."""
    folder = tmp_path_factory.mktemp("several")
    write_good(folder / "good")
    said = trackwright(
        "track", folder / "good", "--tracker", "moving-average,median", "--figures", "png", "--out", folder / "two"
    )
    alone = trackwright("track", folder / "good", "--tracker", "fix-kf", "--out", folder / "kf", *PLAIN)
    assert said.code == alone.code == 0, (said, alone)
    return folder, said


def test_several_trackers_are_compared_in_one_table_with_paired_differences_and_one_set_of_figures(compared):
    folder, said = compared
    assert "Differences from moving-average" in said.out
    assert "adjusted for" in said.out
    rows = [line.split() for line in said.out.splitlines() if line.strip().startswith("good ")]
    assert [row[1] for row in rows] == ["moving-average", "median"]
    for name in ("moving-average", "median"):
        assert (folder / "two" / name / "evaluation.json").is_file()
        assert not list((folder / "two" / name).glob("*.png"))
    figures = {path.name for path in (folder / "two").glob("*.png")}
    assert figures == {"comparison-error-cdf.png", "comparison-coverage.png"}
    page = (folder / "two" / "comparison.html").read_text()
    moving = (folder / "two" / "report.html").read_text()
    runs = json.loads(moving.split('id="data">')[1].split("</script>")[0])["runs"]
    assert [(run["name"], run["recordings"][0]["name"]) for run in runs] == [
        ("moving-average", "good"),
        ("median", "good"),
    ]
    assert page.count('<div class="chart">') == 2
    assert "adjusted for" in page


def test_the_table_has_the_errors_of_each_run(compared):
    folder, said = compared
    for name in ("moving-average", "median"):
        row = next(line.split() for line in said.out.splitlines() if line.split()[:2] == ["good", name])
        tracks = pl.read_parquet(folder / "two" / name / "tracks.parquet").drop_nulls("x_m")
        truth = pl.read_csv(folder / "good" / "truth.csv", schema_overrides={"tag": pl.String})
        both = tracks.join(truth, on=["tag", "t_s"], suffix="_true")
        errors = both.select(both["x_m"] - both["x_m_true"], both["y_m"] - both["y_m_true"]).to_numpy()
        rmse = np.sqrt(np.mean(np.sum(errors**2, axis=1)))
        assert float(row[3]) == pytest.approx(100 * rmse, abs=0.06)


def test_any_number_of_runs_is_compared_straight_after_track(compared, tmp_path):
    folder, _ = compared
    runs = (folder / "two" / "moving-average", folder / "two" / "median", folder / "kf")
    said = trackwright("evaluate", *runs, "--out", tmp_path / "all")
    assert said.code == 0, said
    lines = [line.split() for line in said.out.splitlines() if line.strip().startswith("good ")]
    assert [line[1] for line in lines] == ["moving-average", "median", "kf"]
    assert not (tmp_path / "all" / "comparison-error-cdf.png").exists()
    contrasts = [line.split()[0] for line in said.out.splitlines() if " RMSE, " in line]
    assert contrasts == ["median", "kf"]


def test_recordings_of_two_kinds_get_the_trackers_that_fit_and_one_that_fits_none_its_own_line(tmp_path):
    for name, kept in (("fixed", "fixes"), ("ranged", "ranges"), ("moved", "imu")):
        write_good(tmp_path / name)
        rig = tmp_path / name / "rig.toml"
        rig.write_text(rig.read_text().replace('name = "good"', f'name = "{name}"').split("[path]")[0])
        for table in (tmp_path / name).glob("*.csv"):
            if table.stem not in (kept, "truth"):
                table.unlink()
    said = trackwright(
        "track", *(tmp_path / n for n in ("fixed", "ranged", "moved")), "--out", tmp_path / "out", *PLAIN
    )
    assert said.code == 3, said
    assert f"not tracked: {tmp_path / 'moved'}: no tracker fits" in said.err
    assert sorted(path.parent.name for path in (tmp_path / "out").glob("*/tracks.parquet")) == ["fix-kf", "uwb"]
    for name, recording in (("uwb", "ranged"), ("fix-kf", "fixed")):
        content = json.loads((tmp_path / "out" / name / "evaluation.json").read_text())
        assert [one["recording"] for one in content["recordings"]] == [recording]

"""Runs of `track` compared: tables, paired differences, refusals; and the counts of all reproductions."""

import json
import re
from dataclasses import replace

import pytest

from tests.experiments.pages.small_tracks import small_run
from tests.in_process import PLAIN, assert_refused, trackwright
from trackwright.experiments.lab.papers.reproduce import part
from trackwright.experiments.pages.comparison import comparison, comparison_charts, lone_subjects, read_runs
from trackwright.sim import worlds
from trackwright.trackers.recordings.folder import write_recording


def _value(value, width):
    return {"value": value, "low": value - width / 2, "high": value + width / 2}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Folders of `track`: of two trackers of positions, of bearings, and of a recording without truth."""
    there, vehicles = tmp_path_factory.mktemp("runs"), worlds.agv(n=1, seed=1, rows=60).folder()
    rig, fixes = replace(vehicles.rig, name="blind"), {"fixes": vehicles.tables["fixes"]}
    blind = replace(vehicles, name="blind", rig=rig, tables=fixes)
    for name, folder in (("agv", vehicles), ("hand", worlds.station(n=1, seed=1, rows=20).folder()), ("blind", blind)):
        write_recording(folder, there / name)
    for name, of in (("fix-kf", "agv"), ("median", "agv"), ("beam", "hand"), ("moving-average", "blind")):
        said = trackwright("track", there / of, "--tracker", name, *PLAIN, "--out", there / name)
        assert said.code == 0, said
    return there


@pytest.mark.slow
def test_the_tables_have_the_errors_of_each_run_and_one_page_is_written(runs, tmp_path):
    folders = runs / "fix-kf", runs / "median"
    found, notices = read_runs(folders)
    (table, differences), contrasts = comparison(found)
    assert (notices, lone_subjects(found)) == ([], [])
    for row, folder in zip(table.rows, folders, strict=True):
        overall = json.loads((folder / "evaluation.json").read_text())["overall"]
        assert row[1:4] == [folder.name, str(overall["n"]), f"{100 * overall['rmse_m']:.1f}"]
    assert "3-D RMSE" in table.head
    assert {one.run for one in contrasts} == {row[0] for row in differences.rows} == {"median"}
    before = sorted(runs.rglob("*"))
    said = trackwright("evaluate", *folders)
    assert sorted(runs.rglob("*")) == before
    assert "Differences from fix-kf" in said.out
    assert trackwright("evaluate", *folders, "--out", tmp_path).code == 0
    page = (tmp_path / "comparison.html").read_text()
    assert table.rows[1][3] in page
    assert "http" not in re.sub(r"<script>.*?</script>", "", page, flags=re.DOTALL)


def test_runs_differ_where_paired_differences_say_so():
    recordings = dict.fromkeys((f"hall {k}" for k in range(40)), 0.1)
    same, worse = small_run(recordings), small_run(dict.fromkeys([*recordings, "other"], 0.3))
    named = {"uwb": small_run(recordings), "same": same, "worse": worse}
    found = {(row[0], row[1]): row for row in comparison(named)[0][1].rows}
    assert found["worse", "RMSE, cm"][2:4] == ["10.0", "30.0"]
    assert (found["worse", "RMSE, cm"][-1], found["same", "RMSE, cm"][-1]) == ("yes", "no")
    assert lone_subjects(named) == ["only in worse: other"]


def test_runs_without_truth_are_compared_without_errors(runs):
    found, _ = read_runs([runs / "moving-average", runs / "fix-kf"])
    tables, contrasts = comparison(dict.fromkeys("ab", found["moving-average"]))
    assert [row[1] for row in tables[0].rows] == ["a", "b"]
    assert (len(tables), contrasts, comparison_charts({"a": found["moving-average"]})) == (1, [], [])
    assert len(comparison_charts(found)) == 2


def test_runs_that_cannot_be_compared_are_refused_in_one_line(runs, tmp_path):
    good = runs / "fix-kf"
    for other, says in (
        (runs / "beam", "runs of one kind"),
        (tmp_path, "no tracks.parquet; expected a folder of"),
        (good, "more than once"),
    ):
        assert_refused(trackwright("evaluate", good, other), says)
    refused = trackwright("evaluate", good, runs / "median", "--fail-if", "rmse_m>1")
    assert_refused(refused, "2 runs to compare; expected no option but --out")


def test_the_page_of_all_reproductions_counts_what_was_predicted_apart_from_what_is_fitted():
    names = "figure", "printed", "ours", "unit", "ratio", "compares_rest", "origin", "reached", "note"
    numbers = [
        ("Table 1", 10.0, _value(10.4, 0.2), "cm", 1.04, False, "fitted", True, ""),
        ("Table 2", 10.0, _value(14.0, 0.2), "cm", 1.4, False, "predicted", False, ""),
        ("Table 3", 5.0, _value(5.0, 0.2), "cm", 1.0, False, "derived", None, ""),
    ]
    claims = [dict(zip(names, number, strict=True)) for number in numbers]
    claims += [{"says": "B", "holds": True, "evidence": "2 against 1", "origin": "predicted"}]
    text = part({"study": "some", "about": "What?", "claims": claims, "computing_s": 12.0})
    assert "Predicted: 0 of 1 number within tolerance; 1 of 1 conclusion holds." in text
    assert "Fitted: 1 of 1 number within tolerance." in text

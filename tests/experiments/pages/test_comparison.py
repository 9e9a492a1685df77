"""Runs of `track` compared: tables, paired differences, refusals; and what is said of all reproductions."""

import json
import re

import pytest

from tests.experiments.pages.small_tracks import small_run
from trackwright.experiments.cli.options import EvaluateOptions
from trackwright.experiments.cli.track import evaluate_tracks
from trackwright.experiments.lab.papers.reproduce import evidence, part, tables
from trackwright.experiments.pages.comparison import comparison, lone_subjects, read_runs
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.evaluate import Evaluation


def _value(value, width):
    return {"value": value, "low": value - width / 2, "high": value + width / 2}


def _evaluation(folder, rmse, kind="position", **more):
    folder.mkdir()
    figures = {"rmse_m": rmse, "n": 100, "nees_mean": None} | more
    content = {"kind": kind, "overall": figures, "recordings": [{"recording": "walk", **figures}]}
    (folder / "evaluation.json").write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize(("spatial_nees", "there"), [(None, False), (1.0, True)])
def test_errors_in_3d_have_a_column_only_where_the_height_is_estimated(tmp_path, spatial_nees, there):
    more = {"rmse_3d_m": 0.2, "nees_ratio": 1.1, "nees_3d_ratio": spatial_nees}
    table = comparison(read_runs([_evaluation(tmp_path / name, 0.2, **more) for name in "ab"])[0])[0][0]
    assert ("3-D RMSE" in table.head) == there
    assert ("3-D" in table.title) == there


def test_evaluations_alone_are_compared_without_intervals_and_without_empty_columns(tmp_path):
    rmse = {"a": 0.2, "b": 0.1, "c": 0.3}
    runs, notices = read_runs([_evaluation(tmp_path / name, value) for name, value in rmse.items()])
    (table,), contrasts = comparison(runs)
    assert table.head == ("recording", "run", "n", "RMSE")
    assert table.rows == [["walk", name, "100", f"{100 * value:.1f}"] for name, value in rmse.items()]
    assert (contrasts, notices, lone_subjects(runs)) == ([], [], [])


def test_runs_differ_where_paired_differences_say_so():
    recordings = dict.fromkeys((f"hall {k}" for k in range(40)), 0.1)
    same, worse = small_run("same", recordings), small_run("worse", dict.fromkeys(recordings, 0.3))
    _, differences = comparison([small_run("uwb", recordings), same, worse])[0]
    found = {(row[0], row[1]): row for row in differences.rows}
    assert found["worse", "RMSE, m"][2:4] == ["0.100", "0.300"]
    assert (found["worse", "RMSE, m"][-1], found["same", "RMSE, m"][-1]) == ("yes", "no")
    assert Evaluation.of(worse.rows)["rmse_m"] == pytest.approx(0.3)


def test_the_command_prints_and_writes_one_page(tmp_path, capsys):
    first, second = _evaluation(tmp_path / "a", 0.10), _evaluation(tmp_path / "b", 0.12)
    before = sorted(tmp_path.rglob("*"))
    assert evaluate_tracks(first, second) == 0
    assert sorted(tmp_path.rglob("*")) == before
    assert evaluate_tracks(first, second, options=EvaluateOptions(out=tmp_path / "page")) == 0
    assert "12.0" in capsys.readouterr().out
    page = (tmp_path / "page" / "comparison.html").read_text()
    assert "12.0" in page
    assert "http" not in re.sub(r"<script>.*?</script>", "", page, flags=re.DOTALL)


def test_runs_that_cannot_be_compared_are_refused_in_one_line(tmp_path):
    good, other = _evaluation(tmp_path / "a", 0.1), _evaluation(tmp_path / "b", 0.1, "bearing")
    broken, unevaluated = tmp_path / "d", tmp_path / "e"
    broken.mkdir()
    (broken / "evaluation.json").write_text("{")
    unevaluated.mkdir()
    (unevaluated / "tracks.parquet").write_text("")
    for runs, says in (
        ((good, other), "runs of one kind"),
        ((good, broken), "JSON"),
        ((good, tmp_path), "no evaluation.json"),
        ((good, unevaluated), f"`trackwright evaluate {unevaluated}`"),
        ((good, good), "more than once"),
    ):
        with pytest.raises(UnusableInput, match=says):
            evaluate_tracks(*runs)
    with pytest.raises(UnusableInput, match="2 runs to compare; expected no option but --json and --out"):
        evaluate_tracks(good, other, options=EvaluateOptions(fail_if="rmse_m>1"))


def test_the_page_of_all_reproductions_says_what_is_fitted_and_what_was_not_reached():
    claims = [
        {"figure": "Table 1", "printed": 10.0, "ours": _value(10.4, 0.2), "unit": "cm", "ratio": 1.04,
         "compares_rest": False, "origin": "fitted", "reached": True, "note": ""},
        {"figure": "Table 2", "printed": 10.0, "ours": _value(14.0, 0.2), "unit": "cm", "ratio": 1.4,
         "compares_rest": False, "origin": "predicted", "reached": False, "note": "The nearest is this."},
        {"figure": "Table 3", "printed": 98.3, "ours": _value(93.7, 0.2), "unit": "%", "ratio": 3.71,
         "compares_rest": True, "origin": "predicted", "reached": False, "note": ""},
        {"figure": "Table 4", "printed": 5.0, "ours": _value(5.0, 0.2), "unit": "cm", "ratio": 1.0,
         "compares_rest": False, "origin": "derived", "reached": None, "note": ""},
        {"says": "A is better", "holds": False, "evidence": "1 against 2", "origin": "derived"},
        {"says": "B is better", "holds": True, "evidence": "2 against 1", "origin": "predicted"},
    ]  # fmt: skip
    text = part({"study": "some", "about": "What?", "claims": claims, "computing_s": 12.0})
    assert "| Table 1 | 10 cm | 10.40 (10.30 … 10.50) | 1.04 | fitted | yes |" in text
    assert "| 1.40 | predicted | **no** |" in text
    assert "| 3.71 (rest) | predicted | **no** |" in text
    assert "| 1.00 | derived |  |" in text
    counts = "Predicted: 0 of 2 numbers within tolerance; 1 of 1 conclusion holds. "
    counts += "Derived, not counted: 1 number, 1 conclusion. Fitted: 1 of 1 number within tolerance."
    assert f"**{counts}**" in text
    assert tables([{"study": "some", "about": "What?", "claims": claims, "computing_s": 12.0}], 12.0).count(counts) == 2
    assert "**Does not hold** (*derived*): A is better." in text
    assert "Holds (*predicted*): B is better." in text
    rows = evidence([{"study": "some", "claims": claims}])
    assert rows["evidence"].to_list() == ["", "The nearest is this.", "", "", "1 against 2", "2 against 1"]

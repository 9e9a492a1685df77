import json
import re

import numpy as np
import pytest

from trackwright.experiments.cli.options import EvaluateOptions
from trackwright.experiments.cli.track import evaluate_tracks
from trackwright.experiments.lab.papers.reproduce import evidence, part, tables
from trackwright.experiments.pages.reports.comparison import Run, comparison, read_runs
from trackwright.experiments.text.expectations import Value
from trackwright.trackers.core.errors import UnusableInput


def _value(value, width):
    return {"value": value, "low": value - width / 2, "high": value + width / 2}


def _study(folder, rmse, width=0.02, tracker="direct", metric="rmse_m"):
    folder.mkdir()
    cell = {"world": "hand", "point": {"world.sigma_p": 0.1}, "tracker": tracker}
    other = {"nees_ratio": _value(2.0, 0.1)} if metric == "rmse_m" else {}
    content = {"cells": [cell | {"figures": {metric: _value(rmse, width)} | other}]}
    (folder / "results.json").write_text(json.dumps(content))
    return folder


def _evaluation(folder, rmse, **more):
    folder.mkdir()
    figures = {"rmse_m": rmse, "n": 100, "nees_mean": None} | more
    content = {"overall": figures, "recordings": [{"recording": "walk", **figures}]}
    (folder / "evaluation.json").write_text(json.dumps(content))
    return folder


def _contrasts(*folders):
    runs, _ = read_runs(folders)
    return {(one.run, one.metric): one for one in comparison(runs)[1]}


@pytest.mark.parametrize(("spatial_nees", "there"), [(None, False), (1.0, True)])
def test_errors_in_3d_have_a_column_only_where_the_height_is_estimated(tmp_path, spatial_nees, there):
    more = {"rmse_3d_m": 0.2, "nees_ratio": 1.1, "nees_3d_ratio": spatial_nees}
    table = comparison(read_runs([_evaluation(tmp_path / name, 0.2, **more) for name in "ab"])[0])[0][0]
    assert ("3-D RMSE" in table.head) == there
    assert ("3-D" in table.title) == there


def test_two_studies_differ_where_the_difference_is_larger_than_both_intervals_allow(tmp_path):
    found = _contrasts(_study(tmp_path / "a", 0.10), _study(tmp_path / "b", 0.12))
    assert found["b", "rmse_m"].difference.value == pytest.approx(0.02)
    assert found["b", "rmse_m"].differs is True
    assert found["b", "nees_ratio"].differs is False
    assert found["b", "rmse_m"].subject == "hand, sigma_p 0.1, direct"


def test_studies_without_a_difference_differ_in_5_percent_of_tables(tmp_path):
    """Half widths of 1.96 sigma of normal values without a difference: of one metric, then of twenty with Holm."""
    rng = np.random.default_rng(1)

    def share(metrics, tables):
        differ = 0
        for _ in range(tables):
            runs = [
                Run(name, tmp_path, {("world", f"m{k}"): Value(x, x - 1.96, x + 1.96) for k, x in enumerate(values)})
                for name, values in zip("ab", rng.normal(size=(2, metrics)), strict=True)
            ]
            differ += any(one.differs for one in comparison(runs)[1])
        return differ / tables

    assert 0.03 < share(1, 3000) < 0.07
    assert share(20, 500) < 0.08


def test_evaluations_alone_are_compared_without_intervals_and_without_empty_columns(tmp_path):
    runs, notices = read_runs(
        [_evaluation(tmp_path / name, rmse) for name, rmse in (("a", 0.2), ("b", 0.1), ("c", 0.3))]
    )
    (table,), contrasts = comparison(runs)
    assert table.head == ("recording", "run", "n", "RMSE")
    assert table.rows == [["walk", "a", "100", "20.0"], ["walk", "b", "100", "10.0"], ["walk", "c", "100", "30.0"]]
    assert contrasts == []
    assert notices == []


def test_the_command_prints_both_and_writes_one_page(tmp_path, capsys):
    first, second = _study(tmp_path / "a", 0.10), _study(tmp_path / "b", 0.12)
    assert evaluate_tracks(first, second, options=EvaluateOptions(out=tmp_path / "page")) == 0
    printed = capsys.readouterr().out
    assert "10.0 (9.0 … 11.0)" in printed
    assert "12.0 (11.0 … 13.0)" in printed
    page = (tmp_path / "page" / "comparison.html").read_text()
    assert "1.200" in page
    assert "http" not in re.sub(r"<script>.*?</script>", "", page, flags=re.DOTALL)
    assert not re.search(r"<script[^>]+src", page)


def test_of_three_studies_each_is_compared_with_the_first(tmp_path):
    folders = [_study(tmp_path / name, rmse) for name, rmse in (("a", 0.10), ("b", 0.101), ("c", 0.15))]
    tables, _ = comparison(read_runs(folders)[0])
    rows = [row for row in tables[0].rows if row[1].startswith("RMSE")]
    assert [(row[2], *row[-2:]) for row in rows] == [("b", "1.010", "no"), ("c", "1.500", "yes")]


def test_runs_that_cannot_be_compared_are_refused_in_one_line(tmp_path):
    study, evaluation = _study(tmp_path / "a", 0.1), _evaluation(tmp_path / "b", 0.1)
    other, broken, unevaluated = _study(tmp_path / "c", 0.1, tracker="beam"), tmp_path / "d", tmp_path / "e"
    broken.mkdir()
    (broken / "results.json").write_text("{")
    unevaluated.mkdir()
    (unevaluated / "tracks.parquet").write_text("")
    for runs, says in (
        ((study, evaluation), "runs of one kind"),
        ((study, other), "in common"),
        ((study, broken), "JSON"),
        ((study, tmp_path), "no results.json"),
        ((evaluation, unevaluated), f"`trackwright evaluate {unevaluated}`"),
        ((study, study), "more than once"),
    ):
        with pytest.raises(UnusableInput, match=says):
            evaluate_tracks(*runs)
    with pytest.raises(UnusableInput, match="2 runs to compare; expected no option but --out"):
        evaluate_tracks(study, other, options=EvaluateOptions(fail_if="rmse_m>1"))


def test_without_an_output_folder_a_comparison_writes_nothing(tmp_path, capsys):
    folders = [_study(tmp_path / name, 0.1) for name in "ab"]
    before = sorted(tmp_path.rglob("*"))
    assert evaluate_tracks(*folders) == 0
    assert "RMSE" in capsys.readouterr().out
    assert sorted(tmp_path.rglob("*")) == before


def test_studies_with_metrics_of_their_own_alone_are_compared_by_these(tmp_path):
    folders = [_study(tmp_path / name, speed, metric="speed") for name, speed in (("a", 0.1), ("b", 0.2))]
    assert list(_contrasts(*folders)) == [("b", "speed")]


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
    counts = (
        "Predicted: 0 of 2 numbers within tolerance; 1 of 1 conclusion holds. Derived, not counted: 1 number, 1 conclusion. "
        "Fitted: 1 of 1 number within tolerance."
    )
    assert f"**{counts}**" in text
    assert tables([{"study": "some", "about": "What?", "claims": claims, "computing_s": 12.0}], 12.0).count(counts) == 2
    assert "**Does not hold** (*derived*): A is better." in text
    assert "Holds (*predicted*): B is better." in text
    rows = evidence([{"study": "some", "claims": claims}])
    assert rows["evidence"].to_list() == ["", "The nearest is this.", "", "", "1 against 2", "2 against 1"]

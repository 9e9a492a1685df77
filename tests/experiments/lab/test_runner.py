"""The runner of the laboratory: a row a case, resumed where it stopped, and a failing case beside the others."""

import pytest

from trackwright.experiments.lab.__main__ import lab
from trackwright.experiments.lab.runner import EVIDENCE, Case, measure, read
from trackwright.trackers.core.errors import UnusableInput


def _case(name, calls, value=1.0):
    def run():
        calls.append(name)
        if isinstance(value, Exception):
            raise value
        return {"rmse_m": value, "nees_per_dof": None}

    return Case(name, "uwb", "defaults", run)


def test_a_row_has_the_key_and_the_figures_with_six_digits(tmp_path):
    file = tmp_path / "new" / "table.csv"
    assert measure([_case("hall", [], 0.123456789)], file) == 0
    assert (
        file.read_text() == "recording,tracker,setting,seed,rmse_m,nees_per_dof,error\nhall,uwb,defaults,0,0.123457,,\n"
    )


def test_a_second_run_measures_what_is_missing_alone_and_keeps_the_order_of_the_cases(tmp_path):
    calls, file = [], tmp_path / "table.csv"
    measure([_case("b", calls), _case("c", calls)], file)
    measure([_case("a", calls), _case("b", calls), _case("c", calls)], file)
    assert calls == ["b", "c", "a"]
    assert [row["recording"] for row in read(file)] == ["a", "b", "c"]


def test_a_failing_case_leaves_its_error_stops_no_other_and_is_tried_again(tmp_path):
    calls, file = [], tmp_path / "table.csv"
    cases = [_case("broken", calls, ValueError("no\nanchor")), _case("hall", calls)]
    assert measure(cases, file) == 1
    assert [(row["error"], row["rmse_m"]) for row in read(file)] == [("ValueError: no anchor", ""), ("", "1")]
    assert measure([_case("broken", calls), cases[1]], file) == 0
    assert calls == ["broken", "hall", "broken"]
    assert [row["error"] for row in read(file)] == ["", ""]


def test_a_pattern_chooses_cases_and_rows_of_others_stay(tmp_path):
    calls, file = [], tmp_path / "table.csv"
    cases = [_case(name, calls) for name in ("hall-1", "hall-2", "yard")]
    measure(cases, file, only="hall-* / uwb")
    measure(cases, file, only="yard")
    assert [row["recording"] for row in read(file)] == calls == ["hall-1", "hall-2", "yard"]


def test_rows_that_no_case_names_any_more_go_and_are_counted(tmp_path):
    said, file = [], tmp_path / "table.csv"
    measure([_case("old", []), _case("hall", [])], file)
    measure([_case("hall", [])], file, report=said.append)
    assert [row["recording"] for row in read(file)] == ["hall"]
    assert said == ["table.csv: 1 rows are of no case any more and were left out"]


@pytest.mark.parametrize(
    ("cases", "only", "message"),
    [
        ([_case("hall", []), _case("hall", [])], "", "2 cases are called hall / uwb / defaults"),
        ([_case("hall", [])], "yard", "--only yard: no case matches; the first are hall / uwb / defaults"),
    ],
)
def test_unusable_lists_of_cases_are_refused(tmp_path, cases, only, message):
    with pytest.raises(UnusableInput, match=message):
        measure(cases, tmp_path / "table.csv", only)


def test_an_unknown_table_is_refused_with_the_nearest_name():
    with pytest.raises(UnusableInput, match="table studis: unknown.*studies"):
        lab("studis")


def test_kept_tables_have_no_errors():
    files = sorted(EVIDENCE.glob("*.csv"))
    assert files
    assert [file.name for file in files if any(row.get("error") for row in read(file))] == []

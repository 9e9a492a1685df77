"""When a number counts as reached, by its tolerance, its origin and whether it is a share; and what conclusions inherit."""

import pytest

from trackwright.experiments.monte_carlo import DERIVED, FITTED, PREDICTED, ExpectedResult, Value
from trackwright.experiments.pages.reports.study_text import expected_sections
from trackwright.experiments.text.expectations import headline


def _result(printed, ours, origin=PREDICTED, **more):
    return ExpectedResult("Table 1", printed, Value(ours, ours, ours), "%", origin, **more)


@pytest.mark.parametrize(
    ("printed", "ours", "ratio", "reached"),
    [
        # 6.3 % of the errors exceed 10 cm, where 1.7 % are printed to.
        (98.3, 93.7, 6.3 / 1.7, False),
        (71.6, 66.38, 33.62 / 28.4, False),
        (98.3, 98.2, 1.8 / 1.7, True),
        # A small share is compared as it is: its rest would hide everything.
        (5.0, 8.0, 1.6, False),
        (5.0, 5.4, 1.08, True),
    ],
)
def test_a_share_is_compared_by_the_smaller_of_it_and_its_rest(printed, ours, ratio, reached):
    result = _result(printed, ours, share=True)
    assert result.ratio == pytest.approx(ratio)
    assert result.reached is reached


def test_a_number_that_is_no_share_is_compared_as_it_is():
    assert _result(98.3, 93.7).ratio == pytest.approx(93.7 / 98.3)
    assert _result(98.3, 93.7).reached
    assert not _result(98.3, 80.0).reached


def test_a_derived_number_and_one_without_tolerance_are_not_judged():
    assert _result(10.0, 10.0, DERIVED).reached is None
    assert _result(10.0, 10.0, FITTED, within=None).reached is None
    assert _result(10.0, 10.0, FITTED).reached


def test_the_headline_counts_what_was_free_and_nothing_that_follows_from_it():
    numbers = [("predicted", True), ("predicted", False), ("predicted", None), ("fitted", True), ("derived", None)]
    conclusions = [("predicted", True), ("derived", True), ("derived", False), ("fitted", True)]
    assert headline(numbers, conclusions) == (
        "Predicted: 1 of 2 numbers within tolerance; 1 of 1 conclusion holds. "
        "Derived, not counted: 1 number, 2 conclusions. "
        "Fitted: 1 of 1 number within tolerance; 1 of 1 conclusion holds."
    )
    assert headline([("fitted", True)], []) == "Predicted: nothing. Fitted: 1 of 1 number within tolerance."


@pytest.mark.parametrize("note", ["", "why it is not reached"])
def test_the_table_of_printed_numbers_has_a_column_of_remarks_where_there_is_one(note):
    table, _ = expected_sections([_result(98.3, 93.7), _result(98.3, 80.0, note=note)])
    assert list(table.head) == [
        "result", "printed", "ours (95 % interval)", "ours / printed", "origin", "within tolerance",
        *(["remark"] if note else []),
    ]  # fmt: skip
    assert [row[5:] for row in table.rows] == ([["yes", ""], ["no", note]] if note else [["yes"], ["no"]])
    assert len(table.classes) == len(table.head)

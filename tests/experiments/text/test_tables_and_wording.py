"""Numbers, units and tables as text."""

import numpy as np

from trackwright.experiments.text.evaluation_text import cells
from trackwright.experiments.text.expectations import Value, with_interval
from trackwright.experiments.text.tables import compact_table, markdown, rendered, ruled_table
from trackwright.experiments.text.wording import Unit, rounded, unit_of, units_of
from trackwright.trackers.core.wording import significant
from trackwright.trackers.evaluation.metrics import METRICS

MM = Unit("mm", 1.0)


def test_a_table_in_markdown_has_its_head_and_a_rule_that_aligns_numbers():
    rows = [("name", "m"), ("a", "1.5"), ("b", "")]
    assert markdown(rows, numbers=[1]) == "| name | m |\n| --- | ---: |\n| a | 1.5 |\n| b |  |\n"


def test_cells_are_text_and_never_markup():
    table = compact_table("title", ["[red]label[/red]"], ["n"])
    table.add_row("[bold]x", "1")
    text = rendered(80, table, ruled_table("[i]", ["a", "b"], 1, [["[/]", "2"]]))
    for part in ("[red]label[/red]", "[bold]x", "[/]", "[i]"):
        assert part in text
    assert all(line == line.rstrip() for line in text.splitlines())


def test_digits_follow_the_spread():
    assert rounded(1.23456, 0.02) == "1.235"
    assert rounded(123.456, 20.0) == "123"
    assert rounded(0.0, 1.0) == "0"
    assert rounded(np.nan, 1.0) == "–"
    assert with_interval(Value(0.1234, 0.1204, 0.1264), unit_of("rmse_m", [0.1234])) == "12.34 (12.04 … 12.64)"
    assert with_interval(Value(0.1234, np.nan, np.nan)) == "0.123"


def test_lengths_side_by_side_have_one_unit():
    units = units_of({"rmse_m": [0.2], "max_m": [5.0], "coverage_95": [0.9], "rmse_direction_rad": [0.1]})
    assert [units[k].name for k in units] == ["cm", "cm", "%", "°"]


def test_a_variance_is_in_the_square_of_the_unit_of_its_table():
    variance = METRICS["variance_m2"]
    assert [*cells({"variance_m2": 0.0168}, [variance], Unit("cm", 100.0))] == ["168.0"]
    assert [*cells({"variance_m2": 0.0168}, [variance], Unit("m", 1.0))] == ["0.017"]


def test_large_numbers_are_written_without_powers_of_ten():
    assert [significant(x, 2) for x in (1000.0, 1234.5, 180.0, 12.34, 0.00012, -0.5)] == [
        "1,000", "1,200", "180", "12", "0.00012", "-0.5",
    ]  # fmt: skip
    assert significant(float("inf"), 2) == "inf"
    shown = [text for x in (748121.37, 9999.0, 1.005, None) for text in cells({"max_m": x}, [METRICS["max_m"]], MM)]
    assert shown == ["748,121", "9999.00", "1.00", "–"]

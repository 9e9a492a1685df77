"""Numbers, units and tables as text, evaluations, and when a printed number counts as reached."""

from dataclasses import replace

import numpy as np
import pytest

import trackwright as tw
from trackwright.experiments.text import tables
from trackwright.experiments.text.expectations import PREDICTED, ExpectedResult, Value, with_interval
from trackwright.experiments.text.tables import Section, Unit, archive_text, cells, markdown, rounded, sections_text
from trackwright.trackers.evaluation.metrics import METRICS

MM = Unit("mm", 1.0)


def test_cells_are_text_and_never_markup():
    table = Section("[i]", ["[red]label[/red]", "n"], [["[bold]x", "[/]"]], note="[b]")
    text = sections_text([table, table], 80, "last")
    assert all(part in text for part in ("[red]label[/red]", "[bold]x", "[/]", "[i]", "[b]", "last"))
    assert all(line == line.rstrip() for line in text.splitlines())
    assert markdown([("name", "m"), ("a", "1.5")]) == "| name | m |\n| --- | --- |\n| a | 1.5 |\n"


def test_digits_follow_the_spread():
    assert [rounded(1.23456, 0.02), rounded(123.456, 20.0), rounded(0.0, 1.0), rounded(np.nan, 1.0)] == [
        "1.235", "123", "0", "–",
    ]  # fmt: skip
    assert with_interval(Value(0.1234, 0.1204, 0.1264), tables.unit_of("rmse_m", [0.1234])) == "12.34 (12.04 … 12.64)"
    assert with_interval(Value(0.1234, np.nan, np.nan)) == "0.123"


def test_large_numbers_are_written_without_powers_of_ten():
    shown = [text for x in (748121.37, 9999.0, 1.005, None) for text in cells({"max_m": x}, [METRICS["max_m"]], MM)]
    assert shown == ["748,121", "9999.00", "1.00", "–"]


def test_the_medians_of_an_archive_are_of_the_recordings_with_truth():
    folders = [replace(tw.simulate.agv(1, k, rows=60).folder(), name=f"hall {k}") for k in range(3)]
    tracks = tw.build("fix-kf", folders).run(folders)
    text = archive_text(tw.evaluate(tracks.table, folders[:1]))
    assert "median of 1" in text
    assert "hall 0" in text
    assert "hall 1" not in text


@pytest.mark.parametrize(
    ("printed", "ours", "ratio", "reached"),
    [
        # 6.3 % of the errors exceed 10 cm, where 1.7 % are printed to.
        (98.3, 93.7, 6.3 / 1.7, False),
        (98.3, 98.2, 1.8 / 1.7, True),
        # A small share is compared as it is: its rest would hide everything.
        (5.0, 8.0, 1.6, False),
        (5.0, 5.4, 1.08, True),
    ],
)
def test_a_share_is_compared_by_the_smaller_of_it_and_its_rest(printed, ours, ratio, reached):
    result = ExpectedResult("Table 1", printed, Value(ours, ours, ours), "%", PREDICTED, share=True)
    assert result.ratio == pytest.approx(ratio)
    assert result.reached is reached

"""The errors before and after a calibration, as its report counts them."""

import base64
import re

import numpy as np

from tests.experiments.pages.charts.small_runs import chart_data
from trackwright.experiments.pages.charts.calibration import Panel, floor_charts, reading_chart
from trackwright.experiments.pages.reports.calibration import SECTIONS, Report, Source
from trackwright.tuning.calibration_pairs import Pairs


def test_a_short_recording_counts_as_much_as_a_long_one_in_the_spread_of_errors():
    errors = np.array([0.1, -1.0, -0.3, 0.2, np.nan, 0.4])
    number = np.array([0, 1, 0, 0, 0, 0])
    values, none = np.zeros((6, 1)), np.zeros(6, int)
    source = Source("1", "range", 0, Pairs(values, values, np.zeros((6, 3)), number, *[none] * 6))
    # Half of the weight is that of the one row of 1 m: it holds the percentiles above the 50th.
    assert source.spread(errors) == 1.0
    assert source.spread(np.where(number == 0, errors, np.nan)) == 0.3
    assert np.isnan(source.spread(np.full(6, np.nan)))


def test_every_reading_but_the_wildest_lies_inside_its_chart():
    true, error = np.linspace(1.0, 9.0, 400), np.linspace(-0.3, 0.5, 400)
    at, none = true[::100], np.zeros(4)
    panel = Panel("A", "range", False, true, true + error, true + error / 5, np.zeros((400, 2)), at, at, none)
    low, high = chart_data(reading_chart(panel, "anchors").address)["layout"]["yaxis"]["range"]
    assert -0.5 < low < -0.3
    assert 0.5 < high < 0.7


def test_a_floor_that_is_wide_is_drawn_low():
    def height(width, depth):
        positions = np.random.default_rng(0).uniform(0.0, [width, depth], (200, 2))
        none = np.zeros(2)
        panel = Panel("A", "range", False, *np.tile(positions[:, 0], (3, 1)), positions, none, none, none)
        (chart,) = floor_charts([panel], "anchors")
        drawn = base64.b64decode(chart.address.partition(",")[2]).decode()
        return float(re.search(r'height="([\d.]+)pt"', drawn)[1])

    assert height(12.0, 6.0) < height(6.0, 6.0) < height(6.0, 8.0)


def test_columns_of_text_are_names_and_the_others_numbers():
    for section in SECTIONS.values():
        names, numbers = set(section.head[: section.n_text]), set(section.head[section.n_text :])
        assert names <= {"station", "angle", "anchor", "tag", "source", "quantity"}, section.head
        assert not {"angle", "quantity"} & numbers


def test_the_note_explains_the_marks_of_the_tables_that_have_rows():
    row = ["A", "0.100 ± 0.010", "(0.001 ± 0.010)", "600", "11 cm", "5 cm", "–"]
    note = Report(
        {"anchors": SECTIONS["anchors"]._replace(head=SECTIONS["anchors"].head[:-1], rows=[row[:-1]])}, [], [], ""
    ).note
    assert note.startswith("± standard error. In brackets: ")
    assert "As measured" in note
    assert "Left out" not in note
    assert "Errors that last" not in note

"""The order of trackers by their errors on recordings, and that the catalogue has the order of the page."""

import importlib

import numpy as np
import pytest

from trackwright.experiments.lab.cases import Output
from trackwright.experiments.lab.subprocesses import REPOSITORY
from trackwright.experiments.lab.validation.choice import (
    SIMPLEST_FIRST,
    Figure,
    beside,
    choice,
    order_of,
    tables,
)
from trackwright.experiments.lab.validation.sites import SEEN_BY_DEFAULTS
from trackwright.trackers.catalogue import ENTRIES, PREFERENCE, TRACKERS
from trackwright.trackers.recordings.folder import read_recordings

PAGE = REPOSITORY / "docs" / "which-tracker.md"
RANGES = ("multilateration", "uwb", "uwb-imu")


def _figures(errors, fitted=(), share=()):
    """Figures of errors (recordings, trackers of RANGES); `fitted`, `share`: exceptions by recording and tracker."""
    return [
        Figure(f"r{i}", name, error, 0.95, dict(share).get((i, name), 1.0), (i, name) in fitted)
        for i, row in enumerate(errors)
        for name, error in zip(RANGES, row, strict=True)
    ]


def test_the_best_tracker_is_first_and_of_equals_the_simpler_one():
    assert order_of(_figures([[0.3, 0.1, 0.2], [0.6, 0.2, 0.3]]), RANGES) == ("uwb", "uwb-imu", "multilateration")
    # 4 % apart, and 4 % the other way round.
    for errors in ([[0.3, 0.1, 0.096]], [[0.3, 0.096, 0.1]]):
        assert order_of(_figures(errors), RANGES)[:2] == ("uwb", "uwb-imu")
    assert order_of(_figures([[0.3, 0.1, 0.09]]), RANGES)[0] == "uwb-imu"


def test_errors_are_compared_by_the_geometric_mean_of_their_ratios():
    figures = _figures([[0.3, 0.2, 0.1], [0.3, 0.1, 0.05], [0.3, 0.1, 0.4]])
    ratio, names = beside(figures, "uwb", "uwb-imu")
    assert ratio == pytest.approx(np.cbrt(2.0 * 2.0 * 0.25))
    assert names == ("r0", "r1", "r2")
    assert beside(figures, "uwb-imu", "uwb")[0] == pytest.approx(1.0 / ratio)


def test_a_recording_decides_neither_where_levels_were_fitted_on_it_nor_where_estimates_are_missing():
    errors = [[0.3, 0.2, 0.1], [0.3, 0.1, 0.2]]
    assert order_of(_figures(errors, fitted={(1, "uwb")}), RANGES)[0] == "uwb-imu"
    assert order_of(_figures(errors, share={(0, "uwb-imu"): 0.8}.items()), RANGES)[0] == "uwb"
    nothing = _figures(errors, fitted={(0, "uwb"), (1, "uwb-imu")})
    assert beside(nothing, "uwb", "uwb-imu") == (1.0, ())
    assert order_of(nothing, RANGES)[:2] == ("uwb", "uwb-imu")


def test_trackers_that_beat_each_other_in_a_circle_are_ordered_all_the_same():
    rows = [[0.1, 0.2, np.nan], [np.nan, 0.1, 0.2], [0.2, np.nan, 0.1]]
    circle = [one for one in _figures(rows) if np.isfinite(one.rmse)]
    assert order_of(circle, RANGES) == RANGES


def test_the_tables_mark_what_was_fitted_and_what_was_not_estimated():
    figures = _figures([[0.3, 0.1, 0.2]], fitted={(0, "uwb")}, share={(0, "multilateration"): 0.76}.items())
    array = Figure("array", "beam", np.radians(5.0), None, 1.0, False)
    phases, _, ranges, others = tables([*figures, array])
    first = "Order: `multilateration`, `uwb`, `uwb-imu`, `trilateration`, `trilateration-compensated`, "
    assert ranges.note == first + "`body`."
    cells = ("30.0 cm, 95 % (76 % of the rows)", "10.0 cm, 95 %*", "20.0 cm, 95 %", "", "", "")
    assert tuple(ranges.rows[0].values()) == ("r0", *cells)
    assert others.rows[0] == {
        "beside": "`uwb`",
        "ratio of errors": "",
        "recordings that decide": "none: the simpler one",
    }
    assert tuple(phases.rows[0].values()) == ("array", "5.0°", "")


def test_the_page_has_the_order_of_the_catalogue():
    lines = PAGE.read_text("utf-8").splitlines()
    found = {}
    for k, line in enumerate(lines):
        if line.startswith("Order: "):
            heading = next(h for h in reversed(lines[:k]) if h.startswith("### "))
            found[heading.removeprefix("### ").lower()] = tuple(line.split("`")[1::2])
    assert len(found) == 6
    assert found == {kind: tuple(names) for kind, names in PREFERENCE.items() if kind in found}


def test_every_tracker_of_the_catalogue_has_one_place_in_the_order():
    entries = [
        name
        for system in {entry.system for entry in ENTRIES.values()}
        for name in importlib.import_module(f"trackwright.trackers.{system}.rows").TRACKERS
    ]
    assert sorted(TRACKERS) == sorted(entries) == sorted(SIMPLEST_FIRST)
    assert set(SEEN_BY_DEFAULTS) <= set(TRACKERS)


@pytest.mark.slow
def test_the_order_of_the_catalogue_is_that_of_the_recordings(recordings, tmp_path, monkeypatch):
    monkeypatch.setenv("TRACKWRIGHT_RECORDINGS", str(recordings))
    assert read_recordings([path.parent for path in sorted(recordings.glob("*/rig.toml"))])
    page = tmp_path / "page.md"
    page.write_text(
        "<!-- tables of trackwright.experiments.lab.validation choice -->\n<!-- end of the tables -->\n", "utf-8"
    )
    assert choice(output=Output(page=page, out=tmp_path / "choice.json")) == 0
    assert page.read_text("utf-8").count("Order: ") == 5

"""Mistakes in range differences are named, with truth and, by contradictions of a moment, without."""

from __future__ import annotations

from dataclasses import replace

import polars as pl
import pytest

from tests.trackers.recordings.checks.made import differences, only, with_anchors, with_columns
from trackwright.trackers.core.model.rig import Tag
from trackwright.trackers.recordings.checks.all_checks import check
from trackwright.trackers.recordings.checks.compared import compared
from trackwright.trackers.recordings.checks.residuals import residuals
from trackwright.trackers.recordings.checks.sampling import anomalies
from trackwright.trackers.recordings.folder import read_recording

FOLDER = differences()
VALUE = pl.col("range_difference_m")


def _late(**by):
    """What signals that are late at some anchors, by lengths, m, add to the differences."""
    first, second = (
        pl.col(column).cast(pl.String).replace_strict(by, default=0.0) for column in ("anchor", "anchor_2")
    )
    return first - second


def _errors(folder):
    return [result.message for result in check(folder) if result.level == "error"]


@pytest.mark.parametrize("schedule", ["messages", "turns"])
def test_biases_are_those_of_anchors_whichever_is_the_first(schedule):
    """All from A1, or those of neighbours alone; the median of the biases is zero, as none of theirs is seen."""
    late = {"A1": 0.3, "A3": -0.4, "A4": 0.1, "A7": 0.2, "A8": -0.1}
    folder = differences(schedule)
    table = folder.tables["tdoa"].with_columns(VALUE + _late(**late))
    view = compared(replace(folder, tables=folder.tables | {"tdoa": table}), "tdoa")
    found = {one.group: one.bias for one in residuals(view)}
    assert found == pytest.approx({anchor: late.get(anchor, 0.0) for anchor in folder.rig.anchors}, abs=0.03)


def test_gaps_are_those_of_the_tag_whichever_anchors_it_hears():
    pair = pl.struct("anchor", "anchor_2").rank("dense")
    in_turn = FOLDER.tables["tdoa"].filter(pair % 3 == (pl.col("t_s") // 2) % 3)
    notices = anomalies({"tdoa": in_turn}, FOLDER.rig)
    assert not [notice for notice in notices if "gaps" in notice], notices
    late = in_turn.with_columns(pl.when(pl.col("t_s") > 10).then(pl.col("t_s") + 7).otherwise("t_s"))
    (notice,) = [notice for notice in anomalies({"tdoa": late}, FOLDER.rig) if "gaps" in notice]
    assert notice.startswith("tdoa: gaps longer than 1 s: 1, the longest 7.1 s before t_s 17.1 (tag ")


X = pl.col("x_m")
ON_FLIGHTS = {
    "the sign": (with_columns("tdoa", range_difference_m=-VALUE), "with the wrong sign", "with the wrong sign"),
    "nanoseconds": (with_columns("tdoa", range_difference_m=VALUE / 0.2998), "are nanoseconds", "are nanoseconds"),
    "centimetres": (with_columns("tdoa", range_difference_m=VALUE * 100), "centimetres", "centimetres"),
    "two anchors swapped": (
        with_anchors(lambda a: {"1": a["6"], "6": a["1"]}), "of anchors 1, 6 are", "anchors 1 and 6 swapped",
    ),
    "one anchor twice": (with_anchors(lambda a: {"3": a["2"]}), "of anchor 3 (at (3.", "have the same position"),
    "an anchor moved": (with_anchors(lambda a: {"5": a["5"] + [1.5, -1, 0]}), "of anchor 5 (", "without anchor 5"),
    "x of an anchor": (with_anchors(lambda a: {"6": a["6"] * [-1, 1, 1]}), "of anchor 6 (at (3.", "without anchor 6"),
    "a late anchor": (with_columns("tdoa", range_difference_m=VALUE + _late(**{"2": 2.0})), "of anchor 2 (+", "without anchor 2"),
    "a late clock": (with_columns("truth", t_s=pl.col("t_s") - 5), "5.0", None),
    "x and y of the truth": (with_columns("truth", x_m=pl.col("y_m"), y_m=X), "x and y of the truth swapped", None),
    "the truth's place": (with_columns("truth", x_m=X + 2), "the truth shifted by (-2.0", None),
}  # fmt: skip
"""Mistakes, and words of the messages that name them with truth and without, where that can be seen."""


@pytest.mark.slow
@pytest.mark.parametrize("flight", ["util-c1-t1-tdoa2", "util-c1-t1-tdoa3", "util-c4-t5-tdoa2"])
def test_mistakes_on_real_flights_are_named(flights, flight):
    good = read_recording(flights / flight)
    assert _errors(good) == _errors(only("tdoa")(good)) == []
    for name, (make, *words) in ON_FLIGHTS.items():
        made = make(good)
        for folder, word in zip((made, only("tdoa")(made)), words, strict=True):
            messages = [result.message for result in check(folder) if result.level != "info"]
            assert word is None or any(word in message for message in messages), (name, messages)


@pytest.mark.parametrize(("height", "least"), [(None, 5), (1.0, 4)])
def test_too_few_anchors_for_differences_are_named(height, least):
    heard = [f"A{k + 1}" for k in range(least - 1)]
    few = FOLDER.tables["tdoa"].filter(pl.col("anchor").is_in(heard) & pl.col("anchor_2").is_in(heard))
    rig = replace(FOLDER.rig, tags={tag: Tag(height=height) for tag in few["tag"].unique()})
    messages = [result.message for result in check(replace(FOLDER, rig=rig, tables={"tdoa": few}))]
    assert f"anchors observed: {least - 1}, expected {least} or more for a position" in messages

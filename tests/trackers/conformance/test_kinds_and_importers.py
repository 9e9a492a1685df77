"""Kinds of measurement and importers with one fault each fail the check of that fault, and sound ones pass."""

from __future__ import annotations

import re
from itertools import count

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from tests.catalogue import RIG
from trackwright.trackers.recordings.kinds import KINDS


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
def test_the_kinds_of_the_library_keep_the_contract(kind):
    report = tw.check_kind(kind, RIG)
    assert not report.failures, report
    # The samples of an IMU and of wheels are not predicted by positions.
    assert any(one.outcome == "pass" for one in report) == (kind.predicted is not None)


def _lengths(positions, sensors):
    first, second = sensors.distances(positions).T
    return (first + second)[:, None]


def _kind(predicted=_lengths, positive=False, **facts):
    column = tw.Column("path_m", 0.5, 0.5, 0.05, positive=positive)
    return tw.Kind("bistatic", (column,), ("anchor", "anchor_2"), predicted, **facts)


KIND_FAULTS = {
    "values": (_kind(lambda p, s: np.sqrt(1.0 - _lengths(p, s))), "predicted gives nan at .* usual fix: np.maximum"),
    "order": (
        _kind(lambda p, s: _lengths(p, s) - _lengths(p, s).mean()),
        "half of the rows in another order are off .* no mean",
    ),
    "order: numbering": (
        _kind(lambda p, s: _lengths(p, s) + s.number[:, :1]),
        "in another numbering of the anchors or stations are off",
    ),
    "values: shape": (
        _kind(lambda p, s: _lengths(p, s)[:, 0]),
        r"gave \(200,\), expected \(200, 1\); usual fix: values",
    ),
    "moved site": (_kind(lambda p, s: _lengths(p, s) + p[:, :1]), "of the site moved as a whole are off"),
}


@pytest.mark.parametrize("name", KIND_FAULTS)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_fault_of_a_kind_is_named_by_its_check(name):
    kind, message = KIND_FAULTS[name]
    report = tw.check_kind(kind, RIG)
    assert [one.name for one in report.failures] == [name.partition(":")[0]], report
    assert re.search(message, report.failures[0].sentence), report
    assert "bistatic" not in KINDS


@pytest.fixture
def log(tmp_path):
    """A log of one tag's ranges, `seconds anchor metres`, on a circle."""
    path = tmp_path / "my.log"
    lines = []
    for k in range(80):
        name = sorted(RIG.anchors)[k % 4]
        place = np.array([2 + np.sin(k / 20), 2 + np.cos(k / 20), 1.0])
        lines.append(f"{k / 10} {name} {np.linalg.norm(place - RIG.anchors[name]):.3f}\n")
    path.write_text("".join(lines), encoding="utf-8")
    return path


def _ranges(path, split=str.splitlines):
    rows = [line.split(" ") for line in split(path.read_bytes().decode())]
    return {"ranges": pl.DataFrame([r for r in rows if len(r) == 3], ["t_s", "anchor", "range_m"], orient="row")}


def _adding():
    calls = count(1)
    return lambda path: _ranges(path) | ({"fixes": FIX} if next(calls) == 2 else {})


def _from_the_end(path):
    frame = _ranges(path)["ranges"].with_columns(pl.col("t_s").cast(float))
    return {"ranges": frame.with_columns(pl.col("t_s") - pl.col("t_s").max())}


def _strict(path):
    lines = path.read_text().splitlines()
    assert lines[0], "no line"
    return _ranges(path)


def _in_milliseconds(path):
    return {"ranges": _ranges(path)["ranges"].with_columns(pl.col("range_m").cast(float) * 1000)}


FIX = pl.DataFrame({"t_s": [0.0], "x_m": [1.0], "y_m": [1.0], "z_m": [1.0]})

IMPORTER_FAULTS = {
    "again": (_adding(), "gives another table fixes when the log is read again"),
    "early end": (_from_the_end, "other rows of ranges for the first half of the log"),
    "empty log": (_strict, "stops at an empty log by IndexError: .* raise tw.UnusableInput with the line"),
    "recording": (_in_milliseconds, "`check` of what _in_milliseconds gives says: "),
    "empty log: nothing": (
        lambda path: _ranges(path) if path.stat().st_size else None,
        "gives NoneType of my.log, expected frames by the names of tables",
    ),
    "tables": (lambda path: [1, 2], "gives list of my.log, expected frames by the names of tables"),
}


@pytest.mark.parametrize("name", IMPORTER_FAULTS)
def test_a_fault_of_an_importer_is_named_by_its_check(log, name):
    importer, message = IMPORTER_FAULTS[name]
    report = tw.check_importer(importer, log, RIG, "1")
    assert [one.name for one in report.failures] == [name.partition(":")[0]], report
    assert re.search(message, report.failures[0].sentence), report


def test_a_sound_importer_passes_and_a_log_that_is_no_text_is_no_text(log, tmp_path):
    report = tw.check_importer(_ranges, log, RIG, "1")
    assert {one.outcome for one in report} == {"pass"}, report
    binary = tmp_path / "log.bin"
    binary.write_bytes(b"\xff\xfe\x00")

    def of_bytes(path):
        if not path.stat().st_size:
            raise tw.UnusableInput(f"{path}: is empty; expected a log")
        return _ranges(log)

    outcomes = [one.outcome for one in tw.check_importer(of_bytes, binary, RIG, "1")]
    assert outcomes == ["pass", "pass", "pass", "skip", "pass"]
